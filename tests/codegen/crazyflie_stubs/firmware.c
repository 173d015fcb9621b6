/* Stand-in for what the app calls in the firmware: the tests set what it answers, and count its calls. */
#include <setjmp.h>
#include <stdarg.h>
#include <stdio.h>
#include <string.h>

#include "app.h"
#include "controller_pid.h"
#include "debug.h"
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

uint32_t powerDistributionGetIdleThrust() { return firmware.idle_thrust; }

bool supervisorIsFlying(void) { return firmware.flying; }

/* The app's main function has no end: its task is stopped in a delay. */
static jmp_buf end_of_app;
static int delays;

void vTaskDelay(uint32_t ticks)
{
	(void)ticks;

	if (delays-- == 0) { longjmp(end_of_app, 1); }
}

void run_app(int allowed)
{
	delays = allowed;
	firmware.console[0] = 0;

	if (setjmp(end_of_app) == 0) { appMain(); }
}

int consolePrintf(const char *format, ...)
{
	const size_t used = strlen(firmware.console);
	va_list arguments;
	va_start(arguments, format);
	const int length = vsnprintf(firmware.console + used, sizeof(firmware.console) - used, format, arguments);
	va_end(arguments);
	return length;
}
