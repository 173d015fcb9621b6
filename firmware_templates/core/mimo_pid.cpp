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

namespace mimopilot
{

namespace
{

// Code size and step time have a budget: the attributes below keep step() fast and the rest small.

constexpr float kInverted = 0.0045F;  // cosine of half the tilt below which, as in PX4, the error has no turn

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

float root(float square) { return square > 0.0F ? __builtin_sqrtf(square) : 0.0F; }

float length_squared(const float (&q)[4]) { return ((q[0] * q[0] + q[1] * q[1]) + q[2] * q[2]) + q[3] * q[3]; }

template<typename Array> [[gnu::always_inline]] inline void copy(const Array &from, Array &to)
{
	__builtin_memcpy(&to, &from, sizeof(to));
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

// Heading of the setpoint: cosine and sine of half the angle.
struct Heading {
	float cosine;
	float sine;
};

[[gnu::always_inline]] inline Heading heading_of(const float (&q)[4])
{
	const float cosine = root(q[0] * q[0] + q[3] * q[3]);

	if (unlikely(cosine < kInverted)) { return {1.0F, 0.0F}; }

	const float inverse = 1.0F / cosine;
	return {q[0] *inverse, q[3] *inverse};
}

// The model at rest, with the measured direction of body z.
[[gnu::cold, gnu::noinline]] void start(const Heading &heading, const float (&q)[4], Model &model)
{
	const float cosine = root(q[0] * q[0] + q[3] * q[3]);
	const float scale = unlikely(cosine < kInverted) ? 0.0F : 2.0F / cosine;
	const float east = scale * (q[1] * q[0] - q[2] * q[3]);
	const float north = scale * (q[1] * q[3] + q[2] * q[0]);
	const float c = 1.0F - 2.0F * (heading.sine * heading.sine);
	const float s = 2.0F * (heading.sine * heading.cosine);
	model = Model{};
	model.angle[0] = c * east + s * north;
	model.angle[1] = c * north - s * east;
}

// One period of the attitude model, semi-implicit Euler. Attitude: the setpoint's heading, then the model's tilt.
[[gnu::noinline]] void advance(const Gains &gains, const State &state, Model &model, float (&attitude)[4])
{
	const float(&q)[4] = state.attitude_setpoint;
	const Heading heading = heading_of(q);

	if (model.running != 0) {
		const float omega = gains.model_omega;
		const float stiffness = omega * omega;
		const float friction = (2.0F * gains.model_damping) * omega;
		const float wanted[kModelAxes] = {
			2.0F * (heading.cosine *q[1] + heading.sine *q[2]),
			2.0F * (heading.cosine *q[2] - heading.sine *q[1]),
		};

		for (int j = 0; j < kModelAxes; j++) {
			const float acceleration = stiffness * (wanted[j] - model.angle[j]) - friction * model.rate[j];
			model.acceleration[j] = acceleration;
			model.rate[j] += gains.period * acceleration;
			model.angle[j] += gains.period * model.rate[j];
		}

	} else {
		start(heading, state.attitude, model);
	}

	const float roll = 0.5F * model.angle[0];
	const float pitch = 0.5F * model.angle[1];
	const float tilt = root(1.0F - (roll * roll + pitch * pitch));
	attitude[0] = heading.cosine * tilt;
	attitude[1] = heading.cosine * roll - heading.sine * pitch;
	attitude[2] = heading.cosine * pitch + heading.sine * roll;
	attitude[3] = heading.sine * tilt;
}

// Attitude controller: rate setpoint r. `acceleration`: of the attitude model, in body axes, rad/s^2.
[[gnu::noinline]] void outer_loop(const Gains &gains, const State &state, const Model &model, const float (&target)[4],
				  float (&r)[kAxes], float (&acceleration)[kModelAxes])
{
	// conj(q) target: the rotation from q to the target, in the axes of q.
	const float(&q)[4] = state.attitude;
	float w = ((q[0] * target[0] + q[1] * target[1]) + q[2] * target[2]) + q[3] * target[3];
	float x = ((q[0] * target[1] - q[1] * target[0]) - q[2] * target[3]) + q[3] * target[2];
	float y = ((q[0] * target[2] + q[1] * target[3]) - q[2] * target[0]) - q[3] * target[1];
	float z = ((q[0] * target[3] - q[1] * target[2]) + q[2] * target[1]) - q[3] * target[0];

	if (w < 0.0F) {
		w = -w;
		x = -x;
		y = -y;
		z = -z;
	}

	// It is a tilt (cosine, roll, pitch, 0), then a turn (w, 0, 0, z) / cosine; all are of half angles. The turn is
	// weighted: (turn, 0, 0, weight z) / length.
	const float square = w * w + z * z;
	const float cosine = root(square);
	float roll = 2.0F * x;
	float pitch = 2.0F * y;
	float yaw = 0.0F;

	if (cosine > kInverted) {
		const float turn = cosine - gains.yaw_weight * (cosine - w);
		const float weighted = gains.yaw_weight * z;
		const float scale = 2.0F / (cosine * root(turn * turn + weighted * weighted));
		const float tilt_roll = x * w - y * z;
		const float tilt_pitch = y * w + x * z;
		roll = scale * (tilt_roll * turn + tilt_pitch * weighted);
		pitch = scale * (tilt_pitch * turn - tilt_roll * weighted);
		yaw = scale * (square * z);
	}

	// Earth's z axis in body axes, times the setpoint's yaw rate.
	const float yaw_rate = 2.0F * state.yaw_rate_setpoint;
	float roll_rate = row(gains.kp_o[0], roll, pitch) + yaw_rate * (q[1] * q[3] - q[0] * q[2]);
	float pitch_rate = row(gains.kp_o[1], roll, pitch) + yaw_rate * (q[2] * q[3] + q[0] * q[1]);
	const float turn_rate = gains.yaw_kp_o * yaw + yaw_rate * (0.5F - (q[1] * q[1] + q[2] * q[2]));

	if (unlikely(follows(gains))) {
		float turn_cosine = 1.0F;
		float turn_sine = 0.0F;

		if (cosine > kInverted) {
			turn_cosine = (w * w - z * z) / square;
			turn_sine = (2.0F * (w * z)) / square;
		}

		const float rate[kModelAxes] = {
			turn_cosine *model.rate[0] - turn_sine *model.rate[1],
			turn_sine *model.rate[0] + turn_cosine *model.rate[1],
		};
		acceleration[0] = turn_cosine * model.acceleration[0] - turn_sine * model.acceleration[1];
		acceleration[1] = turn_sine * model.acceleration[0] + turn_cosine * model.acceleration[1];
		roll_rate += row(gains.kff_o[0], rate[0], rate[1]);
		pitch_rate += row(gains.kff_o[1], rate[0], rate[1]);
	}

	r[0] = clamp(roll_rate, gains.rate_max[0]);
	r[1] = clamp(pitch_rate, gains.rate_max[1]);
	r[2] = clamp(turn_rate, gains.rate_max[2]);
}

// Rate setpoint r of the present mode. The attitude model moves one period ahead.
[[gnu::always_inline]] inline void update_rates_setpoint(const Gains &gains, const State &state, Model &model,
		float (&r)[kAxes], float (&acceleration)[kModelAxes])
{
	if (unlikely(state.rate_mode != 0)) {
		if (&r != &state.rates_setpoint) { copy(state.rates_setpoint, r); }

	} else if (unlikely(follows(gains))) {
		float attitude[4];
		advance(gains, state, model, attitude);
		outer_loop(gains, state, model, attitude, r, acceleration);

	} else {
		outer_loop(gains, state, model, state.attitude_setpoint, r, acceleration);
	}
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

[[gnu::always_inline]] inline Signals signals(const Gains &gains, const State &state,
		const float (&acceleration)[kModelAxes], const float (&r)[kAxes])
{
	return {
		{r[0], r[1], r[2]},
		{r[0] - state.rates[0], r[1] - state.rates[1], r[2] - state.rates[2]},
		{state.derivative[0], state.derivative[1], state.derivative[2]},
		follows(gains),
		acceleration[0],
		acceleration[1],
	};
}

// Terms of v on one axis.
struct Terms {
	float proportional;
	float derivative;
	float feedforward;
	float slope;  // Ki e
};

[[gnu::always_inline]] inline Terms rate_terms(const Gains &gains, const Signals &x, int j)
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

// v without the integral.
float sum(const Terms &terms) { return (terms.proportional - terms.derivative) + terms.feedforward; }

[[gnu::cold, gnu::noinline]] void clear(State &state)
{
	for (float &integral : state.integral) { integral = 0.0F; }

	state.model.running = 0;
	state.slewing = 0;
}

// v of each axis without its integral.
[[gnu::cold, gnu::noinline]] void torque_of(const Gains &gains, const State &state, const float (&r)[kAxes],
		const float (&acceleration)[kModelAxes], float (&v)[kAxes])
{
	const Signals x = signals(gains, state, acceleration, r);

	for (int j = 0; j < kAxes; j++) { v[j] = sum(rate_terms(gains, x, j)); }
}

// The same with the rate setpoint of the next period, if the inputs stay as they are.
[[gnu::cold, gnu::noinline]] void next_torque(const Gains &gains, const State &state, float (&v)[kAxes])
{
	float r[kAxes];
	float acceleration[kModelAxes] = {};
	Model model = state.model;
	update_rates_setpoint(gains, state, model, r, acceleration);
	torque_of(gains, state, r, acceleration, v);
}

// Counts invalid samples, and the samples since the last valid one. `missing` and the result are fault bits; the latter
// of inputs that are invalid for too long. The derivative of a rate starts again after that.
[[gnu::cold, gnu::noinline]] int32_t count_missing(State &state, int32_t missing, int32_t silent)
{
	int32_t failed = 0;

	for (uint32_t bits = static_cast<uint32_t>(missing | state.missing); bits != 0U; bits &= bits - 1U) {
		const int i = __builtin_ctz(bits);
		int32_t &age = state.age[i];
		const bool first = age > kHoldSamples;

		if ((missing >> i & 1) == 0) {
			age = 0;

		} else {
			state.fault_count++;
			age = first || (silent >> i & 1) != 0 ? kHoldSamples + 1 : age + 1;
		}

		const bool expired = age > kHoldSamples;

		if (expired) { failed |= 1 << i; }

		if (i >= 2 && (first || expired)) {
			state.derivative[i - 2] = 0.0F;

			if (expired) { state.rates[i - 2] = 0.0F; }
		}
	}

	state.missing = missing;
	return state.rate_mode != 0 ? failed & ~kAttitudeFault : failed;
}

// NaN means none; any other value out of range is a fault. Returns 0 for both.
[[gnu::cold, gnu::noinline]] float optional(float value, float limit, uint32_t &fault_count)
{
	if (within(value, limit)) { return value; }

	if (within(value, __builtin_inff())) { fault_count++; }

	return 0.0F;
}

// Turns q towards `target` by at most half of `angle` of rotation; both are unit quaternions.
[[gnu::cold, gnu::noinline]] void slew(const float (&target)[4], float angle, float (&q)[4])
{
	float along = 0.0F;

	for (int i = 0; i < 4; i++) { along += q[i] * target[i]; }

	const float sign = along < 0.0F ? -1.0F : 1.0F;
	float across[4];
	float square = 0.0F;

	for (int i = 0; i < 4; i++) {
		across[i] = sign * (target[i] - along * q[i]);
		square += across[i] * across[i];
	}

	const float distance = root(square);

	if (distance <= angle) {
		copy(target, q);
		return;
	}

	const float step = angle / distance;
	square = 0.0F;

	for (int i = 0; i < 4; i++) {
		across[i] = q[i] + step * across[i];
		square += across[i] * across[i];
	}

	const float scale = 1.0F / root(square);

	for (int i = 0; i < 4; i++) { q[i] = scale * across[i]; }
}

[[gnu::always_inline]] inline bool is_rotation(const float (&q)[4])
{
	return within(length_squared(q) - 1.0F, kMaxNormError);
}

// Takes over an attitude setpoint, within the slew limit.
[[gnu::always_inline]] inline void move_setpoint(State &state, const Input &input)
{
	float(&q)[4] = state.attitude_setpoint;

	if (unlikely(!within(state.gains.setpoint_slew, 0.0F))) {
		if (state.slewing == 0) { copy(state.attitude, q); }

		state.slewing = input.armed;
		slew(input.attitude_setpoint, 0.5F * (state.gains.setpoint_slew * state.gains.period), q);

	} else {
		copy(input.attitude_setpoint, q);
	}
}

[[gnu::cold, gnu::noinline]] bool accept_rates_setpoint(State &state, const Input &input)
{
	state.slewing = 0;
	state.model.running = 0;
	state.acceleration[0] = state.acceleration[1] = 0.0F;

	for (float rate : input.rates_setpoint) {
		if (!within(rate, kMaxRate)) { return false; }
	}

	copy(input.rates_setpoint, state.rates_setpoint);
	return true;
}

// Replaces invalid rates by the last valid ones. Returns their fault bits.
[[gnu::cold, gnu::noinline]] int32_t check_rates(const State &state, float (&rates)[kAxes])
{
	int32_t missing = 0;

	for (int i = 0; i < kAxes; i++) {
		if (!within(rates[i], kMaxRate)) {
			missing |= kRateFault << i;
			rates[i] = state.rates[i];
		}
	}

	return missing;
}

// Returns the bits of Output::fault.
[[gnu::always_inline]] inline int32_t accept_inputs(State &state, const Input &input)
{
	int32_t missing = input.silent & kAllFaults;
	bool wanted = true;
	state.rate_mode = input.rate_mode;

	if (is_rotation(input.attitude)) {
		copy(input.attitude, state.attitude);

	} else {
		missing |= kAttitudeFault;
	}

	if (unlikely(input.rate_mode != 0)) {
		wanted = accept_rates_setpoint(state, input);

	} else if (is_rotation(input.attitude_setpoint)) {
		move_setpoint(state, input);

	} else {
		wanted = false;
	}

	if (!wanted) { missing |= kSetpointFault; }

	state.yaw_rate_setpoint = input.yaw_rate_setpoint;

	if (unlikely(!within(input.yaw_rate_setpoint, kMaxRate))) {
		state.yaw_rate_setpoint = optional(input.yaw_rate_setpoint, kMaxRate, state.fault_count);
	}

	const float pole = state.gains.derivative_pole;
	const float filter_gain = (1.0F - pole) / state.gains.period;

	float rates[kAxes] = {input.rates[0], input.rates[1], input.rates[2]};

	// Each is checked by itself only if their squares are large.
	if (unlikely(!within((rates[0] * rates[0] + rates[1] * rates[1]) + rates[2] * rates[2], kMaxRate * kMaxRate))) {
		missing |= check_rates(state, rates);
	}

#pragma GCC unroll 3

	for (int i = 0; i < kAxes; i++) {
		state.derivative[i] = pole * state.derivative[i] + filter_gain * (rates[i] - state.rates[i]);
		state.rates[i] = rates[i];
	}

	if (unlikely((missing | state.missing) != 0)) { return count_missing(state, missing, input.silent); }

	return 0;
}

// u of an axis at a limit of u or of its integral, or with unallocated torque. The integral does not grow further
// into saturation.
[[gnu::noinline]] float limited(float rest, float increment, float limit, float integral_max, int32_t saturation,
				float &integral)
{
	const float grown = integral + increment;
	const float moment = rest + grown;
	bool held = false;

	if (increment > 0.0F) {
		held = moment > limit || saturation > 0;

	} else if (increment < 0.0F) {
		held = moment < -limit || saturation < 0;
	}

	if (!held) { integral = clamp(grown, integral_max); }

	return clamp(rest + integral, limit);
}

// Torque u from the signals x, and the integrals. An integral is within its limit from the last period and is never -0,
// so a zero increment keeps its bits.
[[gnu::always_inline]] inline void inner_loop(const Gains &gains, const Input &input, const Signals &x,
		const float (&excitation)[kAxes], float period,
		float (&integrals)[kAxes], float (&u)[kAxes])
{
	for (int j = 0; j < kAxes; j++) {
		const Terms terms = rate_terms(gains, x, j);
		const float rest = sum(terms) + excitation[j];
		const float increment = period * terms.slope;
		const float grown = integrals[j] + increment;
		const float moment = rest + grown;
		const float limit = gains.moment_max[j];
		const float integral_max = gains.integral_max[j];

		if (unlikely(__builtin_fabsf(moment) > limit || __builtin_fabsf(grown) > integral_max
			     || input.saturation[j] != 0)) {
			u[j] = limited(rest, increment, limit, integral_max, input.saturation[j], integrals[j]);

		} else {
			integrals[j] = grown;
			u[j] = moment;
		}
	}
}

// An input was invalid for too long: r = 0, and the integrals and the excitation are left out. An axis without a valid
// rate, whose y_i is 0, gets no torque.
[[gnu::cold, gnu::noinline]] void damp_rates(State &state, int32_t failed, Output &output)
{
	const Gains &gains = state.gains;
	state.model.running = 0;
	state.slewing = 0;

	for (float &rate : state.rates_setpoint) { rate = 0.0F; }

	state.acceleration[0] = state.acceleration[1] = 0.0F;
	copy(state.rates_setpoint, output.rates_setpoint);
	torque_of(gains, state, state.rates_setpoint, state.acceleration, output.moment);

	for (int j = 0; j < kAxes; j++) {
		const bool lost = (failed & (kRateFault << j)) != 0;
		output.moment[j] = lost ? 0.0F : clamp(output.moment[j], gains.moment_max[j]);
	}
}

}  // namespace

[[gnu::cold]] bool initialise(State &state, const Gains &gains)
{
	state = State{};

	for (int32_t &age : state.age) { age = kHoldSamples + 1; }

	state.missing = kAllFaults;
	state.attitude[0] = state.attitude_setpoint[0] = 1.0F;

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
	float after[kAxes];
	next_torque(state.gains, state, before);
	next_torque(gains, state, after);

	for (int j = 0; j < kAxes; j++) {
		const bool unused = j == 2 ? within(gains.yaw_ki_i, 0.0F)
				    : within(gains.ki_i[j][0], 0.0F) && within(gains.ki_i[j][1], 0.0F);
		const float integral = (before[j] + state.integral[j]) - after[j];
		state.integral[j] = unused ? 0.0F : clamp(integral, gains.integral_max[j]);
	}

	state.gains = gains;

	if (!follows(gains)) {
		state.model.running = 0;
		state.acceleration[0] = state.acceleration[1] = 0.0F;
	}

	return true;
}

void step(State &state, const Input &input, Output &output)
{
	const Gains &gains = state.gains;
	const int32_t failed = accept_inputs(state, input);
	float excitation[kAxes];
	copy(input.excitation, excitation);

	// Each is checked by itself only if their squares are large.
	if (unlikely(!within((excitation[0] * excitation[0] + excitation[1] * excitation[1]) + excitation[2] * excitation[2],
			     kMaxExcitation * kMaxExcitation))) {
		for (float &value : excitation) { value = optional(value, kMaxExcitation, state.fault_count); }
	}

	if (input.armed == 0) { clear(state); }

	if (unlikely(failed != 0)) {
		damp_rates(state, failed, output);

	} else {
		// A setpoint or attitude that is missing now holds the rate setpoint.
		if ((state.missing & (kSetpointFault | kAttitudeFault)) == 0) {
			update_rates_setpoint(gains, state, state.model, state.rates_setpoint, state.acceleration);
			state.model.running = input.rate_mode != 0 ? 0 : input.armed;
		}

		copy(state.rates_setpoint, output.rates_setpoint);
		const Signals x = signals(gains, state, state.acceleration, state.rates_setpoint);
		const float period = input.armed != 0 && input.landed == 0 ? gains.period : 0.0F;
		inner_loop(gains, input, x, excitation, period, state.integral, output.moment);
	}

	output.fault = failed;
	output.fault_count = state.fault_count;
}

}  // namespace mimopilot
