#pragma once

#include <uORB/uORB.h>

struct hover_thrust_estimate_s {
	uint64_t timestamp;
	float hover_thrust;
	bool valid;
};

ORB_DECLARE(hover_thrust_estimate);
