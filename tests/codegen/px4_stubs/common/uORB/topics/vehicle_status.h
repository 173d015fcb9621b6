#pragma once

#include <uORB/uORB.h>

struct vehicle_status_s {
	static constexpr uint8_t VEHICLE_TYPE_ROTARY_WING = 1;

	uint64_t timestamp;
	uint64_t armed_time;
	uint8_t arming_state;
	uint8_t nav_state;
	uint8_t vehicle_type;
	bool is_vtol;
};

ORB_DECLARE(vehicle_status);
