// Publishes topics for the emitted module and prints what it publishes, floats as 32-bit words. One command a line.
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>

#include <iostream>
#include <map>
#include <sstream>
#include <string>
#include <vector>

#include <px4_platform_common/param.h>

#include "attitude.hpp"
#include "excitation.hpp"
#include "mc_mimo_pid.hpp"

#define DEFINE_TOPIC(name) const orb_metadata __orb_##name{#name, sizeof(name##_s)}
extern "C" {
const orb_metadata __orb_actuator_controls_status_0{"actuator_controls_status_0", sizeof(actuator_controls_status_s)};
DEFINE_TOPIC(battery_status);
DEFINE_TOPIC(control_allocator_status);
DEFINE_TOPIC(debug_vect);
DEFINE_TOPIC(hover_thrust_estimate);
DEFINE_TOPIC(manual_control_setpoint);
DEFINE_TOPIC(parameter_update);
DEFINE_TOPIC(rate_ctrl_status);
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

extern "C" int mc_mimo_pid_main(int argc, char *argv[]);

namespace {

uint64_t now = 1000000;
uint64_t gyro_interval = 4000;
vehicle_status_s vehicle{};

}  // namespace

namespace uORB {

px4::WorkItem *scheduled = nullptr;

// A topic and its last message.
struct Node {
	std::vector<uint8_t> message;
	unsigned generation{0};
	bool advertised{false};
};

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

namespace {

template<typename T>
void publish(const orb_metadata *meta, const T &message)
{
	// Never unadvertised, because these publishers outlive the module.
	static uORB::Publication<T> *const publication = new uORB::Publication<T>(meta);
	publication->publish(message);
}

template<typename T>
T last(const orb_metadata *meta)
{
	T message{};
	uORB::Subscription(meta).copy(&message);
	return message;
}

void gyro(const float (&rates)[3])
{
	vehicle_angular_velocity_s message{};
	message.timestamp = message.timestamp_sample = now;

	for (int i = 0; i < 3; i++) { message.xyz[i] = rates[i]; }

	publish(ORB_ID(vehicle_angular_velocity), message);

	if (uORB::scheduled != nullptr) { uORB::scheduled->Run(); }
}

void words(const float *values, int count)
{
	for (int i = 0; i < count; i++) {
		uint32_t word;
		memcpy(&word, &values[i], sizeof(word));
		printf(" %08x", word);
	}
}

// torque, rate setpoint, integral, excitation, thrust; then the angles from the module's own functions.
void print_published()
{
	const auto torque = last<vehicle_torque_setpoint_s>(ORB_ID(vehicle_torque_setpoint));
	const auto rates = last<vehicle_rates_setpoint_s>(ORB_ID(vehicle_rates_setpoint));
	const auto status = last<rate_ctrl_status_s>(ORB_ID(rate_ctrl_status));
	const auto excitation = last<debug_vect_s>(ORB_ID(debug_vect));
	const auto thrust = last<vehicle_thrust_setpoint_s>(ORB_ID(vehicle_thrust_setpoint));
	const auto attitude = last<vehicle_attitude_s>(ORB_ID(vehicle_attitude));
	const auto setpoint = last<vehicle_attitude_setpoint_s>(ORB_ID(vehicle_attitude_setpoint));
	float angles[3];
	float wanted[3];
	mimopilot::angles(attitude.q, angles);
	mimopilot::setpoint_angles(setpoint.q_d, angles[2], wanted);
	printf("out %llu", static_cast<unsigned long long>(torque.timestamp_sample));
	words(torque.xyz, 3);
	words(&rates.roll, 1);
	words(&rates.pitch, 1);
	words(&rates.yaw, 1);
	words(&status.rollspeed_integ, 1);
	words(&status.pitchspeed_integ, 1);
	words(&status.yawspeed_integ, 1);
	words(&excitation.x, 1);
	words(&excitation.y, 1);
	words(&excitation.z, 1);
	words(thrust.xyz, 3);
	words(angles, 3);
	words(wanted, 3);
	words(setpoint.q_d, 4);
	words(&setpoint.yaw_sp_move_rate, 1);
	printf(" %s\n", excitation.name);
}

void module(const char *command)
{
	std::string name = "mc_mimo_pid";
	std::string argument = command;
	char *argv[] = {&name[0], &argument[0]};
	printf("exit %d\n", mc_mimo_pid_main(2, argv));
}

struct Line : std::istringstream {
	using std::istringstream::istringstream;

	float number()
	{
		std::string text;
		*this >> text;
		return strtof(text.c_str(), nullptr);
	}

	bool flag() { return number() > 0.0F; }

	template<int n>
	void numbers(float (&values)[n])
	{
		for (float &value : values) { value = number(); }
	}
};

void execute(Line &line)
{
	std::string command;
	line >> command;

	if (command == "start" || command == "stop" || command == "status") {
		module(command.c_str());

	} else if (command == "gyro") {
		long long step;
		float rates[3];
		line >> step;
		line.numbers(rates);
		now += static_cast<uint64_t>(step);
		const unsigned before = uORB::node(ORB_ID(vehicle_torque_setpoint)).generation;
		const unsigned powers = uORB::node(ORB_ID(actuator_controls_status_0)).generation;
		gyro(rates);

		if (uORB::node(ORB_ID(actuator_controls_status_0)).generation != powers) {
			const auto power = last<actuator_controls_status_s>(ORB_ID(actuator_controls_status_0));
			printf("power");
			words(power.control_power, 3);
			printf("\n");
		}

		if (uORB::node(ORB_ID(vehicle_torque_setpoint)).generation != before) {
			print_published();

		} else {
			printf("quiet\n");
		}

	} else if (command == "gyro_interval") {
		line >> gyro_interval;

	} else if (command == "param") {
		std::string name;
		line >> name;
		px4::set_value(name.c_str(), line.number());
		publish(ORB_ID(parameter_update), parameter_update_s{});

	} else if (command == "stock") {
		uORB::node(ORB_ID(vehicle_torque_setpoint)).advertised = line.flag();
		uORB::node(ORB_ID(vehicle_rates_setpoint)).advertised = line.flag();
		uORB::node(ORB_ID(vehicle_attitude_setpoint)).advertised = line.flag();

	} else if (command == "mode") {
		vehicle_control_mode_s mode{};
		mode.flag_armed = line.flag();
		mode.flag_control_manual_enabled = line.flag();
		mode.flag_control_altitude_enabled = line.flag();
		mode.flag_control_attitude_enabled = line.flag();
		mode.flag_control_rates_enabled = true;
		vehicle.nav_state = static_cast<uint8_t>(line.number());
		vehicle.armed_time = !mode.flag_armed ? 0 : (vehicle.armed_time == 0 ? now : vehicle.armed_time);
		publish(ORB_ID(vehicle_control_mode), mode);
		publish(ORB_ID(vehicle_status), vehicle);

	} else if (command == "vehicle") {
		vehicle.vehicle_type = static_cast<uint8_t>(line.number());
		vehicle.is_vtol = line.flag();
		publish(ORB_ID(vehicle_status), vehicle);

	} else if (command == "hover") {
		hover_thrust_estimate_s hover{};
		hover.valid = line.flag();
		hover.hover_thrust = line.number();
		publish(ORB_ID(hover_thrust_estimate), hover);

	} else if (command == "heading") {
		vehicle_local_position_s position{};
		position.heading_good_for_control = line.flag();
		publish(ORB_ID(vehicle_local_position), position);

	} else if (command == "battery") {
		battery_status_s battery{};
		battery.connected = line.flag();
		battery.scale = line.number();
		publish(ORB_ID(battery_status), battery);

	} else if (command == "land") {
		vehicle_land_detected_s land{};
		land.landed = line.flag();
		land.maybe_landed = line.flag();
		publish(ORB_ID(vehicle_land_detected), land);

	} else if (command == "sticks") {
		manual_control_setpoint_s sticks{};
		sticks.valid = line.flag();
		sticks.roll = line.number();
		sticks.pitch = line.number();
		sticks.yaw = line.number();
		sticks.throttle = line.number();
		publish(ORB_ID(manual_control_setpoint), sticks);

	} else if (command == "alloc") {
		control_allocator_status_s status{};
		status.torque_setpoint_achieved = line.flag();
		line.numbers(status.unallocated_torque);
		publish(ORB_ID(control_allocator_status), status);

	} else if (command == "setpoint") {
		vehicle_attitude_setpoint_s setpoint{};
		setpoint.timestamp = now;
		line.numbers(setpoint.q_d);
		setpoint.yaw_sp_move_rate = line.number();
		line.numbers(setpoint.thrust_body);
		publish(ORB_ID(vehicle_attitude_setpoint), setpoint);

	} else if (command == "attitude") {
		vehicle_attitude_s attitude{};
		attitude.timestamp = attitude.timestamp_sample = now;
		line.numbers(attitude.q);
		attitude.quat_reset_counter = static_cast<uint8_t>(line.number());
		line.numbers(attitude.delta_q_reset);
		publish(ORB_ID(vehicle_attitude), attitude);

	} else if (command == "prbs") {
		mimopilot::Prbs prbs;
		unsigned seed;
		int shortest;
		int longest;
		int count;
		line >> seed >> shortest >> longest >> count;
		prbs.restart(seed, shortest, longest);
		printf("prbs");

		for (int i = 0; i < count; i++) { printf(" %d", static_cast<int>(prbs.next())); }

		printf("\n");

	} else {
		printf("unknown command %s\n", command.c_str());
		exit(2);
	}
}

}  // namespace

// The gyro publishes while time passes.
int px4_usleep(unsigned microseconds)
{
	const uint64_t end = now + microseconds;
	const float still[3] = {};

	while (now + gyro_interval <= end) {
		now += gyro_interval;
		gyro(still);
	}

	return 0;
}

int main()
{
	std::string text;
	vehicle.vehicle_type = vehicle_status_s::VEHICLE_TYPE_ROTARY_WING;

	while (std::getline(std::cin, text)) {
		Line line(text);
		execute(line);
	}

	return 0;
}
