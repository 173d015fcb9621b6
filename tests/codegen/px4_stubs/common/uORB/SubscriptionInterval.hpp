#pragma once

#include <uORB/Subscription.hpp>

namespace uORB {

class SubscriptionInterval
{
public:
	SubscriptionInterval(const orb_metadata *meta, uint64_t interval_us) : _subscription(meta), _interval(interval_us) {}

	bool updated();
	bool copy(void *dst);

private:
	Subscription _subscription;
	uint64_t _interval;
	uint64_t _last{0};
};

}  // namespace uORB
