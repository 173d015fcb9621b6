#pragma once

#include <uORB/uORB.h>

namespace uORB {

class Subscription
{
public:
	Subscription(const orb_metadata *meta, uint8_t = 0) : _node(Manager::orb_add_internal_subscriber(meta)) {}

	bool advertised() { return Manager::is_advertised(_node); }
	bool updated() { return Manager::updates_available(_node, _last_generation) > 0; }
	bool update(void *dst) { return Manager::orb_data_copy(_node, dst, _last_generation, true); }
	bool copy(void *dst) { return Manager::orb_data_copy(_node, dst, _last_generation, false); }
	unsigned get_last_generation() const { return _last_generation; }

private:
	void *_node;
	unsigned _last_generation{0};
};

}  // namespace uORB
