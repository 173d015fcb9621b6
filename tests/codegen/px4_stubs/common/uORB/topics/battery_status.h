#pragma once

#include <uORB/uORB.h>

struct battery_status_s {
	uint64_t timestamp;
	float scale;
	bool connected;
};

ORB_DECLARE(battery_status);
