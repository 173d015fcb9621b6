#pragma once

#include <px4_platform_common/px4_work_queue/WorkItem.hpp>
#include <uORB/SubscriptionInterval.hpp>

namespace uORB {

extern px4::WorkItem *scheduled;  // defined by the host program: runs when the gyro publishes

class SubscriptionCallbackWorkItem : public Subscription
{
public:
	SubscriptionCallbackWorkItem(px4::WorkItem *item, const orb_metadata *meta) : Subscription(meta), _item(item) {}

	bool registerCallback();
	void unregisterCallback();

private:
	px4::WorkItem *_item;
};

}  // namespace uORB
