#pragma once

#include <stdint.h>

#include <vector>

struct orb_metadata {
	const char *o_name;
	uint16_t o_size;
};

#define ORB_ID(name) &__orb_##name
#define ORB_DECLARE(name) extern "C" const struct orb_metadata __orb_##name

namespace uORB {

// A topic and its last message.
struct Node {
	std::vector<uint8_t> message;
	unsigned generation{0};
	bool advertised{false};
};

Node &node(const orb_metadata *meta);  // defined by the host program

}  // namespace uORB
