#pragma once

#include <uORB/uORB.h>

struct debug_vect_s {
	uint64_t timestamp;
	float x;
	float y;
	float z;
	char name[10];
};

ORB_DECLARE(debug_vect);
