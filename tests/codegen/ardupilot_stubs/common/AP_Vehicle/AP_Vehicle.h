#pragma once

#include <stdint.h>

class AP_Vehicle
{
public:
    uint8_t get_mode() const { return mode; }
    bool get_likely_flying() const { return flying; }

    uint8_t mode = 5;
    bool flying = true;
};

namespace AP
{
inline AP_Vehicle *vehicle()
{
    static AP_Vehicle one;
    return &one;
}
}
