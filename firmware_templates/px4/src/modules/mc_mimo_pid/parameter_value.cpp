#include "parameter_value.hpp"

namespace mimopilot
{

namespace
{

float value_of(param_t handle)
{
	float number = 0.0F;

	if (param_type(handle) == PARAM_TYPE_FLOAT) {
		param_get(handle, &number);

	} else {
		int32_t whole = 0;
		param_get(handle, &whole);
		number = static_cast<float>(whole);
	}

	return number;
}

}  // namespace

float parameter_value(px4::params name) { return value_of(param_handle(name)); }

float parameter_value(const char *name, float fallback)
{
	const param_t handle = param_find(name);
	return handle == PARAM_INVALID ? fallback : value_of(handle);
}

}  // namespace mimopilot
