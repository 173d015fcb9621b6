// Cascaded P + PID attitude controller with full 2x2 gains for roll and pitch and scalar gains for yaw.
//
//   q_e    = conj(q(k)) q_d(k)                           attitude error: a tilt, then a turn about z
//   e_o    = 2 imag of q_e, its turn scaled by the yaw weight, as PX4 does; e_o(z) divided by the weight. The scaled
//            turn is interpolated between none and the whole: within 0.5 degrees of PX4's for turns up to 90 degrees
//   r_i(k) = sat_rate( Kp_o e_o(k) + R(q)' (0, 0, yaw_rate_setpoint) )
//   e(k)   = r_i(k) - y_i(k)
//   d(k)   = a d(k-1) + (1-a) (y_i(k) - y_i(k-1)) / Ts
//   I(k)   = I(k-1) + Ts Ki e(k)                        anti-windup: not further into saturation
//   v(k)   = Kp e(k) + I(k) - Kd d(k) + Kff r_i(k)
//   u(k)   = sat( v(k) + u_bar(k) )
//
// A single angle error a gives e_o = 2 sin(a/2). In rate mode r_i is given. A setpoint slew limit, if setpoint_slew > 0,
// turns the flown q_d towards the given one at no more than that rate; it starts at the measured attitude.
//
// Model following, if model_omega > 0 (wm; model_damping zm): roll and pitch follow a model of the attitude instead of
// the setpoint. q_d is a heading, then a tilt; th_d is 2 imag of the tilt, roll and pitch. The model's angle th, rate w
// and acceleration al in the axes of that heading are
//
//   al(k)  = wm^2 (th_d(k) - th(k-1)) - 2 zm wm w(k-1)
//   w(k)   = w(k-1) + Ts al(k)
//   th(k)  = th(k-1) + Ts w(k)
//
// q_d in the law becomes the heading, then the tilt th. Turned by the yaw error into body axes, w adds Kff_o w to r_i
// and al adds Kaff al to v. A heading that moves takes the tilt th with it: give tilted vehicles no heading steps. The
// model starts at the measured attitude, at rest, with the first armed sample without a fault.
//
// Single precision, fixed period, no heap, no exceptions, no library calls: the same bits on every
// IEEE 754 target. Quaternions are w, x, y, z, body FRD to earth NED.
#pragma once

#include <stdint.h>

#include "gains_struct.hpp"

namespace mimopilot
{

constexpr int kAxes = 3;            // roll, pitch, yaw
constexpr int kModelAxes = 2;       // roll, pitch
constexpr int kInputs = 2 + kAxes;  // setpoint, attitude, rates
constexpr int32_t kHoldSamples = 25;  // an invalid input is held at its last valid value this long
constexpr float kMaxRate = 100.0F;    // rad/s, a larger rate is invalid
constexpr float kMaxNormError = 0.02F;  // a quaternion is invalid if its squared length differs more from 1
constexpr float kMaxExcitation = 1.0F;  // a larger excitation is invalid

// Bits of Output::fault and Input::silent.
constexpr int32_t kSetpointFault = 1;
constexpr int32_t kAttitudeFault = 2;
constexpr int32_t kRateFault = 4;  // roll; pitch and yaw are the next two bits
constexpr int32_t kAllFaults = 31;

struct Input {
	float attitude_setpoint[4];   // q_d, not used in rate mode
	float yaw_rate_setpoint;      // rad/s, about earth's z axis; NaN: none; not used in rate mode
	float attitude[4];            // q, not needed in rate mode
	float rates_setpoint[kAxes];  // rad/s, flown in rate mode
	float rates[kAxes];           // rad/s
	float excitation[kAxes];      // u_bar, normalised torque, added to the controller output; NaN: none
	int32_t saturation[kAxes];    // sign of the unallocated torque of the last period
	int32_t silent;               // fault bits of inputs whose source has stopped: invalid without the hold
	int32_t rate_mode;            // not 0: rates_setpoint is flown
	int32_t armed;                // 0: integrators are zero
	int32_t landed;               // not 0: integrators are held
};

struct Output {
	float moment[kAxes];           // u, normalised torque
	float rates_setpoint[kAxes];   // r_i, rad/s
	int32_t fault;                 // bits of the inputs that are invalid for too long
	uint32_t fault_count;          // invalid input samples since reset
};

// Attitude model.
struct Model {
	float angle[kModelAxes];         // th, rad
	float rate[kModelAxes];          // w, rad/s
	float acceleration[kModelAxes];  // al, rad/s^2
	int32_t running;                 // 0: starts at the measured attitude
};

// What is flown in this period.
struct Flown {
	float rates[kAxes];              // r_i
	float acceleration[kModelAxes];  // of the attitude model, in body axes
	Model model;
};

// What changes often is at small offsets, which take shorter instructions.
struct State {
	int32_t hold[kInputs];   // samples for which an invalid input is still held: setpoint, attitude, rates
	int32_t missing;         // fault bits of the last sample
	int32_t expired;         // of these, those held for too long
	uint32_t fault_count;
	int32_t rate_mode;
	int32_t slewing;         // 0: the flown setpoint starts at the measured attitude
	Flown flown;
	float attitude_setpoint[4];  // flown, within the slew limit
	float yaw_rate_setpoint;
	float attitude[4];           // last valid inputs
	float rates[kAxes];
	float derivative[kAxes];
	float integral[kAxes];
	float derivative_gain;  // (1 - a) / Ts
	Gains gains;
};

// Resets the controller. Returns false if the gains are refused; the torque then stays 0.
bool initialise(State &state, const Gains &gains);

// Replaces the gains. Sets the integrators, within their limits, so that the output does not jump: the next one is as
// with the old gains. If that switches on model following, the model starts with the next step.
// Returns false and changes nothing if a value is not finite, too large, or out of its range.
bool set_gains(State &state, const Gains &gains);

// One control period. While an input is missing, the rate setpoint of the attitude controller is held. If one is invalid
// for more than kHoldSamples, the controller only damps the measured rates, u = -Kp y_i - Kd d, and holds the integrators.
// An axis without a valid rate gets 0.
void step(State &state, const Input &input, Output &output);

}  // namespace mimopilot
