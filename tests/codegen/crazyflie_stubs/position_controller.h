#pragma once
#include "stabilizer_types.h"

void positionControllerResetAllPID(float x, float y, float z);
void positionControllerResetAllfilters();
void positionController(float *thrust, attitude_t *attitude, const setpoint_t *setpoint, const state_t *state);
