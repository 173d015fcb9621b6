// Who flies: this module or PX4's own controllers. Changes in the air, both ways. Needs no PX4.
#pragma once

#include <stdint.h>

namespace mimopilot
{

class HandOver
{
public:
	enum class Action : uint8_t {
		None,
		StopStock,      // stop PX4's own controllers
		StartAttitude,  // start the attitude controller alone, whose manual thrust starts from zero
		StartStock,     // start them; this module no longer publishes
	};

	struct Conditions {
		bool wanted;     // by MIMO_EN or its switch
		bool able;       // this module could fly now
		bool faulty;     // in the air with an invalid input
		bool busy;       // PX4's own controllers are just being stopped or started
		bool torque_free;  // nobody else advertises the torque
		bool manual_thrust;  // in the air by sticks
	};

	// Once a sample; `now` in us. The module publishes torque if it flies() afterwards.
	Action step(uint64_t now, const Conditions &conditions);

	bool flies() const { return _flies; }

	// After a fault in the air PX4's own controllers fly until this module was not wanted for once.
	bool gave_up() const { return _gave_up; }

	// Whether PX4's own controllers must be started before this module stops.
	bool replaces() const { return _replaces; }

private:
	static constexpr uint64_t kFaultTime = 500000;  // us
	static constexpr uint64_t kRampTime = 2200000;  // us; mc_att_control raises its manual thrust by 50 % a second
	static constexpr int kFreeSamples = 2;
	static constexpr int kPatience = 250;           // samples until PX4's controllers are stopped again

	bool _flies{false};
	bool _gave_up{false};
	bool _replaces{false};  // PX4's own controllers were stopped for this module
	uint64_t _valid{0};     // us, when the inputs were last valid
	uint64_t _ramp{0};      // us, when the attitude controller was started ahead; 0: it was not
	bool _published{false}; // they advertised the torque when they were told to stop
	int _free{0};           // samples since the topic is free
	int _waited{0};
};

}  // namespace mimopilot
