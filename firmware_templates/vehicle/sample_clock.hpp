// The controller has a fixed period: check that the gyro keeps it.
#pragma once

#include <stdint.h>

namespace mimopilot
{

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
	enum class Rate : uint8_t { Unknown, Kept, Wrong };

	explicit SampleClock(float period) : _period(period) {}

	// False: the time is not later than the last, so this is no new sample. Counts that, and an interval
	// outside 0.5 to 1.5 periods, as a fault.
	bool advance(uint64_t timestamp)
	{
		if (_last != 0U && timestamp <= _last) {
			_faults++;
			return false;
		}

		const float interval = 1.0e-6F * static_cast<float>(timestamp - _last);

		if (_last != 0U && (interval < 0.5F * _period || interval > 1.5F * _period)) { _faults++; }

		// A long silence is no rate.
		if (_first == 0U || interval > kPause) { begin(timestamp); }

		_last = timestamp;

		if (_last != _first) { _samples++; }

		if (_last - _first >= kWindow) {
			_rate = keeps_period(_first, _last, _samples, _period) ? Rate::Kept : Rate::Wrong;
			begin(timestamp);
		}

		return true;
	}

	uint32_t faults() const { return _faults; }

	// The mean rate over the last whole second.
	Rate rate() const { return _rate; }

private:
	static constexpr uint64_t kWindow = 1000000;  // us
	static constexpr float kPause = 0.1F;         // s

	void begin(uint64_t timestamp)
	{
		_first = timestamp;
		_samples = 0;
	}

	float _period;  // s
	uint64_t _last{0};
	uint64_t _first{0};  // of the window
	uint32_t _samples{0};
	uint32_t _faults{0};
	Rate _rate{Rate::Unknown};
};

}  // namespace mimopilot
