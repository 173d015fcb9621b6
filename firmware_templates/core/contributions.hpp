// The parts of the controller output, for a log.
#pragma once

#include "mimo_pid.hpp"

namespace mimopilot
{

// v = proportional + integral + derivative + feedforward + cross, to rounding. The first four are those of an axis' own
// signals; cross is what the signals of the other axis add through off-diagonal gains, apart from the integral.
struct Contributions {
	float proportional[kAxes];
	float integral[kAxes];
	float derivative[kAxes];
	float feedforward[kAxes];
	float cross[kAxes];
};

// Of the last step, whose output was `output`.
inline void contributions(const State &state, const Output &output, Contributions &parts)
{
	const Gains &gains = state.gains;
	const float *const r = state.flown.rates;
	const float *const d = state.derivative;
	const float e[kAxes] = {r[0] - state.rates[0], r[1] - state.rates[1], r[2] - state.rates[2]};
	const float *const al = state.flown.acceleration;

	for (int j = 0; j < kModelAxes; j++) {
		const int other = 1 - j;
		parts.proportional[j] = gains.kp_i[j][j] * e[j];
		parts.derivative[j] = -(gains.kd_i[j][j] * d[j]);
		parts.feedforward[j] = gains.kff_i[j][j] * r[j] + gains.kaff_i[j][j] * al[j];
		parts.cross[j] = gains.kp_i[j][other] * e[other] - gains.kd_i[j][other] * d[other]
				 + gains.kff_i[j][other] * r[other] + gains.kaff_i[j][other] * al[other];
	}

	parts.proportional[2] = gains.yaw_kp_i * e[2];
	parts.derivative[2] = -(gains.yaw_kd_i * d[2]);
	parts.feedforward[2] = gains.yaw_kff_i * r[2];
	parts.cross[2] = 0.0F;

	for (int j = 0; j < kAxes; j++) { parts.integral[j] = output.fault == 0 ? state.integral[j] : 0.0F; }
}

}  // namespace mimopilot
