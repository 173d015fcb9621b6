#pragma once

#include <drivers/drv_hrt.h>
#include <uORB/Subscription.hpp>

namespace uORB {

class SubscriptionInterval
{
public:
	SubscriptionInterval(const orb_metadata *meta, uint64_t interval_us) : _subscription(meta), _interval(interval_us) {}

	bool updated() { return hrt_absolute_time() - _last >= _interval && _subscription.updated(); }

	bool copy(void *dst)
	{
		_last = hrt_absolute_time();
		return _subscription.copy(dst);
	}

private:
	Subscription _subscription;
	uint64_t _interval;
	uint64_t _last{0};
};

}  // namespace uORB
