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

// Code size, stack and step time have a budget, with -Os: the attributes below keep step() fast and the rest small.

constexpr float kInverted = 0.0045F;  // cosine of half the tilt below which, as in PX4, the error has no turn

[[gnu::always_inline]] inline bool unlikely(bool condition)
{
	return __builtin_expect(static_cast<long>(condition), 0L) != 0L;
}

[[gnu::always_inline]] inline int32_t bits_of(float value)
{
	int32_t bits;
	__builtin_memcpy(&bits, &value, sizeof(bits));
	return bits;
}

// Compares bit patterns: there, infinity and NaN exceed every number, whatever the optimisation flags.
[[gnu::always_inline]] inline bool within(float value, float limit)
{
	return static_cast<uint32_t>(bits_of(value)) << 1 <= static_cast<uint32_t>(bits_of(limit)) << 1;
}

[[gnu::always_inline]] inline float clamp(float value, float limit)
{
	if (unlikely(__builtin_fabsf(value) > limit)) { value = value > 0.0F ? limit : -limit; }

	return value;
}

[[gnu::noinline]] void clamp_axes(float (&values)[kAxes], const float (&limits)[kAxes])
{
	for (int j = 0; j < kAxes; j++) {
		if (__builtin_fabsf(values[j]) > limits[j]) { values[j] = values[j] > 0.0F ? limits[j] : -limits[j]; }
	}
}

[[gnu::always_inline]] inline float row(const float (&gain)[2], float roll, float pitch)
{
	return gain[0] * roll + gain[1] * pitch;
}

struct Quaternion {
	float w;
	float x;
	float y;
	float z;
};

[[gnu::always_inline]] inline Quaternion load(const float (&q)[4]) { return {q[0], q[1], q[2], q[3]}; }

[[gnu::always_inline]] inline void store(const Quaternion &q, float (&to)[4])
{
	to[0] = q.w;
	to[1] = q.x;
	to[2] = q.y;
	to[3] = q.z;
}

[[gnu::always_inline]] inline float length_squared(const Quaternion &q)
{
	return ((q.w * q.w + q.x * q.x) + q.y * q.y) + q.z * q.z;
}

[[gnu::always_inline]] inline bool is_rotation(const Quaternion &q)
{
	return within(length_squared(q) - 1.0F, kMaxNormError);
}

[[gnu::always_inline]] inline bool follows(const Gains &gains) { return !within(gains.model_omega, 0.0F); }

// One period of the attitude model, semi-implicit Euler. Returns the setpoint's heading, then the model's tilt.
[[gnu::always_inline]] inline Quaternion advance(State &state)
{
	const Gains &gains = state.gains;
	Model &model = state.flown.model;
	const float(&target)[4] = state.attitude_setpoint;
	const float length = __builtin_sqrtf(target[0] * target[0] + target[3] * target[3]);
	float cosine = 1.0F;  // of half the heading
	float sine = 0.0F;

	if (!unlikely(length < kInverted)) {
		const float inverse = 1.0F / length;
		cosine = target[0] * inverse;
		sine = target[3] * inverse;
	}

	// The direction of body z that is wanted, or measured: 2 imag of the tilt in the axes of that heading.
	const bool running = model.running != 0;
	const float(&q)[4] = running ? state.attitude_setpoint : state.attitude;
	const float x = cosine * q[1] + sine * q[2];
	const float y = cosine * q[2] - sine * q[1];
	float direction[kModelAxes] = {2.0F * x, 2.0F * y};

	if (!running) {  // the measured heading may differ
		const float w = cosine * q[0] + sine * q[3];
		const float z = cosine * q[3] - sine * q[0];
		const float upright = __builtin_sqrtf(w * w + z * z);

		if (!unlikely(upright < kInverted)) {
			const float scale = 2.0F / upright;
			direction[0] = scale * (x * w - y * z);
			direction[1] = scale * (y * w + x * z);
		}
	}

	model.running = 1;
	const float stiffness = gains.model_omega * gains.model_omega;
	const float friction = (2.0F * gains.model_damping) * gains.model_omega;

#pragma GCC unroll 2

	for (int j = 0; j < kModelAxes; j++) {
		float rate = 0.0F;
		float acceleration = 0.0F;
		float angle = direction[j];

		if (running) {
			acceleration = stiffness * (angle - model.angle[j]) - friction * model.rate[j];
			rate = model.rate[j] + gains.period * acceleration;
			angle = model.angle[j] + gains.period * rate;
		}

		model.acceleration[j] = acceleration;
		model.rate[j] = rate;
		model.angle[j] = angle;
	}

	const float roll = 0.5F * model.angle[0];
	const float pitch = 0.5F * model.angle[1];
	const float square = 1.0F - (roll * roll + pitch * pitch);
	const float tilt = square > 0.0F ? __builtin_sqrtf(square) : 0.0F;
	return {
		cosine * tilt,
		cosine *roll - sine * pitch,
		cosine *pitch + sine * roll,
		sine * tilt,
	};
}

// Attitude controller. The attitude model moves one period ahead. Sets the flown rate setpoint, and the acceleration of
// the attitude model in body axes. In rate mode r_i is given.
[[gnu::noinline]] void outer_loop(State &state)
{
	if (unlikely(state.rate_mode != 0)) { return; }

	// conj(q) target: the rotation from q to the target, in the axes of q.
	const Gains &gains = state.gains;
	const bool following = follows(gains);
	const Quaternion target = unlikely(following) ? advance(state) : load(state.attitude_setpoint);
	const Quaternion q = load(state.attitude);
	float w = ((q.w * target.w + q.x * target.x) + q.y * target.y) + q.z * target.z;
	float x = ((q.w * target.x - q.x * target.w) - q.y * target.z) + q.z * target.y;
	float y = ((q.w * target.y + q.x * target.z) - q.y * target.w) - q.z * target.x;
	float z = ((q.w * target.z - q.x * target.y) + q.y * target.x) - q.z * target.w;

	if (w < 0.0F) {
		w = -w;
		x = -x;
		y = -y;
		z = -z;
	}

	// It is a tilt (cosine, roll, pitch, 0), then a turn (w, 0, 0, z) / cosine; all are of half angles. The turn is
	// weighted: (turn, 0, 0, weight z) / length.
	const float square = w * w + z * z;
	const float cosine = __builtin_sqrtf(square);
	float roll = 2.0F * x;
	float pitch = 2.0F * y;
	float yaw = 0.0F;

	if (!unlikely(cosine < kInverted)) {
		const float turn = cosine - gains.yaw_weight * (cosine - w);
		const float weighted = gains.yaw_weight * z;
		const float scale = 2.0F / (cosine * __builtin_sqrtf(turn * turn + weighted * weighted));
		const float tilt_roll = x * w - y * z;
		const float tilt_pitch = y * w + x * z;
		roll = scale * (tilt_roll * turn + tilt_pitch * weighted);
		pitch = scale * (tilt_pitch * turn - tilt_roll * weighted);
		yaw = scale * (square * z);
	}

	// Earth's z axis in body axes, times the setpoint's yaw rate.
	const float yaw_rate = 2.0F * state.yaw_rate_setpoint;
	float roll_rate = row(gains.kp_o[0], roll, pitch) + yaw_rate * (q.x * q.z - q.w * q.y);
	float pitch_rate = row(gains.kp_o[1], roll, pitch) + yaw_rate * (q.y * q.z + q.w * q.x);
	const float turn_rate = gains.yaw_kp_o * yaw + yaw_rate * (0.5F - (q.x * q.x + q.y * q.y));

	if (unlikely(following)) {
		const Model &model = state.flown.model;
		const float share = unlikely(cosine < kInverted) ? 0.0F : (2.0F * z) / square;
		const float turn_cosine = 1.0F - share * z;
		const float turn_sine = share * w;
		const float roll_ahead = turn_cosine * model.rate[0] - turn_sine * model.rate[1];
		const float pitch_ahead = turn_sine * model.rate[0] + turn_cosine * model.rate[1];
		state.flown.acceleration[0] = turn_cosine * model.acceleration[0] - turn_sine * model.acceleration[1];
		state.flown.acceleration[1] = turn_sine * model.acceleration[0] + turn_cosine * model.acceleration[1];
		roll_rate += row(gains.kff_o[0], roll_ahead, pitch_ahead);
		pitch_rate += row(gains.kff_o[1], roll_ahead, pitch_ahead);
	}

	state.flown.rates[0] = roll_rate;
	state.flown.rates[1] = pitch_rate;
	state.flown.rates[2] = turn_rate;
	clamp_axes(state.flown.rates, gains.rate_max);
}

// v without the integral, and the integral's slope.
struct Torque {
	float rest[kAxes];
	float slope[kAxes];
};

[[gnu::noinline]] void rate_controller(const State &state, Torque &torque)
{
	const Gains &gains = state.gains;
	const float roll = state.flown.rates[0];
	const float pitch = state.flown.rates[1];
	const float yaw = state.flown.rates[2];
	const float roll_error = roll - state.rates[0];
	const float pitch_error = pitch - state.rates[1];
	const float yaw_error = yaw - state.rates[2];

	for (int j = 0; j < kModelAxes; j++) {
		float feedforward = row(gains.kff_i[j], roll, pitch);

		if (follows(gains)) {
			feedforward += row(gains.kaff_i[j], state.flown.acceleration[0], state.flown.acceleration[1]);
		}

		torque.rest[j] = (row(gains.kp_i[j], roll_error, pitch_error)
				  - row(gains.kd_i[j], state.derivative[0], state.derivative[1])) + feedforward;
		torque.slope[j] = row(gains.ki_i[j], roll_error, pitch_error);
	}

	torque.rest[2] = (gains.yaw_kp_i * yaw_error - gains.yaw_kd_i * state.derivative[2]) + gains.yaw_kff_i * yaw;
	torque.slope[2] = gains.yaw_ki_i * yaw_error;
}

[[gnu::always_inline]] inline void stop_model(Flown &flown)
{
	flown.model.running = 0;
	flown.acceleration[0] = flown.acceleration[1] = 0.0F;
}

// Ends what depends on past attitude setpoints. If disarmed, the integrals are zero; if an input failed, the rate
// setpoint.
[[gnu::cold, gnu::noinline]] void settle(State &state, int32_t armed, int32_t failed)
{
	state.slewing = 0;
	stop_model(state.flown);

	if (armed == 0) { state.integral[0] = state.integral[1] = state.integral[2] = 0.0F; }

	if (failed != 0) { state.flown.rates[0] = state.flown.rates[1] = state.flown.rates[2] = 0.0F; }
}

// Counts invalid samples, and those for which an input is still held. `missing` and the result are fault bits; the latter
// of inputs that are invalid for too long. The derivative of a rate starts again after that.
[[gnu::cold, gnu::noinline]] int32_t count_missing(State &state, int32_t missing, int32_t silent)
{
	int32_t expired = 0;

	for (uint32_t left = static_cast<uint32_t>(missing); left != 0U; left &= left - 1U) {
		const int i = __builtin_ctz(left);
		const int32_t bit = 1 << i;
		int32_t hold = (state.missing & bit) != 0 ? state.hold[i] : kHoldSamples;
		state.fault_count++;

		if (hold == 0 || (silent & bit) != 0) {
			expired |= bit;
			hold = 1;

			if (bit >= kRateFault) { state.rates[i - 2] = 0.0F; }
		}

		state.hold[i] = hold - 1;
	}

	uint32_t restarted = static_cast<uint32_t>(expired | state.expired) / kRateFault;

	for (int i = 0; restarted != 0U; i++, restarted >>= 1) {
		if ((restarted & 1U) != 0U) { state.derivative[i] = 0.0F; }
	}

	state.missing = missing;
	state.expired = expired;
	return state.rate_mode != 0 ? expired & ~kAttitudeFault : expired;
}

// NaN means none; any other value out of range is a fault. Returns 0 for both.
[[gnu::always_inline]] inline float optional(float value, float limit, uint32_t &fault_count)
{
	if (unlikely(!within(value, limit))) {
		if (within(value, __builtin_inff())) { fault_count++; }

		value = 0.0F;
	}

	return value;
}

// Turns the attitude setpoint towards the given one, within the slew limit. It starts at the measured attitude.
[[gnu::cold, gnu::noinline]] void slew(State &state, const Input &input)
{
	const float(&target)[4] = input.attitude_setpoint;
	const float(&q)[4] = state.slewing != 0 ? state.attitude_setpoint : state.attitude;
	const float angle = 0.5F * (state.gains.setpoint_slew * state.gains.period);  // quaternions turn by half angles
	float along = 0.0F;
	state.slewing = input.armed;

	for (int i = 0; i < 4; i++) { along += q[i] * target[i]; }

	float across[4];
	float square = 0.0F;

	for (int i = 0; i < 4; i++) {
		across[i] = target[i] - along * q[i];
		square += across[i] * across[i];
	}

	const float distance = __builtin_sqrtf(square);

	if (distance <= angle) {
		__builtin_memcpy(state.attitude_setpoint, target, sizeof(target));
		return;
	}

	const float share = (along < 0.0F ? -angle : angle) / distance;
	square = 0.0F;

	for (int i = 0; i < 4; i++) {
		across[i] = q[i] + share * across[i];
		square += across[i] * across[i];
	}

	const float scale = 1.0F / __builtin_sqrtf(square);

	for (int i = 0; i < 4; i++) { state.attitude_setpoint[i] = scale * across[i]; }
}

// Takes over an attitude setpoint, within the slew limit. Returns false if it is invalid.
[[gnu::always_inline]] inline bool accept_attitude_setpoint(State &state, const Input &input)
{
	const Quaternion given = load(input.attitude_setpoint);

	if (unlikely(!is_rotation(given))) { return false; }

	if (unlikely(!within(state.gains.setpoint_slew, 0.0F))) {
		slew(state, input);

	} else {
		store(given, state.attitude_setpoint);
	}

	return true;
}

// Takes over a rate setpoint. Returns false if it is invalid.
[[gnu::cold, gnu::noinline]] bool accept_rates_setpoint(State &state, const Input &input)
{
	settle(state, 1, 0);

	for (int i = 0; i < kAxes; i++) {
		if (!within(input.rates_setpoint[i], kMaxRate)) { return false; }
	}

	for (int i = 0; i < kAxes; i++) { state.flown.rates[i] = input.rates_setpoint[i]; }

	return true;
}

// Returns the bits of Output::fault.
[[gnu::always_inline]] inline int32_t accept_inputs(State &state, const Input &input)
{
	int32_t missing = input.silent & kAllFaults;
	state.rate_mode = input.rate_mode;
	const Quaternion attitude = load(input.attitude);

	if (unlikely(!is_rotation(attitude))) {
		missing |= kAttitudeFault;

	} else {
		store(attitude, state.attitude);
	}

	if (!(unlikely(input.rate_mode != 0) ? accept_rates_setpoint(state, input) : accept_attitude_setpoint(state, input))) {
		missing |= kSetpointFault;
	}

	state.yaw_rate_setpoint = optional(input.yaw_rate_setpoint, kMaxRate, state.fault_count);

#pragma GCC unroll 3

	for (int i = 0; i < kAxes; i++) {
		const float before = state.rates[i];
		const bool invalid = !within(input.rates[i], kMaxRate);
		const float rate = invalid ? before : input.rates[i];

		if (invalid) { missing |= kRateFault << i; }

		state.derivative[i] = state.gains.derivative_pole * state.derivative[i] + state.derivative_gain * (rate - before);
		state.rates[i] = rate;
	}

	if (unlikely((missing | state.missing) != 0)) { return count_missing(state, missing, input.silent); }

	return 0;
}

// Torque u if an input was invalid for too long: without the integrals and the excitation. An axis without a valid rate,
// whose y_i is 0, gets none.
[[gnu::cold, gnu::noinline]] void damp(const Gains &gains, const Torque &torque, int32_t failed, float (&u)[kAxes])
{
	for (int j = 0; j < kAxes; j++) {
		u[j] = (failed >> j & kRateFault) != 0 ? 0.0F : torque.rest[j];
	}

	clamp_axes(u, gains.moment_max);
}

// Torque u, and the integrals, which do not grow further into saturation. An integral is within its limit from the last
// period and is never -0, so a zero increment keeps its bits.
[[gnu::always_inline]] inline void integrate(State &state, const Input &input, const Torque &torque, float (&u)[kAxes])
{
	const Gains &gains = state.gains;
	const float period = input.armed != 0 && input.landed == 0 ? gains.period : 0.0F;

	for (int j = 0; j < kAxes; j++) {
		const float rest = torque.rest[j] + optional(input.excitation[j], kMaxExcitation, state.fault_count);
		const float increment = period * torque.slope[j];
		const float limit = gains.moment_max[j];
		float integral = state.integral[j] + increment;
		float moment = rest + integral;
		const bool limited = __builtin_fabsf(moment) > limit;
		const int32_t saturation = input.saturation[j];

		if (unlikely(limited || saturation != 0 || __builtin_fabsf(integral) > gains.integral_max[j])) {
			const int32_t direction = bits_of(increment);
			const bool held = (limited && (direction ^ bits_of(moment)) >= 0)
					  || (saturation != 0 && (direction ^ saturation) >= 0);
			integral = held ? state.integral[j] : clamp(integral, gains.integral_max[j]);
			moment = clamp(rest + integral, limit);
		}

		state.integral[j] = integral;
		u[j] = moment;
	}
}

[[gnu::cold, gnu::noinline]] void copy(const Flown &from, Flown &to) { to = from; }

// Adds to the integrals, or subtracts, the rest of v in the next period, if the inputs stay as they are.
[[gnu::cold, gnu::noinline]] void add_next_rest(State &state, bool subtract)
{
	Flown flown;
	Torque torque;
	copy(state.flown, flown);
	outer_loop(state);
	rate_controller(state, torque);
	copy(flown, state.flown);

	for (int j = 0; j < kAxes; j++) { state.integral[j] += subtract ? -torque.rest[j] : torque.rest[j]; }
}

[[gnu::cold, gnu::noinline]] void take_over(const Gains &gains, State &state)
{
	state.gains = gains;
	state.derivative_gain = (1.0F - gains.derivative_pole) / gains.period;
}

}  // namespace

[[gnu::cold]] bool initialise(State &state, const Gains &gains)
{
	state = State{};

	state.missing = state.expired = kAllFaults;
	state.attitude[0] = state.attitude_setpoint[0] = 1.0F;

	const bool accepted = valid(gains);

	if (accepted) { take_over(gains, state); }  // else all gains and limits are 0, so the torque is 0

	return accepted;
}

[[gnu::cold]] bool set_gains(State &state, const Gains &gains)
{
	if (!valid(gains)) { return false; }

	add_next_rest(state, false);
	take_over(gains, state);
	add_next_rest(state, true);
	clamp_axes(state.integral, gains.integral_max);

	// An axis without integral gains has no integral.
	for (int j = 0; j < kModelAxes; j++) {
		if (within(gains.ki_i[j][0], 0.0F) && within(gains.ki_i[j][1], 0.0F)) { state.integral[j] = 0.0F; }
	}

	if (within(gains.yaw_ki_i, 0.0F)) { state.integral[2] = 0.0F; }

	if (!follows(gains)) { stop_model(state.flown); }

	return true;
}

void step(State &state, const Input &input, Output &output)
{
	const int32_t failed = accept_inputs(state, input);

	// An input that is missing now holds the rate setpoint.
	if (state.missing == 0) { outer_loop(state); }

	if (unlikely(input.armed == 0 || failed != 0)) { settle(state, input.armed, failed); }

	Torque torque;
	rate_controller(state, torque);

	if (unlikely(failed != 0)) {
		damp(state.gains, torque, failed, output.moment);

	} else {
		integrate(state, input, torque, output.moment);
	}

	static_assert(sizeof(output.rates_setpoint) == sizeof(state.flown.rates), "both are of all axes");
	__builtin_memcpy(output.rates_setpoint, state.flown.rates, sizeof(output.rates_setpoint));
	output.fault = failed;
	output.fault_count = state.fault_count;
}

}  // namespace mimopilot
