#pragma once

#include <stdint.h>

// The test generates it from module.yaml, as PX4's build does.
#include "generated_parameters.hpp"

using param_t = uint16_t;

#define PARAM_INVALID static_cast<param_t>(0xffff)
#define PARAM_TYPE_INT32 1
#define PARAM_TYPE_FLOAT 2

inline param_t param_handle(px4::params p) { return static_cast<param_t>(p); }

// Defined by the host program.
param_t param_find(const char *name);
const char *param_name(param_t handle);
int param_type(param_t handle);
void param_set_used(param_t handle);
int param_get_default_value(param_t handle, void *value);
int param_reset(param_t handle);
int param_get(param_t handle, float *value);
int param_get(param_t handle, int32_t *value);
