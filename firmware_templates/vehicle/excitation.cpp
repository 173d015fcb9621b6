#include "excitation.hpp"

namespace mimopilot
{

namespace
{

constexpr float kStickMove = 0.1F;       // of -1 to 1
constexpr float kMaxAmplitude = 0.5F;
constexpr float kMaxTilt = 1.0F;         // rad
constexpr float kMaxTurn = 0.8F;         // rad, on yaw; PX4's own autotune turns as far
constexpr float kMaxYawRate = 2.0F;      // rad/s, on yaw
constexpr int32_t kMaxSamples = 1000000;
constexpr int32_t kYawHold = 2;          // a unit of torque accelerates yaw 10 to 20 times less than roll
constexpr int32_t kYaw = 2;

// A range test rejects NaN too; optimisation flags may remove isfinite.
bool within(float value, float limit) { return __builtin_fabsf(value) <= limit; }
bool between(int32_t value, int32_t low, int32_t high) { return value >= low && value <= high; }

bool acceptable(const ExcitationSettings &settings)
{
	return between(settings.axis, 1, 5) && within(settings.amplitude[0], kMaxAmplitude)
	       && within(settings.amplitude[kYaw], kMaxAmplitude)
	       && between(settings.hold_min, 1, settings.hold_max) && settings.hold_max <= kMaxSamples
	       && between(settings.duration, 1, kMaxSamples)
	       && within(settings.tilt_max, kMaxTilt);
}

}  // namespace

void Prbs::restart(uint32_t seed, int32_t hold_min, int32_t hold_max)
{
	_state = (seed + 1U) * 2654435769U;

	if (_state == 0U) { _state = 1U; }  // xorshift never leaves 0

	_hold_min = hold_min;
	_hold_max = hold_max;
	_left = 0;

	for (int i = 0; i < 8; i++) { random(); }

	_sign = (random() & 0x10000U) != 0U ? 1.0F : -1.0F;
}

uint32_t Prbs::random()
{
	_state ^= _state << 13;
	_state ^= _state >> 17;
	_state ^= _state << 5;
	return _state;
}

float Prbs::next()
{
	if (_left == 0) {
		const uint32_t span = static_cast<uint32_t>(_hold_max - _hold_min) + 1U;
		_left = _hold_min + static_cast<int32_t>(random() % span);
		_sign = -_sign;
	}

	_left--;
	return _sign;
}

void Excitation::configure(const ExcitationSettings &settings)
{
	const bool asked = _configured && _chosen == 0 && settings.axis != 0;
	_configured = true;
	_chosen = settings.axis;

	if (settings.axis == 0) {
		if (_phase != Phase::Off) { stop(End::Cancelled); }

	} else if (asked) {
		if (acceptable(settings)) {
			_settings = settings;
			_phase = Phase::Waiting;
			_end = End::None;

		} else {
			stop(End::Settings);
		}
	}
}

void Excitation::step(const ExcitationConditions &conditions, float (&moment)[3])
{
	for (float &axis : moment) { axis = 0.0F; }

	if (_phase == Phase::Waiting && conditions.ready) {
		for (int i = 0; i < 4; i++) { _sticks[i] = conditions.sticks[i]; }

		if (fault(conditions) == End::None) { begin((_settings.axis & 1) != 0 ? 0 : last()); }
	}

	if (!running()) { return; }

	if (_phase == Phase::Yaw) { _turned += conditions.yaw_rate * _settings.period; }

	const End reason = fault(conditions);

	if (reason != End::None) {
		stop(reason);
		return;
	}

	if (_left == 0) { advance(); }

	if (running() && _phase != Phase::Pause) { moment[_axis] = _settings.amplitude[_axis] * _prbs.next(); }

	_left--;
}

Excitation::End Excitation::fault(const ExcitationConditions &conditions) const
{
	if (!conditions.ready) { return End::NotReady; }

	if (!within(conditions.tilt, _settings.tilt_max)) { return End::Tilt; }

	if (_phase == Phase::Yaw && !(within(_turned, kMaxTurn) && within(conditions.yaw_rate, kMaxYawRate))) {
		return End::Turn;
	}

	for (int i = 0; i < 4; i++) {
		if (!within(conditions.sticks[i] - _sticks[i], kStickMove)) { return End::Sticks; }
	}

	return End::None;
}

void Excitation::advance()
{
	if (_phase == Phase::Pause) {
		begin(_axis + 1);

	} else if (_axis < last()) {
		_phase = Phase::Pause;
		_left = _settings.pause;

	} else {
		stop(End::Finished);
	}
}

void Excitation::begin(int32_t axis)
{
	_axis = axis;
	_phase = axis == kYaw ? Phase::Yaw : static_cast<Phase>(axis);
	_left = _settings.duration;
	_turned = 0.0F;

	// Each axis has its own sequence, starting with a whole pulse.
	const int32_t longer = axis == kYaw ? kYawHold : 1;
	const uint32_t seed = 2U * static_cast<uint32_t>(_settings.seed) + static_cast<uint32_t>(axis);
	_prbs.restart(seed, longer * _settings.hold_min, longer * _settings.hold_max);
}

void Excitation::stop(End reason)
{
	_phase = Phase::Off;
	_end = reason;
	_left = 0;
}

const char *describe(Excitation::Phase phase)
{
	switch (phase) {
	case Excitation::Phase::Roll: return "roll";

	case Excitation::Phase::Pitch: return "pitch";

	case Excitation::Phase::Pause: return "pause";

	case Excitation::Phase::Yaw: return "yaw";

	case Excitation::Phase::Waiting: return "waiting";

	default: return "off";
	}
}

const char *describe(Excitation::End end)
{
	switch (end) {
	case Excitation::End::Finished: return "finished";

	case Excitation::End::Cancelled: return "cancelled";

	case Excitation::End::NotReady: return "stop: mode, ground or disarmed";

	case Excitation::End::Tilt: return "stop: EX_TILT";

	case Excitation::End::Turn: return "stop: turned";

	case Excitation::End::Sticks: return "stop: a stick moved";

	case Excitation::End::Settings: return "refused: EX_ out of range";

	default: return "none yet";
	}
}

}  // namespace mimopilot
