// What is flown, from the firmware's setpoint: as its own PID controller reads it.
#pragma once

#include <stdint.h>

extern "C" {
#include "stabilizer_types.h"
}

#include "mimo_pid.hpp"

namespace mimopilot
{

class Setpoint
{
public:
	// The heading to hold is the measured one.
	void start(const Input &input);

	// One period, of `step`: sets the setpoints of `input`, whose attitude is the measured one. Without thrust, the
	// heading to hold is the measured one.
	void step(const setpoint_t &setpoint, const state_t &state, uint32_t step, Input &input);

	// Total, 0 to 65535.
	float thrust() const { return _thrust; }

	// What a pilot or a program asks for, roughly as the sticks of a remote control, -1 to 1: forward, to the side, yaw,
	// up. A unit is 30 degrees, 200 deg/s, 1 m, 1 m/s or the full thrust. `input`: of this period.
	static void sticks(const setpoint_t &setpoint, const Input &input, float (&sticks)[4]);

private:
	static bool rates_flown(const setpoint_t &setpoint);
	void update_heading(const setpoint_t &setpoint, Input &input);

	setpoint_mode_t _mode{};
	attitude_t _desired{};  // of the position controller
	float _thrust{0.0F};
	float _heading{0.0F};   // rad, FRD
};

// Whether all modes are the same.
bool same(const setpoint_mode_t &a, const setpoint_mode_t &b);

}  // namespace mimopilot
