// Cascaded P + PID attitude controller with full 2x2 gains for roll and pitch and scalar gains for yaw.
//
//   r_i(k) = sat_rate( Kp_o (r_o(k) - y_o(k)) )
//   e(k)   = r_i(k) - y_i(k)
//   d(k)   = a d(k-1) + (1-a) (y_i(k) - y_i(k-1)) / Ts
//   I(k)   = I(k-1) + Ts Ki e(k)                        anti-windup: not further into saturation
//   v(k)   = Kp e(k) + I(k) - Kd d(k) + Kff r_i(k)
//   u(k)   = sat( v(k) + u_bar(k) )
//
// Model following, if model_omega > 0 (wm; model_damping zm): roll and pitch follow a model of the attitude instead of
// the setpoint. Its angle th, rate w and acceleration al of each axis are
//
//   al(k)  = wm^2 (r_o(k) - th(k-1)) - 2 zm wm w(k-1)
//   w(k)   = w(k-1) + Ts al(k)
//   th(k)  = th(k-1) + Ts w(k)
//   r_i(k) = sat_rate( Kp_o (th(k) - y_o(k)) + Kff_o w(k) )
//   v(k)   = Kp e(k) + I(k) - Kd d(k) + (Kff r_i(k) + Kaff al(k))
//
// The model starts at the measured attitude, at rest, with the first armed sample without a fault.
//
// Single precision, fixed period, no heap, no exceptions, no library calls: the same bits on every
// IEEE 754 target. Angles are Euler angles (roll, pitch, yaw), axes body FRD.
#pragma once

#include <stdint.h>

#include "gains_struct.hpp"

namespace mimopilot {

constexpr int kAxes = 3;            // roll, pitch, yaw
constexpr int kModelAxes = 2;       // roll, pitch
constexpr int32_t kHoldSamples = 25;  // an invalid input is held at its last valid value this long
constexpr float kMaxRate = 100.0F;    // rad/s, a larger rate is invalid
constexpr float kMaxAngle = 12.566371F;  // rad, 4 pi, a larger angle is invalid
constexpr float kMaxExcitation = 1.0F;   // a larger excitation is invalid
constexpr float kMaxGain = 1.0e6F;       // no gain or limit may be larger

struct Input {
	float attitude_setpoint[kAxes];  // rad
	float attitude[kAxes];           // rad
	float rates[kAxes];              // rad/s
	float excitation[kAxes];         // u_bar, normalised torque, added to the controller output
	int32_t saturation[kAxes];       // sign of the unallocated torque of the last period
	int32_t armed;                   // 0: integrators are zero
	int32_t landed;                  // not 0: integrators are held
};

struct Output {
	float moment[kAxes];           // u, normalised torque
	float rates_setpoint[kAxes];   // r_i, rad/s
	int32_t fault;                 // bit 0-2 attitude setpoint, 3-5 attitude, 6-8 rate: invalid for too long
	uint32_t fault_count;          // invalid input samples since reset
};

// Attitude model.
struct Model {
	float angle[kModelAxes];         // th, rad
	float rate[kModelAxes];          // w, rad/s
	float acceleration[kModelAxes];  // al, rad/s^2
	int32_t running;                 // 0: starts at the measured attitude
};

struct State {
	Gains gains;
	float integral[kAxes];
	float derivative[kAxes];
	float setpoint[kAxes];  // last valid inputs
	float attitude[kAxes];
	float rates[kAxes];
	int32_t age[3 * kAxes];  // samples since the last valid one: setpoint, attitude, rate
	uint32_t fault_count;
	Model model;
};

// Resets the controller. Returns false if the gains are refused; the torque then stays 0.
bool initialise(State &state, const Gains &gains);

// Replaces the gains. Sets the integrators, within their limits, so that the output does not jump: the next one is as
// with the old gains. If that switches on model following, the model starts with the next step.
// Returns false and changes nothing if a value is not finite, too large, or out of its range.
bool set_gains(State &state, const Gains &gains);

// One control period. If an input is invalid for more than kHoldSamples, the controller only damps the measured
// rates, u = -Kp y_i - Kd d, and holds the integrators. An axis without a valid rate gets 0.
void step(State &state, const Input &input, Output &output);

}  // namespace mimopilot
