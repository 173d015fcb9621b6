// What of PX4 the module calls, and what runs beside it: topics, parameters, PX4's own controllers, the arming check.
#include <px4_platform_common/param.h>
#include <px4_platform_common/tasks.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <systemlib/mavlink_log.h>

#include <map>
#include <string>
#include <vector>

#include "mc_mimo_pid.hpp"
#include "topics.hpp"

#define DEFINE_TOPIC(name) const orb_metadata __orb_##name{#name, sizeof(name##_s)}
extern "C" {
const orb_metadata __orb_actuator_controls_status_0{"actuator_controls_status_0", sizeof(actuator_controls_status_s)};
DEFINE_TOPIC(arming_check_reply);
DEFINE_TOPIC(arming_check_request);
DEFINE_TOPIC(battery_status);
DEFINE_TOPIC(control_allocator_status);
DEFINE_TOPIC(debug_array);
DEFINE_TOPIC(debug_vect);
DEFINE_TOPIC(hover_thrust_estimate);
DEFINE_TOPIC(manual_control_setpoint);
DEFINE_TOPIC(parameter_update);
DEFINE_TOPIC(rate_ctrl_status);
DEFINE_TOPIC(register_ext_component_reply);
DEFINE_TOPIC(register_ext_component_request);
DEFINE_TOPIC(unregister_ext_component);
DEFINE_TOPIC(vehicle_angular_velocity);
DEFINE_TOPIC(vehicle_attitude);
DEFINE_TOPIC(vehicle_attitude_setpoint);
DEFINE_TOPIC(vehicle_control_mode);
DEFINE_TOPIC(vehicle_land_detected);
DEFINE_TOPIC(vehicle_local_position);
DEFINE_TOPIC(vehicle_rates_setpoint);
DEFINE_TOPIC(vehicle_status);
DEFINE_TOPIC(vehicle_thrust_setpoint);
DEFINE_TOPIC(vehicle_torque_setpoint);
}


uint64_t now = 1000000;

namespace uORB {

px4::WorkItem *scheduled = nullptr;

Node &node(const orb_metadata *meta)
{
	static std::map<const orb_metadata *, Node> nodes;
	return nodes[meta];
}

void *Manager::orb_add_internal_subscriber(const orb_metadata *meta) { return &node(meta); }
bool Manager::is_advertised(const void *node) { return static_cast<const Node *>(node)->advertised; }

unsigned Manager::updates_available(const void *node, unsigned last_generation)
{
	return is_advertised(node) ? static_cast<const Node *>(node)->generation - last_generation : 0;
}

bool Manager::orb_data_copy(void *node, void *dst, unsigned &generation, bool only_if_updated)
{
	const Node &topic = *static_cast<Node *>(node);

	if (!topic.advertised || topic.message.empty() || (only_if_updated && generation == topic.generation)) { return false; }

	memcpy(dst, topic.message.data(), topic.message.size());
	generation = topic.generation;
	return true;
}

int Manager::orb_publish(const orb_metadata *meta, orb_advert_t handle, const void *data)
{
	Node &topic = *static_cast<Node *>(handle);
	const uint8_t *const bytes = static_cast<const uint8_t *>(data);
	topic.message.assign(bytes, bytes + meta->o_size);
	topic.generation++;
	return 0;
}

int Manager::orb_unadvertise(orb_advert_t handle)
{
	static_cast<Node *>(handle)->advertised = false;
	return 0;
}

bool SubscriptionCallbackWorkItem::registerCallback()
{
	scheduled = _item;
	return true;
}

void SubscriptionCallbackWorkItem::unregisterCallback() { scheduled = nullptr; }

bool SubscriptionInterval::updated() { return hrt_absolute_time() - _last >= _interval && _subscription.updated(); }

bool SubscriptionInterval::copy(void *dst)
{
	_last = hrt_absolute_time();
	return _subscription.copy(dst);
}

}  // namespace uORB

orb_advert_t orb_advertise(const orb_metadata *meta, const void *)
{
	uORB::node(meta).advertised = true;
	return &uORB::node(meta);
}

hrt_abstime hrt_absolute_time() { return now; }

param_t param_find(const char *name) { return static_cast<param_t>(px4::find(name)); }
const char *param_name(param_t handle) { return px4::name(handle); }
int param_type(param_t handle) { return px4::kFloat[handle] ? PARAM_TYPE_FLOAT : PARAM_TYPE_INT32; }
void param_set_used(param_t) {}

int param_get_default_value(param_t handle, void *value)
{
	const auto real = static_cast<float>(px4::kDefaults[handle]);
	const auto whole = static_cast<int32_t>(px4::kDefaults[handle]);
	memcpy(value, px4::kFloat[handle] ? static_cast<const void *>(&real) : &whole, sizeof(real));
	return 0;
}

int param_reset(param_t handle)
{
	px4::values()[handle] = px4::kDefaults[handle];
	return 0;
}

int param_get(param_t handle, float *value)
{
	*value = static_cast<float>(px4::values()[handle]);
	return 0;
}

int param_get(param_t handle, int32_t *value)
{
	*value = static_cast<int32_t>(px4::values()[handle]);
	return 0;
}

perf_counter_t perf_alloc(enum perf_counter_type, const char *) { return nullptr; }
void perf_free(perf_counter_t) {}
void perf_begin(perf_counter_t) {}
void perf_end(perf_counter_t) {}
void perf_print_counter(perf_counter_t) {}

void px4_log(const char *level, const char *format, ...)
{
	va_list arguments;
	va_start(arguments, format);
	printf("log %s ", level);
	vprintf(format, arguments);
	printf("\n");
	va_end(arguments);
}

void mavlink_vasprintf(int severity, orb_advert_t *, const char *format, ...)
{
	va_list arguments;
	va_start(arguments, format);
	printf("log MAVLINK %d ", severity);
	vprintf(format, arguments);
	printf("\n");
	va_end(arguments);
}

namespace {

struct Task {
	px4_main_t entry;
	std::vector<std::string> arguments;
};

std::vector<Task> tasks;
std::map<px4::ScheduledWorkItem *, uint64_t> due;

// mc_att_control and mc_rate_control, as far as others see them.
bool attitude_runs = true;
bool rate_runs = true;
orb_advert_t torque_handle = nullptr;
orb_advert_t rates_handle = nullptr;

int command(bool &runs, orb_advert_t &handle, const char *name, const char *what)
{
	const bool start = strcmp(what, "start") == 0;
	printf("stock %s %s\n", name, what);

	if (start && runs) { printf("log ERROR already running\n"); }

	if (!start && runs && handle != nullptr) { uORB::Manager::orb_unadvertise(handle); }

	if (start != runs) { handle = nullptr; }

	runs = start;
	return 0;
}

}  // namespace

extern "C" int mc_att_control_main(int, char *argv[])
{
	const bool stops = attitude_runs && strcmp(argv[1], "stop") == 0;

	// It had published this one from the sticks.
	if (stops) { uORB::node(ORB_ID(vehicle_attitude_setpoint)).advertised = false; }

	return command(attitude_runs, rates_handle, "mc_att_control", argv[1]);
}

extern "C" int mc_rate_control_main(int, char *argv[])
{
	return command(rate_runs, torque_handle, "mc_rate_control", argv[1]);
}

bool stock_flies() { return rate_runs; }

void run_stock(const float (&torque)[3], const float (&integral)[3])
{
	if (attitude_runs) {
		vehicle_rates_setpoint_s rates{};

		if (rates_handle == nullptr) { rates_handle = orb_advertise(ORB_ID(vehicle_rates_setpoint), nullptr); }

		uORB::Manager::orb_publish(ORB_ID(vehicle_rates_setpoint), rates_handle, &rates);
	}

	if (rate_runs) {
		vehicle_torque_setpoint_s message{};
		message.timestamp = message.timestamp_sample = now;
		memcpy(message.xyz, torque, sizeof(torque));

		if (torque_handle == nullptr) { torque_handle = orb_advertise(ORB_ID(vehicle_torque_setpoint), nullptr); }

		uORB::Manager::orb_publish(ORB_ID(vehicle_torque_setpoint), torque_handle, &message);
		publish(ORB_ID(rate_ctrl_status), rate_ctrl_status_s{now, integral[0], integral[1], integral[2]}, true);
	}
}

// Registers one check and asks for it every 0.3 s.
void run_commander()
{
	static uORB::Subscription registration{ORB_ID(register_ext_component_request)};
	static uint64_t asked = 0;
	static uint8_t request_id = 0;
	register_ext_component_request_s wanted;

	if (registration.update(&wanted)) {
		register_ext_component_reply_s reply{};
		reply.request_id = wanted.request_id;
		memcpy(reply.name, wanted.name, sizeof(reply.name));
		reply.success = wanted.register_arming_check;
		reply.arming_check_id = 3;
		publish(ORB_ID(register_ext_component_reply), reply);
	}

	if (now >= asked + 300000) {
		arming_check_request_s request{};
		request.timestamp = asked = now;
		request.request_id = ++request_id;
		publish(ORB_ID(arming_check_request), request);
	}
}

int px4_task_spawn_cmd(const char *name, int, int, int, px4_main_t entry, char *const argv[])
{
	Task task{entry, {name}};

	for (int i = 0; argv != nullptr && argv[i] != nullptr; i++) { task.arguments.push_back(argv[i]); }

	tasks.push_back(task);
	return 1;
}

void run_tasks()
{
	while (!tasks.empty()) {
		Task task = tasks.front();
		tasks.erase(tasks.begin());
		std::vector<char *> argv;

		for (std::string &argument : task.arguments) { argv.push_back(&argument[0]); }

		argv.push_back(nullptr);
		task.entry(static_cast<int>(task.arguments.size()), argv.data());
	}
}

void px4::ScheduledWorkItem::ScheduleDelayed(uint32_t delay_us) { due[this] = now + delay_us; }
void px4::ScheduledWorkItem::ScheduleClear() { due.erase(this); }

void run_scheduled()
{
	for (const auto &item : std::map<px4::ScheduledWorkItem *, uint64_t>(due)) {
		if (now >= item.second && due.erase(item.first) > 0) { item.first->Run(); }
	}
}
