// The excitation experiment: a pseudo-random binary moment, added after the controller, on roll, on pitch, or on
// one after the other. No PX4 in here: it is compiled and tested on any machine.
#pragma once

#include <stdint.h>

namespace mimopilot {

// Two values of alternating sign, each held for a random number of samples, hold_min to hold_max, both included.
class Prbs
{
public:
	void restart(uint32_t seed, int32_t hold_min, int32_t hold_max);
	float next();  // +1 or -1

private:
	uint32_t random();

	uint32_t _state{1};
	int32_t _hold_min{1};
	int32_t _hold_max{1};
	int32_t _left{0};
	float _sign{1.0F};
};

struct ExcitationSettings {
	int32_t axis;       // 0 none, 1 roll, 2 pitch, 3 roll then pitch
	float amplitude;    // dimensionless moment
	int32_t hold_min;   // samples
	int32_t hold_max;   // samples
	int32_t duration;   // samples on each axis
	int32_t pause;      // samples between the axes
	int32_t seed;
	float tilt_max;     // rad, on roll and pitch
};

struct ExcitationConditions {
	bool ready;             // armed, in the air, in the chosen mode, measurements valid
	float attitude[2];      // rad, roll and pitch
	float sticks[4];        // -1 to 1; all 0 without a remote control
};

// Choosing an axis asks for one run. It begins when the vehicle is ready, and ends by itself or when the vehicle is no
// longer ready, tilts too far, or a stick moves; another run needs axis 0 first. What was chosen before the
// first configure(), such as a parameter left from an earlier flight, asks for nothing.
class Excitation
{
public:
	enum class Phase : int8_t { Off = -1, Roll = 0, Pitch = 1, Pause = 2, Waiting = 3 };
	enum class End : uint8_t { None, Finished, Cancelled, NotReady, Tilt, Sticks, Settings };

	void configure(const ExcitationSettings &settings);
	void step(const ExcitationConditions &conditions, float (&moment)[3]);

	Phase phase() const { return _phase; }
	End end() const { return _end; }
	bool running() const { return _phase == Phase::Roll || _phase == Phase::Pitch || _phase == Phase::Pause; }

private:
	void stop(End reason);
	void begin(Phase phase);
	void advance();
	End fault(const ExcitationConditions &conditions) const;

	ExcitationSettings _settings{};
	Prbs _prbs{};
	Phase _phase{Phase::Off};
	End _end{End::None};
	bool _configured{false};
	int32_t _chosen{0};  // axis of the last configure()
	int32_t _left{0};    // samples of this phase
	float _sticks[4]{};  // where they were at the beginning
};

}  // namespace mimopilot
