// Publishes topics for the emitted module and prints what it publishes, floats as 32-bit words. One command a line.
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>

#include <iostream>
#include <sstream>
#include <string>

#include <px4_platform_common/param.h>

#include "excitation.hpp"
#include "mc_mimo_pid.hpp"
#include "topics.hpp"

extern "C" int mc_mimo_pid_main(int argc, char *argv[]);

namespace {

uint64_t gyro_interval = 4000;
float stock_torque[3] {};
float stock_integral[3] {};
bool muted[3] {};  // attitude, setpoint, sticks: not published any more
vehicle_status_s vehicle{};

}  // namespace

namespace {

// A source that is alive says the same again.
template<typename T>
void repeat(const orb_metadata *meta, bool mute)
{
	if (mute || uORB::node(meta).message.empty()) { return; }

	T message = last<T>(meta);
	message.timestamp = now;
	publish(meta, message);
}

// One sample. True if the module published the torque.
bool gyro(const float (&rates)[3])
{
	repeat<vehicle_attitude_s>(ORB_ID(vehicle_attitude), muted[0]);
	repeat<vehicle_attitude_setpoint_s>(ORB_ID(vehicle_attitude_setpoint), muted[1]);
	repeat<manual_control_setpoint_s>(ORB_ID(manual_control_setpoint), muted[2]);
	vehicle_angular_velocity_s message{};
	message.timestamp = message.timestamp_sample = now;

	for (int i = 0; i < 3; i++) { message.xyz[i] = rates[i]; }

	publish(ORB_ID(vehicle_angular_velocity), message);
	run_commander();
	run_stock(stock_torque, stock_integral);
	const unsigned before = uORB::node(ORB_ID(vehicle_torque_setpoint)).generation;

	if (uORB::scheduled != nullptr) { uORB::scheduled->Run(); }

	const bool published = uORB::node(ORB_ID(vehicle_torque_setpoint)).generation != before;

	if (published && stock_flies()) { printf("two publishers\n"); }

	run_tasks();
	return published;
}

void words(const float *values, int count)
{
	for (int i = 0; i < count; i++) {
		uint32_t word;
		memcpy(&word, &values[i], sizeof(word));
		printf(" %08x", word);
	}
}

// torque, rate setpoint, integral, excitation, thrust; then the last attitude and attitude setpoint, of whoever.
void print_published()
{
	const auto torque = last<vehicle_torque_setpoint_s>(ORB_ID(vehicle_torque_setpoint));
	const auto rates = last<vehicle_rates_setpoint_s>(ORB_ID(vehicle_rates_setpoint));
	const auto status = last<rate_ctrl_status_s>(ORB_ID(rate_ctrl_status));
	auto excitation = last<debug_vect_s>(ORB_ID(debug_vect));

	if (excitation.timestamp != now) { excitation = {0, 0.0F, 0.0F, -1.0F, "silent"}; }

	const auto thrust = last<vehicle_thrust_setpoint_s>(ORB_ID(vehicle_thrust_setpoint));
	const auto attitude = last<vehicle_attitude_s>(ORB_ID(vehicle_attitude));
	const auto setpoint = last<vehicle_attitude_setpoint_s>(ORB_ID(vehicle_attitude_setpoint));
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
	words(attitude.q, 4);
	words(setpoint.q_d, 4);
	words(&setpoint.yaw_sp_move_rate, 1);
	printf(" %s\n", excitation.name);
	const auto parts = last<debug_array_s>(ORB_ID(debug_array));

	if (parts.timestamp == now) {
		printf("%s", parts.name);
		words(parts.data, 15);
		printf("\n");
	}
}

void module(const char *command)
{
	std::string name = "mc_mimo_pid";
	std::string argument = command;
	char *argv[] = {&name[0], &argument[0]};
	printf("exit %d\n", mc_mimo_pid_main(2, argv));
	run_tasks();
}

// At rest until the module has stopped PX4's own controllers, at most two seconds.
void wait_for_hand_over()
{
	const float still[3] = {};
	const uint64_t end = now + 2000000;

	while (stock_flies() && now < end) {
		now += gyro_interval;
		gyro(still);
	}
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

		if (command == "start") { wait_for_hand_over(); }

	} else if (command == "mute") {
		std::string source;
		line >> source;
		muted[source == "attitude" ? 0 : (source == "setpoint" ? 1 : 2)] = line.flag();

	} else if (command == "stock") {
		line.numbers(stock_torque);
		line.numbers(stock_integral);

	} else if (command == "wait") {
		long long left;
		line >> left;

		for (; left > 0; left -= 1000) {
			now += 1000;
			const unsigned before = uORB::node(ORB_ID(vehicle_torque_setpoint)).generation;
			run_scheduled();

			if (uORB::node(ORB_ID(vehicle_torque_setpoint)).generation != before) { print_published(); }

			run_tasks();
		}

	} else if (command == "arming") {
		const auto reply = last<arming_check_reply_s>(ORB_ID(arming_check_reply));
		printf("arming %d %d %d\n", static_cast<int>(reply.registration_id), static_cast<int>(reply.can_arm_and_run),
		       static_cast<int>(reply.num_events));

	} else if (command == "gyro") {
		long long step;
		float rates[3];
		line >> step;
		line.numbers(rates);
		now += static_cast<uint64_t>(step);
		const unsigned powers = uORB::node(ORB_ID(actuator_controls_status_0)).generation;
		const bool published = gyro(rates);

		if (uORB::node(ORB_ID(actuator_controls_status_0)).generation != powers) {
			const auto power = last<actuator_controls_status_s>(ORB_ID(actuator_controls_status_0));
			printf("power");
			words(power.control_power, 3);
			printf("\n");
		}

		if (published) {
			print_published();

		} else {
			const auto excitation = last<debug_vect_s>(ORB_ID(debug_vect));

			if (excitation.timestamp == now) {
				printf("excitation ended %g %g %g\n", static_cast<double>(excitation.x), static_cast<double>(excitation.y),
				       static_cast<double>(excitation.z));
			}

			printf("quiet\n");
		}

	} else if (command == "gyro_interval") {
		line >> gyro_interval;

	} else if (command == "param") {
		std::string name;
		line >> name;
		px4::set_value(name.c_str(), line.number());
		publish(ORB_ID(parameter_update), parameter_update_s{});

	} else if (command == "value") {
		std::string name;
		line >> name;
		printf("value %s %.9g\n", name.c_str(), px4::values()[px4::find(name.c_str())]);

	} else if (command == "mode") {
		vehicle_control_mode_s mode{};
		mode.flag_armed = line.flag();
		mode.flag_control_manual_enabled = line.flag();
		mode.flag_control_altitude_enabled = line.flag();
		mode.flag_control_attitude_enabled = line.flag();
		mode.flag_control_rates_enabled = true;
		vehicle.nav_state = static_cast<uint8_t>(line.number());
		mode.flag_control_offboard_enabled = line.flag();
		vehicle.nav_state_timestamp = now;
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
		position.unaided_heading = line.number();
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

		for (int i = 0; i < 6; i++) { (&sticks.aux1)[i] = line.number(); }

		sticks.timestamp = now;
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

	} else if (command == "rates_setpoint") {
		vehicle_rates_setpoint_s setpoint{};
		setpoint.timestamp = now + 1;  // later than what the module published at `now`
		setpoint.roll = line.number();
		setpoint.pitch = line.number();
		setpoint.yaw = line.number();
		line.numbers(setpoint.thrust_body);
		publish(ORB_ID(vehicle_rates_setpoint), setpoint);

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

int main()
{
	std::string text;
	vehicle.vehicle_type = vehicle_status_s::VEHICLE_TYPE_ROTARY_WING;
	vehicle.timestamp = now;
	publish(ORB_ID(vehicle_status), vehicle);
	vehicle_attitude_s level{};
	level.q[0] = level.delta_q_reset[0] = 1.0F;
	publish(ORB_ID(vehicle_attitude), level);
	px4::set_value("MIMO_EN", 1.0);

	while (std::getline(std::cin, text)) {
		Line line(text);
		execute(line);
	}

	return 0;
}
