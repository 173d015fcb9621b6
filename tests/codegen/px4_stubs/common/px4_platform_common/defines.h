#pragma once
#include <math.h>
#include <stdint.h>

#define PX4_OK 0
#define PX4_ERROR (-1)
#define PX4_ISFINITE(x) __builtin_isfinite(x)
#define __EXPORT __attribute__((visibility("default")))


namespace time_literals {
constexpr uint64_t operator"" _s(unsigned long long seconds) { return seconds * 1000000ULL; }
}
