#include "hand_over.hpp"

namespace mimopilot
{

HandOver::Action HandOver::step(uint64_t now, const Conditions &conditions)
{
	if (!conditions.wanted) { _gave_up = false; }

	if (_flies) {
		if (!conditions.faulty) { _valid = now; }

		_gave_up = _gave_up || now > _valid + kFaultTime;

		if (conditions.busy) { return Action::None; }

		if (conditions.wanted && !_gave_up) {
			const bool started = _ramp != 0;
			_ramp = 0;
			return started ? Action::StopStock : Action::None;
		}

		if (conditions.manual_thrust && !_gave_up) {
			if (_ramp == 0) {
				_ramp = now;
				return Action::StartAttitude;
			}

			if (now < _ramp + kRampTime) { return Action::None; }
		}

		_flies = _replaces = false;
		_ramp = 0;
		return Action::StartStock;
	}

	if (!_replaces) {
		if (conditions.busy || !conditions.wanted || _gave_up || !conditions.able) { return Action::None; }

		_replaces = true;
		_published = !conditions.torque_free;
		_free = _waited = 0;
		return Action::StopStock;
	}

	if (!conditions.wanted) {
		_replaces = conditions.busy;
		return conditions.busy ? Action::None : Action::StartStock;
	}

	// Once the topic is given up, whoever published it has gone. Without that sign, wait for the end of the stop.
	_free = conditions.torque_free && (_published || !conditions.busy) ? _free + 1 : 0;

	if (_free >= kFreeSamples) {
		_flies = true;
		_valid = now;

	} else if (++_waited > kPatience && !conditions.busy) {
		_replaces = false;
	}

	return Action::None;
}

}  // namespace mimopilot
