// Reads one of PX4's parameters.
#pragma once

#include <px4_platform_common/param.h>

namespace mimopilot
{

// A whole number becomes a float of the same value, up to 2^24.
float parameter_value(px4::params name);

// By name, for a parameter that not every PX4 has: then `fallback`.
float parameter_value(const char *name, float fallback);

}  // namespace mimopilot
