#pragma once

#include <stddef.h>
#include <stdint.h>
#include <uORB/topics/event.h>

namespace events {

enum class Log : uint8_t { Error = 3 };

// Not PX4's hash: any number that depends on the name.
template<size_t N>
constexpr uint32_t ID(const char (&name)[N])
{
	uint32_t sum = 0;

	for (size_t i = 0; i < N; i++) { sum = sum * 31U + static_cast<uint32_t>(name[i]); }

	return sum;
}

}  // namespace events
