// The excitation: a pseudo-random binary torque, added to the controller output on one axis, or on one after the
// other. Needs no autopilot, so that any machine can compile and test it.
#pragma once

#include <stdint.h>

namespace mimopilot
{

// Alternates between +1 and -1, each held for a random number of samples from hold_min to hold_max inclusive.
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
	int32_t axis;       // 0 none; 1 roll, 2 pitch, 4 yaw; 3 roll then pitch, 5 roll, pitch, then yaw
	float amplitude[3]; // normalised torque on each axis
	int32_t hold_min;   // samples; yaw's pulses are kYawHold times longer
	int32_t hold_max;   // samples
	int32_t duration;   // samples on each axis
	int32_t pause;      // samples between the axes
	int32_t seed;
	float tilt_max;     // rad
	float period;       // s, of a sample
};

struct ExcitationConditions {
	bool ready;             // armed, in the air, in the chosen mode, measurements valid
	float tilt;             // rad
	float yaw_rate;         // rad/s
	float sticks[4];        // -1 to 1; all 0 without a remote control
};

// An axis chosen after 0 requests one run. It starts when the vehicle is ready. It stops early if the vehicle is no
// longer ready, tilts too far, or a stick moves; on yaw also if it turns too fast or too far. An axis already set at the
// first configure(), such as a parameter left from an earlier flight, requests nothing.
class Excitation
{
public:
	// Numbered as in logs, where waiting is off.
	enum class Phase : int8_t { Waiting = -2, Off = -1, Roll = 0, Pitch = 1, Pause = 2, Yaw = 3 };
	enum class End : uint8_t { None, Finished, Cancelled, NotReady, Tilt, Sticks, Settings, Turn };

	void configure(const ExcitationSettings &settings);

	// Ends a run, also one that waits.
	void cancel()
	{
		if (_phase != Phase::Off) { stop(End::NotReady); }
	}

	void step(const ExcitationConditions &conditions, float (&moment)[3]);

	Phase phase() const { return _phase; }
	End end() const { return _end; }
	bool running() const { return _phase >= Phase::Roll; }

	// Whether yaw is excited, or was last.
	bool on_yaw() const { return _axis == 2; }

	// By the yaw rate since yaw's excitation began, rad: an estimator's heading reset is no turn.
	float turned() const { return _turned; }

private:
	void stop(End reason);
	void begin(int32_t axis);
	void advance();
	int32_t last() const { return _settings.axis >> 1; }  // axis to excite
	End fault(const ExcitationConditions &conditions) const;

	ExcitationSettings _settings{};
	Prbs _prbs{};
	Phase _phase{Phase::Off};
	End _end{End::None};
	bool _configured{false};
	int32_t _chosen{0};  // axis of the last configure()
	int32_t _left{0};    // samples, this phase
	int32_t _axis{0};    // 0 roll, 1 pitch, 2 yaw: this one, or the last before the pause
	float _turned{0.0F}; // rad
	float _sticks[4] {}; // at the start
};

// For the console and the ground station, without the prefix of the parameters.
const char *describe(Excitation::Phase phase);
const char *describe(Excitation::End end);

}  // namespace mimopilot
