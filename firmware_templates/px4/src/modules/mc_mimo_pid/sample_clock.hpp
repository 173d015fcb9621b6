// The controller has a fixed period: check that the gyro keeps it.
#pragma once

#include <stdint.h>

namespace mimopilot {

// True if the mean of `samples` intervals from `first` to `last` (us) is one period (s), to 5 %.
inline bool keeps_period(uint64_t first, uint64_t last, uint32_t samples, float period)
{
	if (samples == 0U || last <= first) { return false; }

	const float mean = 1.0e-6F * static_cast<float>(last - first) / static_cast<float>(samples);
	return mean > 0.95F * period && mean < 1.05F * period;
}

class SampleClock
{
public:
	explicit SampleClock(float period) : _period(static_cast<uint64_t>(1.0e6F * period + 0.5F)) {}

	// False: the time is not later than the last, so this is no new sample. Counts that, and an interval
	// outside 0.5 to 1.5 periods, as a fault.
	bool advance(uint64_t timestamp)
	{
		if (_last != 0U && timestamp <= _last) {
			_faults++;
			return false;
		}

		const uint64_t interval = timestamp - _last;

		if (_last != 0U && (2U * interval < _period || 2U * interval > 3U * _period)) { _faults++; }

		_last = timestamp;
		return true;
	}

	uint32_t faults() const { return _faults; }

private:
	uint64_t _period;  // us
	uint64_t _last{0};
	uint32_t _faults{0};
};

}  // namespace mimopilot
