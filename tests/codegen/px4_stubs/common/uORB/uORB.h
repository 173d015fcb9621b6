#pragma once

#include <stdint.h>

struct orb_metadata {
	const char *o_name;
	uint16_t o_size;
};

#define ORB_ID(name) &__orb_##name
#define ORB_DECLARE(name) extern "C" const struct orb_metadata __orb_##name

using orb_advert_t = void *;

// As in PX4, what is not a template is not inline: the size of the compiled module is then near that in PX4.
orb_advert_t orb_advertise(const orb_metadata *meta, const void *data);

namespace uORB {

// Defined by the host program. As in PX4, a topic that one publisher unadvertises stays so although others publish to it,
// until somebody advertises it again, and is not read meanwhile.
class Manager
{
public:
	static void *orb_add_internal_subscriber(const orb_metadata *meta);
	static bool is_advertised(const void *node);
	static unsigned updates_available(const void *node, unsigned last_generation);
	static bool orb_data_copy(void *node, void *dst, unsigned &generation, bool only_if_updated);
	static int orb_publish(const orb_metadata *meta, orb_advert_t handle, const void *data);
	static int orb_unadvertise(orb_advert_t handle);
};

}  // namespace uORB
