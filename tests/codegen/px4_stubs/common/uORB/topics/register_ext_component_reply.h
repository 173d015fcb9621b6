#pragma once
#include <uORB/uORB.h>

struct register_ext_component_reply_s {
	uint64_t timestamp;
	uint64_t request_id;
	char name[25];
	bool success;
	int8_t arming_check_id;
};
ORB_DECLARE(register_ext_component_reply);
