#include "sticks.hpp"

#include <float.h>
#include <math.h>

namespace mimopilot
{

namespace
{

constexpr float kRadian = 0.017453293F;  // rad/deg
constexpr float kTurn = 6.2831853F;      // rad

// As in PX4: the heading converges while its error differs from its mean over about a second by more than a degree.
constexpr float kErrorTime = 1.0F;  // s
constexpr float kErrorChange = kRadian;

// Each is called several times: not inlined, for size.
[[gnu::noinline]] float limit(float value, float low, float high)
{
	return value >= low ? (value <= high ? value : high) : low;
}

// A missing stick, NaN, counts as centred.
[[gnu::noinline]] float stick(float value) { return value >= -1.0F && value <= 1.0F ? value : 0.0F; }

float throttle(const StickInput &input) { return limit(input.throttle, -1.0F, 1.0F); }

// PX4's stick curves: a share `expo` of x^3; and "super expo", which bends the curve but keeps its ends.
[[gnu::noinline]] float curve(float x, float expo, float bend)
{
	const float share = limit(expo, 0.0F, 1.0F);
	const float bent = limit(bend, 0.0F, 0.99F);
	return (x + share * (x * x * x - x)) * (1.0F - bent) / (1.0F - fabsf(x) * bent);
}

float deadzone(float x, float width)
{
	const float zone = limit(width, 0.0F, 0.99F);
	const float outside = (fabsf(x) - zone) / (1.0F - zone);
	return outside > 0.0F ? copysignf(outside, x) : 0.0F;
}

// PX4's first order low-pass, started at 0.
[[gnu::noinline]] void filter(float &state, float value, float time_constant, float period)
{
	state += period / (fmaxf(time_constant, 0.0F) + period) * (value - state);
}

[[gnu::noinline]] float wrap(float angle) { return angle - kTurn * floorf(angle / kTurn + 0.5F); }

}  // namespace

void Sticks::shift(float angle)
{
	_heading += angle;
	_filtered += angle;
	_reference += angle;
}

// How far the held heading moves. Forgets it when the estimate has converged.
float Sticks::converge(const VehicleHeading &vehicle, float period)
{
	float correction = 0.0F;

	if (fabsf(vehicle.unaided) <= kTurn) {
		const float error = wrap(vehicle.angle - vehicle.unaided);

		if (!_started) { _filtered = error; }

		_started = true;
		const bool converging = fabsf(wrap(error - _filtered)) > kErrorChange;
		filter(_filtered, error, kErrorTime, period);

		if (!converging) {
			_reference = error;

			if (_converging) { _holding = false; }
		}

		_converging = converging;
		correction = wrap(error - _reference);
	}

	const float change = correction - _correction;
	_correction = correction;
	return change;
}

StickSetpoint Sticks::setpoint(const StockSettings &settings, const StickInput &input, const VehicleHeading &vehicle,
			       float period)
{
	const float change = converge(vehicle, period);
	const float yaw = curve(deadzone(stick(input.yaw), settings.yaw_deadzone), settings.yaw_expo, 0.0F);
	filter(_yaw_rate, kRadian * settings.yaw_rate_max * yaw, settings.yaw_time_constant, period);

	// The arming gesture turns the yaw stick at the bottom of the throttle.
	const bool gesture = throttle(input) < -0.9F && settings.airmode < 1.5F;
	const bool turning = fabsf(_yaw_rate) > FLT_EPSILON;

	_heading = turning || gesture || !vehicle.good || !_holding ? vehicle.angle : _heading + change;
	_holding = !turning;

	// The stick vector's direction is the direction of tilt, its length the tilt angle.
	const float tilt_max = kRadian * settings.tilt_max;
	filter(_tilt[0], tilt_max * stick(input.roll), settings.tilt_time_constant, period);
	filter(_tilt[1], -tilt_max * stick(input.pitch), settings.tilt_time_constant, period);
	const float length = sqrtf(_tilt[0] * _tilt[0] + _tilt[1] * _tilt[1]);
	const float half = 0.5F * fminf(length, tilt_max);
	const float scale = length > 1.0e-6F ? sinf(half) / length : 0.0F;
	const float roll = scale * _tilt[0];
	const float pitch = scale * _tilt[1];
	const float cosine = cosf(0.5F * _heading);
	const float sine = sinf(0.5F * _heading);
	StickSetpoint result;
	result.yaw_rate = _yaw_rate;
	result.q_d[0] = cosine * cosf(half);
	result.q_d[1] = cosine * roll - sine * pitch;
	result.q_d[2] = cosine * pitch + sine * roll;
	result.q_d[3] = sine * cosf(half);
	return result;
}

void acro_rates(const StockSettings &settings, const StickInput &input, float (&rates)[3])
{
	const float sticks[3] = {stick(input.roll), -stick(input.pitch), stick(input.yaw)};

	for (int i = 0; i < 3; i++) {
		const float shaped = curve(sticks[i], settings.acro_expo[i], settings.acro_superexpo[i]);
		rates[i] = kRadian * settings.acro_rate_max[i] * shaped;
	}
}

float acro_thrust(const StickInput &input) { return 0.5F * (throttle(input) + 1.0F); }

}  // namespace mimopilot
