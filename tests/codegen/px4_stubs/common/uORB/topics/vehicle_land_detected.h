#pragma once

#include <uORB/uORB.h>

struct vehicle_land_detected_s {
	uint64_t timestamp;
	bool freefall;
	bool ground_contact;
	bool maybe_landed;
	bool landed;
};

ORB_DECLARE(vehicle_land_detected);
