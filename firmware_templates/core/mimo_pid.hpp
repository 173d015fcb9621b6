// Cascaded P + PID attitude controller with full 2x2 gains for roll and pitch and scalar gains for yaw.
//
//   r_i(k) = sat_rate( Kp_o (r_o(k) - y_o(k)) )
//   e(k)   = r_i(k) - y_i(k)
//   d(k)   = a d(k-1) + (1-a) (y_i(k) - y_i(k-1)) / Ts
//   I(k)   = I(k-1) + Ts Ki e(k)                        with anti-windup, see step()
//   v(k)   = Kp e(k) + I(k) - Kd d(k) + Kff r_i(k)
//   u(k)   = sat( v(k) + u_bar(k) )
//
// Single precision, fixed period, no heap, no exceptions, no library calls: the same bits on every
// IEEE 754 target. Angles are aeronautical (roll, pitch, yaw), axes body FRD.
#pragma once

#include <stdint.h>

#include "gains_struct.hpp"

namespace mimopilot {

constexpr int kAxes = 3;            // roll, pitch, yaw
constexpr int32_t kHoldSamples = 25;  // an invalid input is replaced by its last good value for so long
constexpr float kMaxRate = 100.0F;    // rad/s, range of a credible body rate
constexpr float kMaxAngle = 12.566371F;  // rad, 4 pi, range of a credible angle or set-point
constexpr float kMaxExcitation = 1.0F;   // range of a credible injected moment
constexpr float kMaxGain = 1.0e6F;       // no gain or limit may be larger

struct Input {
	float attitude_setpoint[kAxes];  // rad
	float attitude[kAxes];           // rad
	float rates[kAxes];              // rad/s
	float excitation[kAxes];         // u_bar, dimensionless, added to the controller's output
	int32_t saturation[kAxes];       // sign of the moment that the allocator could not give in the last period
	int32_t armed;                   // 0: the integrators are zero
	int32_t landed;                  // not 0: the integrators are held
};

struct Output {
	float moment[kAxes];           // u, dimensionless
	float rates_setpoint[kAxes];   // r_i, rad/s
	int32_t fault;                 // bit 0-2 attitude set-point, 3-5 attitude, 6-8 rate: invalid for too long
	uint32_t fault_count;          // invalid input samples since reset
};

struct State {
	Gains gains;
	float integral[kAxes];
	float derivative[kAxes];
	float setpoint[kAxes];  // last good inputs
	float attitude[kAxes];
	float rates[kAxes];
	int32_t age[3 * kAxes];  // samples since the last good one: set-point, attitude, rate
	uint32_t fault_count;
};

// Controller at rest. Returns false, and leaves the state without effect (moment 0), when the gains are refused.
bool initialise(State &state, const Gains &gains);

// Replaces the gains; the integrators are re-seated so that the output is continuous, within their limits.
// Returns false, and changes nothing, when a number is not finite, too large, or out of its range.
bool set_gains(State &state, const Gains &gains);

// One control period. When an input has been invalid for more than kHoldSamples the controller only damps the
// measured rates, u = -Kp y_i - Kd d, integrators frozen; an axis whose rate is the invalid input gets 0.
void step(State &state, const Input &input, Output &output);

}  // namespace mimopilot
