#pragma once
#include <stdint.h>
#define HAL_LOGGING_ENABLED 1
namespace AP_HAL { inline uint64_t micros64() { return 0; } }
