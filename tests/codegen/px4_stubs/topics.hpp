// Topics of the host program.
#pragma once

#include <string.h>
#include <uORB/Publication.hpp>
#include <uORB/Subscription.hpp>

#include <vector>

extern uint64_t now;  // us

namespace uORB {

// A topic and its last message.
struct Node {
	std::vector<uint8_t> message;
	unsigned generation{0};
	bool advertised{false};
};

Node &node(const orb_metadata *meta);

}  // namespace uORB

// The publisher outlives the module and never unadvertises the topic. It advertises again only if `again`.
template<typename T>
void publish(const orb_metadata *meta, const T &message, bool again = false)
{
	static uORB::Publication<T> *const publication = new uORB::Publication<T>(meta);

	if (again) { orb_advertise(meta, nullptr); }

	publication->publish(message);
}

template<typename T>
T last(const orb_metadata *meta)
{
	T message{};
	const uORB::Node &topic = uORB::node(meta);

	if (!topic.message.empty()) { memcpy(&message, topic.message.data(), sizeof(message)); }

	return message;
}

// What of PX4 runs beside the module.
bool stock_flies();           // mc_rate_control runs
void run_stock(const float (&torque)[3], const float (&integral)[3]);
void run_commander();
void run_tasks();
void run_scheduled();
