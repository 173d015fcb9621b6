#pragma once

#include <uORB/uORB.h>

struct vehicle_local_position_s {
	uint64_t timestamp;
	bool heading_good_for_control;
	float unaided_heading;
};

ORB_DECLARE(vehicle_local_position);
