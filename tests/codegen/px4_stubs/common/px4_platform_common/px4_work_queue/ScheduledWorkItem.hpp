#pragma once

#include <px4_platform_common/px4_work_queue/WorkItem.hpp>

namespace px4 {

// Defined by the host program: runs an item once when its time has come.
class ScheduledWorkItem : public WorkItem
{
public:
	void ScheduleDelayed(uint32_t delay_us);
	void ScheduleClear();

protected:
	using WorkItem::WorkItem;
	~ScheduledWorkItem() override { ScheduleClear(); }
};

}  // namespace px4
