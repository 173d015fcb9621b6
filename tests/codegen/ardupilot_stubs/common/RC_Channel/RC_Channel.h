#pragma once

#include <stdint.h>

class RC_Channel
{
public:
    float norm_input_ignore_trim() const { return position; }

    float position = 0;
};

class RC_Channels
{
public:
    bool has_valid_input() const { return true; }
    RC_Channel *channel(uint8_t i) { return i < 4 ? &channels[i] : nullptr; }

    RC_Channel channels[4];
};

inline RC_Channels &rc()
{
    static RC_Channels one;
    return one;
}
