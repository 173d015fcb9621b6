// Decides which controller flies, and with which parameters. Needs no firmware.
#pragma once

#include <stdint.h>

#include "mimo_parameters.h"
#include "mimo_pid.hpp"

namespace mimopilot
{

// Parameters arrive one by one, so the set is half written at times. It is read as a whole, and only on the ground: when
// the vehicle starts, and each time EN goes from 0 to 1. A set with a value out of its range changes nothing. With one
// that was stored for another firmware, the firmware's PID controller flies.
class Take
{
public:
	// `period_kept`: the gains are for the rate of the firmware. Else nothing flies.
	void start(bool period_kept);

	// One period. True: this controller flies.
	bool step(const MimoParameters &parameters, bool flying, State &controller);

	MimoState state() const { return _state; }

	// Place of the first bad parameter of a refused set, from 1; 0: none. The last place of all and one more: values of
	// which each is in its range, but together too large for the period.
	int refused() const { return _refused; }

private:
	void take(const MimoParameters &parameters, State &controller);

	bool _asked{true};  // EN has been 0 since the last set was taken, or the vehicle has started
	bool _flies{false};
	bool _foreign{false};  // the last set is for another firmware
	int _refused{0};
	MimoState _state{kMimoStock};
	Gains _taken{};
};

}  // namespace mimopilot
