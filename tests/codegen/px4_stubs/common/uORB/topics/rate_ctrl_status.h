#pragma once

#include <uORB/uORB.h>

struct rate_ctrl_status_s {
	uint64_t timestamp;
	float rollspeed_integ;
	float pitchspeed_integ;
	float yawspeed_integ;
};

ORB_DECLARE(rate_ctrl_status);
