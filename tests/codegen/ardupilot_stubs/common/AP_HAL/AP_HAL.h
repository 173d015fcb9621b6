#pragma once
#include <stdint.h>
#define HAL_LOGGING_ENABLED 1
namespace AP_HAL
{
inline uint64_t &clock()
{
    static uint64_t us = 1000000;
    return us;
}

inline uint64_t micros64() { return clock(); }
}
