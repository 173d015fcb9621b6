// Bit-exactness: each multiplication and addition below must round on its own, in the order written.
// Compilers may fuse or reorder them unless told not to, and flight stacks often allow both.
#ifdef __clang__
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

// Code size and step time have a budget: the attributes below keep step() fast and the rest small.

constexpr float kTwoPi = 6.2831855F;
constexpr float kPi = 3.1415927F;

[[gnu::always_inline]] inline bool unlikely(bool condition)
{
	return __builtin_expect(static_cast<long>(condition), 0L) != 0L;
}

// Compares bit patterns: there, infinity and NaN exceed every number, whatever the optimisation flags.
bool within(float value, float limit)
{
	uint32_t bits;
	uint32_t limit_bits;
	__builtin_memcpy(&bits, &value, sizeof(bits));
	__builtin_memcpy(&limit_bits, &limit, sizeof(limit_bits));
	return bits << 1 <= limit_bits << 1;
}

float clamp(float value, float limit)
{
	if (__builtin_fabsf(value) > limit) { value = value > 0.0F ? limit : -limit; }

	return value;
}

float row(const float (&gain)[2], float roll, float pitch) { return gain[0] * roll + gain[1] * pitch; }

// Wraps to -pi to pi. Two angles within 4 pi differ by at most four turns.
float wrap(float angle)
{
	if (unlikely(__builtin_fabsf(angle) > kPi)) {
		const float turn = angle > 0.0F ? -kTwoPi : kTwoPi;
		int turns = 0;

		do {
			angle += turn;
			turns++;
		} while (turns < 4 && __builtin_fabsf(angle) > kPi);
	}

	return angle;
}

[[gnu::cold, gnu::noinline]] bool acceptable(const Gains &gains)
{
	static_assert(sizeof(Gains) == kGainCount * sizeof(float), "Gains is a row of floats");
	const float *const values = reinterpret_cast<const float *>(&gains);

	for (int i = 0; i < kGainCount; i++) {
		if (!within(values[i], kMaxGain)) { return false; }
	}

	return valid(gains);
}

bool follows(const Gains &gains) { return !within(gains.model_omega, 0.0F); }

// One period of the attitude model: semi-implicit Euler.
[[gnu::noinline]] void advance(const Gains &gains, const State &state, Model &model)
{
	const float omega = gains.model_omega;
	const float stiffness = omega * omega;
	const float friction = (2.0F * gains.model_damping) * omega;

	for (int j = 0; j < kModelAxes; j++) {
		float angle = state.attitude[j];
		float rate = 0.0F;
		float acceleration = 0.0F;

		if (model.running != 0) {
			angle = model.angle[j];
			rate = model.rate[j];
			acceleration = stiffness * (state.setpoint[j] - angle) - friction * rate;
			rate += gains.period * acceleration;
			angle += gains.period * rate;
		}

		model.angle[j] = angle;
		model.rate[j] = rate;
		model.acceleration[j] = acceleration;
	}
}

// Attitude controller: rate setpoint r.
[[gnu::always_inline]] inline void outer_loop(const Gains &gains, const State &state, const Model &model,
					      float (&r)[kAxes])
{
	const bool following = follows(gains);
	float roll = state.setpoint[0];
	float pitch = state.setpoint[1];

	if (unlikely(following)) {
		roll = model.angle[0];
		pitch = model.angle[1];
	}

	roll -= state.attitude[0];
	pitch -= state.attitude[1];
	const float yaw = wrap(state.setpoint[2] - state.attitude[2]);
	float roll_rate = row(gains.kp_o[0], roll, pitch);
	float pitch_rate = row(gains.kp_o[1], roll, pitch);

	if (unlikely(following)) {
		roll_rate += row(gains.kff_o[0], model.rate[0], model.rate[1]);
		pitch_rate += row(gains.kff_o[1], model.rate[0], model.rate[1]);
	}

	r[0] = clamp(roll_rate, gains.rate_max[0]);
	r[1] = clamp(pitch_rate, gains.rate_max[1]);
	r[2] = clamp(gains.yaw_kp_o * yaw, gains.rate_max[2]);
}

struct Axes {
	float roll;
	float pitch;
	float yaw;
};

// Inputs of the rate controller.
struct Signals {
	Axes rates_setpoint;
	Axes error;
	Axes derivative;
	bool following;
	float roll_acceleration;  // of the attitude model
	float pitch_acceleration;
};

[[gnu::always_inline]] inline Signals signals(const Gains &gains, const State &state, const Model &model,
					      const float (&r)[kAxes])
{
	return {
		{r[0], r[1], r[2]},
		{r[0] - state.rates[0], r[1] - state.rates[1], r[2] - state.rates[2]},
		{state.derivative[0], state.derivative[1], state.derivative[2]},
		follows(gains),
		model.acceleration[0],
		model.acceleration[1],
	};
}

// Terms of v on one axis.
struct Terms {
	float proportional;
	float derivative;
	float feedforward;
	float slope;  // Ki e
};

[[gnu::always_inline]] inline Terms inner_loop(const Gains &gains, const Signals &x, int j)
{
	if (j == 2) {
		return {
			gains.yaw_kp_i * x.error.yaw,
			gains.yaw_kd_i * x.derivative.yaw,
			gains.yaw_kff_i * x.rates_setpoint.yaw,
			gains.yaw_ki_i * x.error.yaw,
		};
	}

	float feedforward = row(gains.kff_i[j], x.rates_setpoint.roll, x.rates_setpoint.pitch);

	if (unlikely(x.following)) { feedforward += row(gains.kaff_i[j], x.roll_acceleration, x.pitch_acceleration); }

	return {
		row(gains.kp_i[j], x.error.roll, x.error.pitch),
		row(gains.kd_i[j], x.derivative.roll, x.derivative.pitch),
		feedforward,
		row(gains.ki_i[j], x.error.roll, x.error.pitch),
	};
}

float sum(const Terms &terms, float integral)
{
	return ((terms.proportional + integral) - terms.derivative) + terms.feedforward;
}

void clear_integral(State &state)
{
	for (int j = 0; j < kAxes; j++) { state.integral[j] = 0.0F; }
}

// v of each axis, with the attitude model one period ahead.
[[gnu::cold, gnu::noinline]] void evaluate(const Gains &gains, const State &state, float (&v)[kAxes])
{
	float r[kAxes];
	Model model = state.model;

	if (follows(gains)) { advance(gains, state, model); }

	outer_loop(gains, state, model, r);
	const Signals x = signals(gains, state, model, r);

	for (int j = 0; j < kAxes; j++) { v[j] = sum(inner_loop(gains, x, j), state.integral[j]); }
}

// Accepts a value within its range, otherwise holds the last valid one. True: invalid for too long.
[[gnu::always_inline]] inline bool accept(float value, float limit, float &held, int32_t &age, uint32_t &fault_count)
{
	if (unlikely(!within(value, limit))) {
		fault_count++;

		if (age <= kHoldSamples) { age++; }

		return age > kHoldSamples;
	}

	held = value;
	age = 0;
	return false;
}

// Returns the bits of Output::fault.
[[gnu::always_inline]] inline int32_t accept_inputs(State &state, const Input &input)
{
	int32_t failed = 0;
	const float pole = state.gains.derivative_pole;
	const float filter_gain = (1.0F - pole) / state.gains.period;
	uint32_t fault_count = state.fault_count;

	for (int i = 0; i < kAxes; i++) {
		if (accept(input.attitude_setpoint[i], kMaxAngle, state.setpoint[i], state.age[i], fault_count)) {
			failed |= 1 << i;
		}

		if (accept(input.attitude[i], kMaxAngle, state.attitude[i], state.age[kAxes + i], fault_count)) {
			failed |= 8 << i;
		}

		int32_t &age = state.age[2 * kAxes + i];
		const bool first = age > kHoldSamples;
		const float previous = state.rates[i];
		float derivative = pole * state.derivative[i];

		if (accept(input.rates[i], kMaxRate, state.rates[i], age, fault_count)) {
			failed |= 64 << i;
			derivative = 0.0F;

		} else if (unlikely(first)) {
			derivative = 0.0F;

		} else {
			derivative += filter_gain * (state.rates[i] - previous);
		}

		state.derivative[i] = derivative;
	}

	state.fault_count = fault_count;
	return failed;
}

// NaN means no excitation; any other value out of range is a fault.
float accept_excitation(float value, uint32_t &fault_count)
{
	if (!within(value, kMaxExcitation)) {
		if (within(value, __builtin_inff())) { fault_count++; }

		value = 0.0F;
	}

	return value;
}

// An input was invalid for too long: only damp the rates still measured. An axis without its rate gets no torque.
[[gnu::cold, gnu::noinline]] void damp_rates(State &state, int32_t failed, const Input &input, Output &output)
{
	const Gains &gains = state.gains;
	const int32_t lost = failed >> (2 * kAxes);
	state.model.running = 0;
	const float roll = (lost & 1) != 0 ? 0.0F : state.rates[0];
	const float pitch = (lost & 2) != 0 ? 0.0F : state.rates[1];

	for (int j = 0; j < kAxes; j++) {
		float moment = j == 2 ? -(gains.yaw_kp_i * state.rates[2]) - gains.yaw_kd_i * state.derivative[2]
			       : -row(gains.kp_i[j], roll, pitch) - row(gains.kd_i[j], state.derivative[0], state.derivative[1]);

		if ((lost & (1 << j)) != 0) { moment = 0.0F; }

		accept_excitation(input.excitation[j], state.fault_count);
		output.moment[j] = clamp(moment, gains.moment_max[j]);
		output.rates_setpoint[j] = 0.0F;
	}
}

// Normal operation, with anti-windup per axis. The integral is within its limit from the last period and is never -0,
// so a zero increment keeps its bits.
void control(State &state, const Input &input, Output &output)
{
	const Gains &gains = state.gains;
	const bool integrating = input.armed != 0 && input.landed == 0;
	const float period = integrating ? gains.period : 0.0F;

	if (follows(gains)) {
		advance(gains, state, state.model);
		state.model.running = input.armed;
	}

	outer_loop(gains, state, state.model, output.rates_setpoint);
	const Signals x = signals(gains, state, state.model, output.rates_setpoint);

	for (int j = 0; j < kAxes; j++) {
		const Terms terms = inner_loop(gains, x, j);
		const float excitation = accept_excitation(input.excitation[j], state.fault_count);
		const float limit = gains.moment_max[j];
		const float increment = period * terms.slope;
		const float before = state.integral[j];
		float integral = before + increment;
		float moment = sum(terms, integral) + excitation;
		bool held = false;

		if (increment > 0.0F) {
			held = moment > limit || input.saturation[j] > 0;

		} else if (increment < 0.0F) {
			held = moment < -limit || input.saturation[j] < 0;
		}

		if (unlikely(held || __builtin_fabsf(integral) > gains.integral_max[j])) {
			integral = held ? before : clamp(integral, gains.integral_max[j]);
			moment = sum(terms, integral) + excitation;
		}

		state.integral[j] = integral;
		output.moment[j] = clamp(moment, limit);
	}
}

}  // namespace

[[gnu::cold]] bool initialise(State &state, const Gains &gains)
{
	state = State{};

	for (int i = 0; i < 3 * kAxes; i++) { state.age[i] = kHoldSamples + 1; }

	const bool accepted = acceptable(gains);

	if (accepted) {
		state.gains = gains;

	} else {
		state.gains.period = 1.0F;  // all other gains and limits are 0, so the torque is 0
	}

	return accepted;
}

[[gnu::cold]] bool set_gains(State &state, const Gains &gains)
{
	if (!acceptable(gains)) { return false; }

	float before[kAxes];
	float rest[kAxes];
	evaluate(state.gains, state, before);
	clear_integral(state);
	evaluate(gains, state, rest);

	for (int j = 0; j < kAxes; j++) {
		const bool unused = j == 2 ? within(gains.yaw_ki_i, 0.0F)
				    : within(gains.ki_i[j][0], 0.0F) && within(gains.ki_i[j][1], 0.0F);
		state.integral[j] = unused ? 0.0F : clamp(before[j] - rest[j], gains.integral_max[j]);
	}

	state.gains = gains;

	if (!follows(gains)) { state.model.running = 0; }

	return true;
}

void step(State &state, const Input &input, Output &output)
{
	const int32_t failed = accept_inputs(state, input);

	if (input.armed == 0) {
		clear_integral(state);
		state.model.running = 0;
	}

	if (failed != 0) {
		damp_rates(state, failed, input, output);

	} else {
		control(state, input, output);
	}

	output.fault = failed;
	output.fault_count = state.fault_count;
}

}  // namespace mimopilot
