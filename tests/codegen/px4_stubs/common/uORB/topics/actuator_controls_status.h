#pragma once

#include <uORB/uORB.h>

struct actuator_controls_status_s {
	uint64_t timestamp;
	float control_power[3];
};

ORB_DECLARE(actuator_controls_status_0);
