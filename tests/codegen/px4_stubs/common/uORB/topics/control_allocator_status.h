#pragma once

#include <uORB/uORB.h>

struct control_allocator_status_s {
	uint64_t timestamp;
	float unallocated_torque[3];
	float unallocated_thrust[3];
	int8_t actuator_saturation[16];
	uint16_t handled_motor_failure_mask;
	bool torque_setpoint_achieved;
	bool thrust_setpoint_achieved;
};

ORB_DECLARE(control_allocator_status);
