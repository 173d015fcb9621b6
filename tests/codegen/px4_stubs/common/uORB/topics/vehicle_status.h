#pragma once

#include <uORB/uORB.h>

struct vehicle_status_s {
	static constexpr uint8_t VEHICLE_TYPE_ROTARY_WING = 1;
	static constexpr uint8_t NAVIGATION_STATE_EXTERNAL1 = 23;

	uint64_t timestamp;
	uint64_t armed_time;
	uint64_t nav_state_timestamp;
	uint8_t arming_state;
	uint8_t nav_state;
	uint8_t vehicle_type;
	bool is_vtol;
};

ORB_DECLARE(vehicle_status);
