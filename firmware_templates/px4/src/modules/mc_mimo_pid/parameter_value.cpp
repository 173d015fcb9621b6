#include "parameter_value.hpp"

namespace mimopilot {

float parameter_value(px4::params name)
{
	const param_t handle = param_handle(name);
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

}  // namespace mimopilot
