#include "throttle.hpp"

#include <math.h>

namespace mimopilot
{

namespace
{

// PX4's slew rates, 1/s: 1.6 s from 0 to MPC_MANTHR_MIN's default, 2 s to full thrust.
constexpr float kSlow = 0.05F;
constexpr float kFast = 0.5F;

void slew(float &value, float target, float step) { value += fminf(fmaxf(target - value, -step), step); }

}  // namespace

void Throttle::estimate(const StockSettings &settings, bool valid, float hover_thrust)
{
	_estimated = true;
	_estimate = valid ? fminf(fmaxf(hover_thrust, 0.05F), 0.9F) : settings.thrust_hover;
}

void Throttle::update(const StockSettings &settings, bool landed, bool spooled_up, float period)
{
	const bool jump = !_started && spooled_up && !landed;
	const float slow = jump ? 1.0F : kSlow * period;
	slew(_minimum, landed ? 0.0F : settings.thrust_min, slow);
	slew(_maximum, spooled_up ? 1.0F : 0.0F, jump || !spooled_up ? 1.0F : kFast * period);
	slew(_hover, _estimated ? _estimate : settings.thrust_hover, _estimated ? slow : 1.0F);
	_started = true;
}

float Throttle::thrust(const StockSettings &settings, float throttle) const
{
	const float stick = throttle > -1.0F ? fminf(throttle, 1.0F) : -1.0F;  // -1 for NaN
	const int curve = static_cast<int>(settings.throttle_curve);
	const float middle = curve == 1 ? 0.5F * (_minimum + settings.thrust_max)
			     : curve == 2 ? settings.thrust_hover : _hover;
	const float end = stick < 0.0F ? _minimum : settings.thrust_max;
	return fminf(middle + fabsf(stick) * (end - middle), _maximum);
}

}  // namespace mimopilot
