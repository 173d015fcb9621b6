// Bit-exactness: every multiplication and addition below must round by itself, in the order written.
// Compilers may fuse or reorder them unless told not to, and flight stacks often tell them to.
#if defined(__clang__)
#pragma STDC FP_CONTRACT OFF
#elif defined(__GNUC__)
#pragma GCC optimize("fp-contract=off", "no-fast-math", "no-unsafe-math-optimizations", "no-associative-math", \
		     "no-reciprocal-math", "no-finite-math-only", "signed-zeros", "trapping-math")
#endif
#if defined(__FAST_MATH__) || defined(__ASSOCIATIVE_MATH__) || defined(__RECIPROCAL_MATH__) \
	|| (defined(__FINITE_MATH_ONLY__) && __FINITE_MATH_ONLY__)
#error "mimo_pid.cpp must be compiled without fast-math: add -fno-fast-math to this file's flags"
#endif

#include "mimo_pid.hpp"

namespace mimopilot {

namespace {

constexpr float kTwoPi = 6.2831855F;
constexpr float kPi = 3.1415927F;

// A range test, not isfinite: it catches NaN and infinity too, and survives every optimisation flag.
bool within(float value, float limit) { return value >= -limit && value <= limit; }

bool nonzero(float value) { return value > 0.0F || value < 0.0F; }  // some flight stacks forbid != between floats

float clamp(float value, float limit)
{
	if (value > limit) { return limit; }

	if (value < -limit) { return -limit; }

	return value;
}

float row(const float (&gain)[2], const float (&x)[kAxes]) { return gain[0] * x[0] + gain[1] * x[1]; }

// Shortest way round: the difference of two angles within 4 pi needs at most four turns.
float wrap(float angle)
{
	for (int turn = 0; turn < 4 && angle > kPi; turn++) { angle -= kTwoPi; }

	for (int turn = 0; turn < 4 && angle < -kPi; turn++) { angle += kTwoPi; }

	return angle;
}

bool acceptable(const Gains &gains)
{
	const float (*const matrices[])[2] = {gains.kp_o, gains.kp_i, gains.ki_i, gains.kd_i, gains.kff_i};

	for (const auto matrix : matrices) {
		for (int i = 0; i < 2; i++) {
			for (int j = 0; j < 2; j++) {
				if (!within(matrix[i][j], kMaxGain)) { return false; }
			}
		}
	}

	const float yaw[] = {gains.yaw_kp_o, gains.yaw_kp_i, gains.yaw_ki_i, gains.yaw_kd_i, gains.yaw_kff_i};

	for (const float gain : yaw) {
		if (!within(gain, kMaxGain)) { return false; }
	}

	const float *const limits[] = {gains.rate_max, gains.moment_max, gains.integral_max};

	for (const auto limit : limits) {
		for (int i = 0; i < kAxes; i++) {
			if (!(limit[i] > 0.0F && limit[i] <= kMaxGain)) { return false; }
		}
	}

	return gains.derivative_pole >= 0.0F && gains.derivative_pole < 1.0F
	       && gains.period >= 1.0e-4F && gains.period <= 1.0F;
}

// The terms of v that hold no memory of the error.
struct Terms {
	float rates_setpoint[kAxes];
	float proportional[kAxes];
	float derivative[kAxes];
	float feedforward[kAxes];
	float increment[kAxes];  // dI = Ts Ki e
};

void evaluate(const Gains &gains, const State &state, Terms &terms)
{
	const float angle_error[kAxes] = {
		state.setpoint[0] - state.attitude[0],
		state.setpoint[1] - state.attitude[1],
		wrap(state.setpoint[2] - state.attitude[2]),
	};
	float *const r = terms.rates_setpoint;
	r[0] = clamp(row(gains.kp_o[0], angle_error), gains.rate_max[0]);
	r[1] = clamp(row(gains.kp_o[1], angle_error), gains.rate_max[1]);
	r[2] = clamp(gains.yaw_kp_o * angle_error[2], gains.rate_max[2]);
	const float error[kAxes] = {r[0] - state.rates[0], r[1] - state.rates[1], r[2] - state.rates[2]};

	for (int j = 0; j < 2; j++) {
		terms.proportional[j] = row(gains.kp_i[j], error);
		terms.derivative[j] = row(gains.kd_i[j], state.derivative);
		terms.feedforward[j] = row(gains.kff_i[j], terms.rates_setpoint);
		terms.increment[j] = gains.period * row(gains.ki_i[j], error);
	}

	terms.proportional[2] = gains.yaw_kp_i * error[2];
	terms.derivative[2] = gains.yaw_kd_i * state.derivative[2];
	terms.feedforward[2] = gains.yaw_kff_i * r[2];
	terms.increment[2] = gains.period * (gains.yaw_ki_i * error[2]);
}

float sum(const Terms &terms, int j, float integral)
{
	return ((terms.proportional[j] + integral) - terms.derivative[j]) + terms.feedforward[j];
}

// Takes an input that is within its range; keeps the last good value otherwise.
void accept(float value, float limit, float &held, int32_t &age, uint32_t &fault_count)
{
	if (within(value, limit)) {
		held = value;
		age = 0;

	} else {
		fault_count++;

		if (age <= kHoldSamples) { age++; }
	}
}

int32_t accept_inputs(State &state, const Input &input)
{
	int32_t failed = 0;
	const float filter_gain = (1.0F - state.gains.derivative_pole) / state.gains.period;

	for (int i = 0; i < kAxes; i++) {
		accept(input.attitude_setpoint[i], kMaxAngle, state.setpoint[i], state.age[i], state.fault_count);
		accept(input.attitude[i], kMaxAngle, state.attitude[i], state.age[kAxes + i], state.fault_count);

		int32_t &age = state.age[2 * kAxes + i];
		const bool first = age > kHoldSamples;
		const float previous = state.rates[i];
		accept(input.rates[i], kMaxRate, state.rates[i], age, state.fault_count);
		state.derivative[i] = first || age > kHoldSamples
				      ? 0.0F
				      : state.gains.derivative_pole * state.derivative[i] + filter_gain * (state.rates[i] - previous);
	}

	for (int i = 0; i < 3 * kAxes; i++) {
		if (state.age[i] > kHoldSamples) { failed |= 1 << i; }
	}

	return failed;
}

// An input has been invalid for too long: damp the rates that are still measured, leave the failed axes alone.
void damp_rates(const State &state, int32_t failed, float (&moment)[kAxes])
{
	const Gains &gains = state.gains;
	bool valid[kAxes];
	float rates[kAxes];

	for (int i = 0; i < kAxes; i++) {
		valid[i] = (failed & (1 << (2 * kAxes + i))) == 0;
		rates[i] = valid[i] ? state.rates[i] : 0.0F;
	}

	for (int j = 0; j < 2; j++) {
		moment[j] = valid[j] ? -row(gains.kp_i[j], rates) - row(gains.kd_i[j], state.derivative) : 0.0F;
	}

	moment[2] = valid[2] ? -(gains.yaw_kp_i * rates[2]) - gains.yaw_kd_i * state.derivative[2] : 0.0F;
}

}  // namespace

bool initialise(State &state, const Gains &gains)
{
	state = State{};

	for (int i = 0; i < 3 * kAxes; i++) { state.age[i] = kHoldSamples + 1; }

	const bool accepted = acceptable(gains);

	if (accepted) {
		state.gains = gains;

	} else {
		state.gains.period = 1.0F;  // all other gains and limits are zero: so is the moment
	}

	return accepted;
}

bool set_gains(State &state, const Gains &gains)
{
	if (!acceptable(gains)) { return false; }

	Terms before;
	Terms after;
	evaluate(state.gains, state, before);
	evaluate(gains, state, after);

	for (int j = 0; j < kAxes; j++) {
		const float output = sum(before, j, state.integral[j]);
		const float rest = sum(after, j, 0.0F);
		const bool integrates = j == 2 ? nonzero(gains.yaw_ki_i) : nonzero(gains.ki_i[j][0]) || nonzero(gains.ki_i[j][1]);
		state.integral[j] = integrates ? clamp(output - rest, gains.integral_max[j]) : 0.0F;
	}

	state.gains = gains;
	return true;
}

void step(State &state, const Input &input, Output &output)
{
	const Gains &gains = state.gains;
	const int32_t failed = accept_inputs(state, input);
	Terms terms;
	evaluate(gains, state, terms);

	if (failed != 0) { damp_rates(state, failed, output.moment); }

	for (int j = 0; j < kAxes; j++) {
		float excitation = input.excitation[j];

		// NaN means that nothing is injected; anything else out of range is a fault.
		if (excitation > kMaxExcitation || excitation < -kMaxExcitation) { state.fault_count++; }

		if (!within(excitation, kMaxExcitation)) { excitation = 0.0F; }

		if (failed == 0) {
			const float limit = gains.moment_max[j];
			float increment = terms.increment[j];
			const float attempt = sum(terms, j, state.integral[j] + increment) + excitation;
			const bool high = attempt > limit || input.saturation[j] > 0;
			const bool low = attempt < -limit || input.saturation[j] < 0;

			if (input.landed != 0 || (high && increment > 0.0F) || (low && increment < 0.0F)) { increment = 0.0F; }

			state.integral[j] = clamp(state.integral[j] + increment, gains.integral_max[j]);

			if (input.armed == 0) { state.integral[j] = 0.0F; }

			output.moment[j] = clamp(sum(terms, j, state.integral[j]) + excitation, limit);
			output.rates_setpoint[j] = terms.rates_setpoint[j];

		} else {
			if (input.armed == 0) { state.integral[j] = 0.0F; }

			output.moment[j] = clamp(output.moment[j], gains.moment_max[j]);
			output.rates_setpoint[j] = 0.0F;
		}
	}

	output.fault = failed;
	output.fault_count = state.fault_count;
}

}  // namespace mimopilot
