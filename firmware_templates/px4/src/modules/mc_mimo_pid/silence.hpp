// A topic keeps its last value when its publisher stops. Only its time tells.
#pragma once

#include <stdint.h>

#include "gains.hpp"

namespace mimopilot
{

// The longest age of a measurement, us: as long as the controller holds an invalid value.
constexpr uint64_t kHoldTime = static_cast<uint64_t>(1.0e6F * kHoldSamples *kGains.period);

// Whether a value from `timestamp`, us, is older than `longest`.
inline bool silent(uint64_t now, uint64_t timestamp, uint64_t longest) { return now > timestamp + longest; }

// Who makes the setpoint. PX4 declares off-board control and sticks lost by its own parameters, and then changes the
// mode. Until then, a slow sender is legal.
struct SetpointSource {
	uint64_t timestamp;    // us, of the last one
	uint64_t since;        // us: armed, or the mode entered
	float loss_time;       // s, after which PX4 declares it lost; 0 if PX4's own controllers make it, in every sample
};

inline bool silent(uint64_t now, const SetpointSource &source)
{
	const uint64_t last = source.timestamp > source.since ? source.timestamp : source.since;
	const float loss_time = source.loss_time > 0.0F && source.loss_time < 1.0e3F ? source.loss_time : 0.0F;
	return silent(now, last, kHoldTime + static_cast<uint64_t>(1.0e6F * loss_time));
}

}  // namespace mimopilot
