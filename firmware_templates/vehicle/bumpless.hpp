// A change of the controller in the air without a jump of the torque.
#pragma once

#include <math.h>

#include "gains.hpp"

namespace mimopilot
{

// The integrators start with those of the autopilot's own controller, within their limits. What is still missing to its torque
// is added and fades, so that an error at the moment of the change does not stay in the integrators.
class Bumpless
{
public:
	// `output`: of a step with the integrators at zero. `integral` and `torque`: of the autopilot's own controller.
	void start(State &state, const Output &output, const float (&integral)[kAxes], const float (&torque)[kAxes])
	{
		const Gains &gains = state.gains;

		for (int i = 0; i < kAxes; i++) {
			// An integrator that the gains do not use would stay for ever.
			const float used = i == 2 ? fabsf(gains.yaw_ki_i) : fabsf(gains.ki_i[i][0]) + fabsf(gains.ki_i[i][1]);
			const float limit = used > 0.0F ? gains.integral_max[i] : 0.0F;
			state.integral[i] = limited(integral[i], limit);
			_missing[i] = limited(torque[i] - output.moment[i] - state.integral[i], 1.0F);
		}
	}

	// The next sample's torque, for all axes.
	void add(float (&torque)[kAxes])
	{
		constexpr float kFade = 0.1F;  // s; shorter than an attitude loop's response, longer than a motor's

		for (int i = 0; i < kAxes; i++) {
			torque[i] = limited(torque[i] + _missing[i], kMaxExcitation);
			_missing[i] -= kGains.period / kFade * _missing[i];
		}
	}

private:
	// NaN becomes 0.
	static float limited(float value, float limit)
	{
		if (fabsf(value) <= limit) { return value; }

		return value > 0.0F ? limit : (value < 0.0F ? -limit : 0.0F);
	}

	float _missing[kAxes] {};
};

}  // namespace mimopilot
