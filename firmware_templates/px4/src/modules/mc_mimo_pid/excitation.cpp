#include "excitation.hpp"

namespace mimopilot
{

namespace
{

constexpr float kStickMove = 0.1F;       // of -1 to 1
constexpr float kMaxAmplitude = 0.5F;
constexpr float kMaxTilt = 1.0F;         // rad
constexpr int32_t kMaxSamples = 1000000;

// A range test rejects NaN too; optimisation flags may remove isfinite.
bool between(float value, float low, float high) { return value >= low && value <= high; }
bool between(int32_t value, int32_t low, int32_t high) { return value >= low && value <= high; }

bool acceptable(const ExcitationSettings &settings)
{
	return between(settings.axis, 1, 3) && between(settings.amplitude, 0.0F, kMaxAmplitude)
	       && between(settings.hold_min, 1, kMaxSamples) && between(settings.hold_max, settings.hold_min, kMaxSamples)
	       && between(settings.duration, 1, kMaxSamples) && between(settings.pause, 0, kMaxSamples)
	       && between(settings.tilt_max, 0.0F, kMaxTilt);
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

		if (fault(conditions) == End::None) {
			begin(_settings.axis == 2 ? Phase::Pitch : Phase::Roll);
		}
	}

	if (!running()) { return; }

	const End reason = fault(conditions);

	if (reason != End::None) {
		stop(reason);
		return;
	}

	if (_left == 0) { advance(); }

	if (_phase == Phase::Roll) { moment[0] = _settings.amplitude * _prbs.next(); }

	if (_phase == Phase::Pitch) { moment[1] = _settings.amplitude * _prbs.next(); }

	_left--;
}

Excitation::End Excitation::fault(const ExcitationConditions &conditions) const
{
	if (!conditions.ready) { return End::NotReady; }

	if (!between(conditions.tilt, 0.0F, _settings.tilt_max)) { return End::Tilt; }

	for (int i = 0; i < 4; i++) {
		if (!between(conditions.sticks[i] - _sticks[i], -kStickMove, kStickMove)) { return End::Sticks; }
	}

	return End::None;
}

void Excitation::advance()
{
	if (_phase == Phase::Roll && _settings.axis == 3) {
		begin(_settings.pause > 0 ? Phase::Pause : Phase::Pitch);

	} else if (_phase == Phase::Pause) {
		begin(Phase::Pitch);

	} else {
		stop(End::Finished);
	}
}

void Excitation::begin(Phase phase)
{
	_phase = phase;
	_left = phase == Phase::Pause ? _settings.pause : _settings.duration;

	// Each axis has its own sequence, starting with a whole pulse.
	const uint32_t seed = 2U * static_cast<uint32_t>(_settings.seed) + (phase == Phase::Pitch ? 1U : 0U);
	_prbs.restart(seed, _settings.hold_min, _settings.hold_max);
}

void Excitation::stop(End reason)
{
	_phase = Phase::Off;
	_end = reason;
	_left = 0;
}

}  // namespace mimopilot
