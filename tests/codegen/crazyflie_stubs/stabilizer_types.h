/* Stand-in for the Crazyflie's firmware: the names and types that our app uses, and the order of its structures' members
 * where that matters. Lines without # are read by the tests, too. */
#pragma once
#include <stdbool.h>
#include <stdint.h>

#define RATE_MAIN_LOOP 1000
#ifndef ATTITUDE_RATE
#define ATTITUDE_RATE 500
#endif
#define POSITION_RATE 100
#define RATE_DO_EXECUTE(RATE_HZ, TICK) ((TICK % (RATE_MAIN_LOOP / RATE_HZ)) == 0)

typedef struct { float roll; float pitch; float yaw; } attitude_t;
typedef struct { float x; float y; float z; } vector_t;
typedef vector_t point_t;
typedef vector_t velocity_t;
typedef vector_t Axis3f;
typedef struct { float x; float y; float z; float w; } quaternion_t;
typedef struct { Axis3f gyro; } sensorData_t;
typedef struct { attitude_t attitude; quaternion_t attitudeQuaternion; point_t position; velocity_t velocity; } state_t;
typedef enum { controlModeLegacy, controlModeForceTorque, controlModeForce } control_mode_t;
typedef struct { float thrustSi; float torqueX; float torqueY; float torqueZ; control_mode_t controlMode; } control_t;
typedef enum { modeDisable, modeAbs, modeVelocity } stab_mode_t;
typedef struct { stab_mode_t x, y, z, roll, pitch, yaw, quat; } setpoint_mode_t;
typedef struct {
	attitude_t attitude;
	attitude_t attitudeRate;
	quaternion_t attitudeQuaternion;
	float thrust;
	point_t position;
	velocity_t velocity;
	setpoint_mode_t mode;
} setpoint_t;

/* What the stand-in answers, and counts. */
struct firmware {
	bool flying;
	bool pid_passes;
	int pid_inits;
	int pid_calls;
	int position_calls;
	int position_resets;
	float thrust;
	uint32_t idle_thrust;
	attitude_t desired;
	char console[400];
};
extern struct firmware firmware;
