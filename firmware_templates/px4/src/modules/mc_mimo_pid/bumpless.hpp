// A change of the controller in the air without a jump of the torque.
#pragma once

#include <math.h>

#include "mimo_pid.hpp"

namespace mimopilot
{

// The integrators start with `torque`, what is missing without them, within their limits. One that the gains do not use
// would stay for ever: it starts with zero.
inline void start_integrals(State &state, const float (&torque)[kAxes])
{
	const Gains &gains = state.gains;

	for (int i = 0; i < kAxes; i++) {
		const float sum = i == 2 ? fabsf(gains.yaw_ki_i) : fabsf(gains.ki_i[i][0]) + fabsf(gains.ki_i[i][1]);
		state.integral[i] = sum > 0.0F ? fminf(fmaxf(torque[i], -gains.integral_max[i]), gains.integral_max[i]) : 0.0F;
	}
}

}  // namespace mimopilot
