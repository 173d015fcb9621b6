// What this module cannot fly fails PX4's arming check, with an event and a text that a ground station shows.
#pragma once

#include <uORB/Publication.hpp>
#include <uORB/Subscription.hpp>
#include <uORB/topics/arming_check_reply.h>
#include <uORB/topics/arming_check_request.h>
#include <uORB/topics/register_ext_component_reply.h>
#include <uORB/topics/register_ext_component_request.h>
#include <uORB/topics/unregister_ext_component.h>

namespace mimopilot
{

// Null: this module could fly.
struct Obstacle {
	const char *text{nullptr};
	uint32_t event{0};
};

Obstacle wrong_vehicle();
Obstacle wrong_gyro_rate();
Obstacle wrong_parameter();
Obstacle autotune_enabled();

class ArmingCheck
{
public:
	// Once a sample. PX4 takes a registration while disarmed.
	void answer(uint64_t now, const Obstacle &obstacle);

	void unregister();

private:
	void ask(uint64_t now);

	uORB::Subscription _register_reply_sub{ORB_ID(register_ext_component_reply)};
	uORB::Subscription _request_sub{ORB_ID(arming_check_request)};
	uORB::Publication<register_ext_component_request_s> _register_pub{ORB_ID(register_ext_component_request)};
	uORB::Publication<unregister_ext_component_s> _unregister_pub{ORB_ID(unregister_ext_component)};
	uORB::Publication<arming_check_reply_s> _reply_pub{ORB_ID(arming_check_reply)};

	uint64_t _asked{0};  // us, when it asked for registration
	int8_t _id{-1};      // of the registration
};

}  // namespace mimopilot
