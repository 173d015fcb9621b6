#include "sticks.hpp"

#include <math.h>

namespace mimopilot {

namespace {

constexpr float kDeadzone = 0.1F;

// A missing stick, NaN, counts as centred.
float valid(float stick) { return stick >= -1.0F && stick <= 1.0F ? stick : 0.0F; }

float thrust_curve(const StickSettings &settings, float throttle)
{
	const float end = throttle < 0.0F ? settings.thrust_min : settings.thrust_max;
	return settings.thrust_hover + fabsf(throttle) * (end - settings.thrust_hover);
}

}  // namespace

StickSetpoint Sticks::setpoint(const StickSettings &settings, const StickInput &input, float heading)
{
	StickSetpoint result{};
	const float yaw = valid(input.yaw);
	const bool turning = fabsf(yaw) > kDeadzone;

	if (turning) { result.yaw_rate = yaw * settings.yaw_rate_max; }

	if (turning || !_holding || input.throttle < -0.9F) { _heading = heading; }

	_holding = true;

	// As in PX4: the stick vector's direction is the direction of tilt, its length the tilt angle.
	float roll = valid(input.roll);
	float pitch = -valid(input.pitch);
	const float length = sqrtf(roll * roll + pitch * pitch);
	const float tilt = settings.tilt_max * (length > 1.0F ? 1.0F : length);
	const float scale = length > 1.0e-6F ? sinf(0.5F * tilt) / length : 0.0F;
	roll *= scale;
	pitch *= scale;

	const float cosine = cosf(0.5F * _heading);
	const float sine = sinf(0.5F * _heading);
	result.q_d[0] = cosine * cosf(0.5F * tilt);
	result.q_d[1] = cosine * roll - sine * pitch;
	result.q_d[2] = cosine * pitch + sine * roll;
	result.q_d[3] = sine * cosf(0.5F * tilt);
	result.thrust = thrust_curve(settings, input.throttle >= -1.0F && input.throttle <= 1.0F ? input.throttle : -1.0F);
	return result;
}

}  // namespace mimopilot
