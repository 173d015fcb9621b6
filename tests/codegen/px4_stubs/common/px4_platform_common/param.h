#pragma once

#include <stdint.h>

// The test generates it from module.yaml, as PX4's build does.
#include "generated_parameters.hpp"

using param_t = uint16_t;

#define PARAM_INVALID static_cast<param_t>(0xffff)
#define PARAM_TYPE_INT32 1
#define PARAM_TYPE_FLOAT 2

inline param_t param_handle(px4::params p) { return static_cast<param_t>(p); }
inline param_t param_find(const char *name) { return static_cast<param_t>(px4::find(name)); }
inline int param_type(param_t handle) { return px4::kFloat[handle] ? PARAM_TYPE_FLOAT : PARAM_TYPE_INT32; }
inline void param_set_used(param_t) {}

inline int param_get(param_t handle, float *value)
{
	*value = static_cast<float>(px4::values()[handle]);
	return 0;
}

inline int param_get(param_t handle, int32_t *value)
{
	*value = static_cast<int32_t>(px4::values()[handle]);
	return 0;
}
