#pragma once
#include <uORB/topics/event.h>

struct arming_check_reply_s {
	uint64_t timestamp;
	event_s events[5];
	uint8_t request_id;
	uint8_t registration_id;
	uint8_t health_component_index;
	bool can_arm_and_run;
	uint8_t num_events;
};
ORB_DECLARE(arming_check_reply);
