/* Stand-in for what the app calls in the firmware: the tests set what it answers, and count its calls. */
#include "controller_pid.h"
#include "platform_defaults.h"
#include "position_controller.h"
#include "power_distribution.h"
#include "supervisor.h"

#include "FreeRTOS.h"
#include "task.h"

struct firmware firmware = {.pid_passes = true};

void controllerPidInit(void) { firmware.pid_inits++; }

bool controllerPidTest(void) { return firmware.pid_passes; }

void controllerPid(control_t *control, const setpoint_t *setpoint, const sensorData_t *sensors, const state_t *state,
		   const uint32_t step)
{
	(void)setpoint;
	(void)sensors;
	(void)state;
	(void)step;
	firmware.pid_calls++;
	control->controlMode = controlModeLegacy;
}

void positionControllerResetAllPID(float x, float y, float z)
{
	(void)x;
	(void)y;
	(void)z;
	firmware.position_resets++;
}

void positionControllerResetAllfilters(void) {}

void positionController(float *thrust, attitude_t *attitude, const setpoint_t *setpoint, const state_t *state)
{
	(void)setpoint;
	(void)state;
	firmware.position_calls++;
	*thrust = firmware.thrust;
	*attitude = firmware.desired;
}

float powerDistributionGetMaxThrust(void) { return 4.0f * THRUST_MAX; }

bool supervisorIsFlying(void) { return firmware.flying; }

void vTaskDelay(uint32_t ticks) { (void)ticks; }
