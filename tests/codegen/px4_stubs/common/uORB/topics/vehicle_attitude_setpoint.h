#pragma once

#include <uORB/uORB.h>

struct vehicle_attitude_setpoint_s {
	uint64_t timestamp;
	float yaw_sp_move_rate;
	float q_d[4];
	float thrust_body[3];
};

ORB_DECLARE(vehicle_attitude_setpoint);
