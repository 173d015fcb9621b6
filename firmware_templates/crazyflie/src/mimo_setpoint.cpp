#include "mimo_setpoint.hpp"

#include <math.h>

extern "C" {
#include "position_controller.h"
}

#include "attitude.hpp"
#include "gains.hpp"
#include "mimo_edge.hpp"

namespace mimopilot
{

namespace
{

constexpr float kTurn = 6.2831853F;       // rad
constexpr float kFullTilt = 0.5235988F;   // rad, 30 degrees: the most that the firmware's client asks for by default
constexpr float kFullYawRate = 3.490659F; // rad/s, 200 deg/s, likewise
constexpr float kFullThrust = 65535.0F;

bool position_held(const setpoint_t &setpoint) { return setpoint.mode.x != modeDisable && setpoint.mode.y != modeDisable; }

// The supervisor levels a vehicle out by the modes of roll and pitch, and leaves that of the quaternion as it was.
bool quaternion_flown(const setpoint_t &setpoint)
{
	return setpoint.mode.quat == modeAbs && setpoint.mode.roll == modeDisable && setpoint.mode.pitch == modeDisable
	       && !position_held(setpoint);
}

void reset_position_controller(const state_t &state)
{
	positionControllerResetAllPID(state.position.x, state.position.y, state.position.z);
	positionControllerResetAllfilters();
}

void load(const quaternion_t &from, float (&q)[4])
{
	const float xyzw[4] = {from.x, from.y, from.z, from.w};
	attitude_from_flu(xyzw, q);
}

// The heading to hold from now on. One that is no number is not taken: it would stay after a single invalid sample.
void hold(float heading, float &held)
{
	const float turn = remainderf(heading, kTurn);

	if (fabsf(turn) <= kTurn) { held = turn; }
}

float along(stab_mode_t mode, float position, float velocity) { return mode == modeAbs ? position : velocity; }

}  // namespace

bool same(const setpoint_mode_t &a, const setpoint_mode_t &b)
{
	return a.x == b.x && a.y == b.y && a.z == b.z && a.roll == b.roll && a.pitch == b.pitch && a.yaw == b.yaw
	       && a.quat == b.quat;
}

void Setpoint::start(const Input &input)
{
	*this = Setpoint{};
	hold(heading(input.attitude), _heading);
}

bool Setpoint::rates_flown(const setpoint_t &setpoint)
{
	return setpoint.mode.roll == modeVelocity && setpoint.mode.pitch == modeVelocity && !position_held(setpoint);
}

void Setpoint::update_heading(const setpoint_t &setpoint, Input &input)
{
	const float yaw_left[3] = {0.0F, 0.0F, setpoint.attitudeRate.yaw};
	const float heading_left[3] = {0.0F, 0.0F, setpoint.attitude.yaw};
	float angles[3];
	input.yaw_rate_setpoint = 0.0F;

	if (setpoint.mode.yaw == modeVelocity) {
		angles_from_legacy(yaw_left, angles);
		input.yaw_rate_setpoint = angles[2];
		hold(_heading + angles[2] * kGains.period, _heading);

	} else if (setpoint.mode.yaw == modeAbs) {
		angles_from_legacy(heading_left, angles);
		hold(angles[2], _heading);

	} else if (setpoint.mode.quat == modeAbs) {
		float q[4];
		load(setpoint.attitudeQuaternion, q);
		hold(heading(q), _heading);
	}
}

void Setpoint::step(const setpoint_t &setpoint, const state_t &state, uint32_t step, Input &input)
{
	if (!same(setpoint.mode, _mode)) {
		reset_position_controller(state);
		_mode = setpoint.mode;
	}

	update_heading(setpoint, input);

	if (RATE_DO_EXECUTE(POSITION_RATE, step)) { positionController(&_thrust, &_desired, &setpoint, &state); }

	if (setpoint.mode.z == modeDisable) { _thrust = setpoint.thrust; }

	if (rates_flown(setpoint)) {
		const float rates[3] = {setpoint.attitudeRate.roll, setpoint.attitudeRate.pitch,
					setpoint.mode.yaw == modeVelocity ? setpoint.attitudeRate.yaw : 0.0F};
		angles_from_legacy(rates, input.rates_setpoint);
		input.rate_mode = 1;
		hold(heading(input.attitude), _heading);

	} else {
		input.rate_mode = 0;
	}

	const attitude_t &tilt = position_held(setpoint) ? _desired : setpoint.attitude;
	const float legacy[3] = {tilt.roll, tilt.pitch, 0.0F};
	float angles[3];
	angles_from_legacy(legacy, angles);
	angles[2] = _heading;

	if (quaternion_flown(setpoint)) {
		load(setpoint.attitudeQuaternion, input.attitude_setpoint);

	} else {
		quaternion_of(angles, input.attitude_setpoint);
	}

	if (!(_thrust > 0.0F)) {
		reset_position_controller(state);
		hold(heading(input.attitude), _heading);
	}
}

void Setpoint::sticks(const setpoint_t &setpoint, const Input &input, float (&sticks)[4])
{
	float angles[3];
	angles_of(input.attitude_setpoint, angles);

	if (position_held(setpoint)) {
		sticks[0] = along(setpoint.mode.x, setpoint.position.x, setpoint.velocity.x);
		sticks[1] = along(setpoint.mode.y, setpoint.position.y, setpoint.velocity.y);

	} else {
		sticks[0] = angles[1] / kFullTilt;
		sticks[1] = angles[0] / kFullTilt;
	}

	sticks[2] = setpoint.mode.yaw == modeVelocity ? input.yaw_rate_setpoint / kFullYawRate : angles[2] / kFullTilt;
	sticks[3] = setpoint.mode.z == modeDisable
		    ? setpoint.thrust / kFullThrust : along(setpoint.mode.z, setpoint.position.z, setpoint.velocity.z);
}

}  // namespace mimopilot
