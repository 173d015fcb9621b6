#pragma once

#include <stdint.h>

class RCMapper
{
public:
    uint8_t roll() const { return 1; }
    uint8_t pitch() const { return 2; }
    uint8_t throttle() const { return 3; }
    uint8_t yaw() const { return 4; }
};

namespace AP
{
inline RCMapper *rcmap()
{
    static RCMapper one;
    return &one;
}
}
