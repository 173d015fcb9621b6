#pragma once
#include <uORB/uORB.h>

struct event_s {
	uint64_t timestamp;
	uint32_t id;
	uint16_t event_sequence;
	uint8_t arguments[25];
	uint8_t log_levels;
};
