#pragma once

#include <uORB/uORB.h>

struct manual_control_setpoint_s {
	uint64_t timestamp;
	uint64_t timestamp_sample;
	float roll;
	float pitch;
	float yaw;
	float throttle;
	float flaps;
	float aux1;
	float aux2;
	float aux3;
	float aux4;
	float aux5;
	float aux6;
	bool valid;
	uint8_t data_source;
	bool sticks_moving;
};

ORB_DECLARE(manual_control_setpoint);
