// What the module reads from PX4's topics in each sample.
#include <drivers/drv_hrt.h>
#include <float.h>
#include <string.h>

#include "attitude.hpp"
#include "mc_mimo_pid.hpp"

using namespace mimopilot;

void McMimoPid::update_inputs(hrt_abstime now)
{
	_vehicle_status_sub.update(&_status);
	_manual_control_setpoint_sub.update(&_manual);
	_vehicle_control_mode_sub.update(&_control_mode);

	vehicle_land_detected_s land_detected;

	if (_vehicle_land_detected_sub.update(&land_detected)) {
		_landed = land_detected.landed;
		_on_ground = land_detected.landed || land_detected.maybe_landed;
	}

	control_allocator_status_s allocator_status;

	if (_control_allocator_status_sub.update(&allocator_status)) {
		for (int i = 0; i < kAxes; i++) {
			const float missing = allocator_status.torque_setpoint_achieved ? 0.0F : allocator_status.unallocated_torque[i];
			_input.saturation[i] = missing > FLT_EPSILON ? 1 : (missing < -FLT_EPSILON ? -1 : 0);
		}
	}

	_input.armed = _control_mode.flag_armed ? 1 : 0;
	_input.landed = _on_ground ? 1 : 0;
	update_stock_inputs();
	update_attitude();
	update_setpoint();
	update_silence(now);
}

void McMimoPid::update_stock_inputs()
{
	hover_thrust_estimate_s hover;

	if (_hover_thrust_estimate_sub.update(&hover)) { _throttle.estimate(_settings, hover.valid, hover.hover_thrust); }

	vehicle_local_position_s position;

	if (_vehicle_local_position_sub.update(&position)) {
		_heading.good = position.heading_good_for_control;
		_heading.unaided = position.unaided_heading;
	}

	battery_status_s battery;

	if (_battery_status_sub.update(&battery) && battery.connected) { _actuation.battery(battery.scale); }

	const float armed_for = 1.0e-6F * static_cast<float>(hrt_absolute_time() - _status.armed_time);
	const bool spooled_up = _control_mode.flag_armed && armed_for > _settings.spool_up_time;
	_throttle.update(_settings, _landed, spooled_up, kGains.period);
}

void McMimoPid::update_attitude()
{
	vehicle_attitude_s attitude;

	if (!_vehicle_attitude_sub.update(&attitude)) { return; }

	if (_attitude_seen && attitude.quat_reset_counter != _quat_reset_counter) {
		const float turn = heading(attitude.delta_q_reset);

		if (PX4_ISFINITE(turn)) { _sticks.shift(turn); }

		if (attitude.timestamp > _setpoint_time) { rotate(attitude.delta_q_reset, _input.attitude_setpoint); }

		_state.slewing = 0;  // a setpoint on its way is of the old heading: it starts again at the attitude
	}

	_attitude_seen = true;
	_attitude_time = attitude.timestamp;
	_quat_reset_counter = attitude.quat_reset_counter;
	memcpy(_input.attitude, attitude.q, sizeof(_input.attitude));
	const float angle = heading(attitude.q);

	if (PX4_ISFINITE(angle)) { _heading.angle = angle; }
}

bool McMimoPid::flown_by_sticks() const
{
	return _control_mode.flag_control_manual_enabled && !_control_mode.flag_control_altitude_enabled
	       && !_control_mode.flag_control_velocity_enabled && !_control_mode.flag_control_position_enabled;
}

void McMimoPid::update_setpoint()
{
	const bool rate_mode = _control_mode.flag_control_rates_enabled && !_control_mode.flag_control_attitude_enabled;
	const bool external_rates = rate_mode && !_control_mode.flag_control_manual_enabled;
	_input.rate_mode = rate_mode ? 1 : 0;

	// Until the other program's first message.
	if (external_rates && !_external_rates) { memset(_input.rates_setpoint, 0, sizeof(_input.rates_setpoint)); }

	_external_rates = external_rates;

	if (flown_by_sticks() && !rate_mode) {
		make_setpoint_from_sticks();
		return;
	}

	_sticks.release();

	if (rate_mode) {
		update_rates_setpoint();
		return;
	}

	vehicle_attitude_setpoint_s setpoint;

	if (_vehicle_attitude_setpoint_sub.update(&setpoint)) {
		memcpy(_input.attitude_setpoint, setpoint.q_d, sizeof(_input.attitude_setpoint));
		_input.yaw_rate_setpoint = setpoint.yaw_sp_move_rate;
		_setpoint_time = setpoint.timestamp;
		set_thrust(setpoint.thrust_body);
	}
}

// Acro's sticks, or another program's rates. A rate that is NaN is not to be controlled: it stays as measured.
void McMimoPid::update_rates_setpoint()
{
	vehicle_rates_setpoint_s setpoint;

	if (!_external_rates) {
		const StickInput input{_manual.roll, _manual.pitch, _manual.yaw, _manual.throttle};
		acro_rates(_settings, input, _input.rates_setpoint);
		const float thrust[3] = {0.0F, 0.0F, -acro_thrust(input)};
		set_thrust(thrust);
		_setpoint_time = hrt_absolute_time();

	} else if (_vehicle_rates_setpoint_sub.update(&setpoint) && setpoint.timestamp > _rates_published) {
		const float rates[kAxes] = {setpoint.roll, setpoint.pitch, setpoint.yaw};

		for (int i = 0; i < kAxes; i++) { _input.rates_setpoint[i] = PX4_ISFINITE(rates[i]) ? rates[i] : _input.rates[i]; }

		_setpoint_time = setpoint.timestamp;
		set_thrust(setpoint.thrust_body);
	}
}

// A thrust that is NaN stays as it was.
void McMimoPid::set_thrust(const float (&thrust)[3])
{
	for (int i = 0; i < 3; i++) {
		if (PX4_ISFINITE(thrust[i])) { _thrust[i] = thrust[i]; }
	}
}

void McMimoPid::make_setpoint_from_sticks()
{
	const StickInput input{_manual.roll, _manual.pitch, _manual.yaw, _manual.throttle};
	const StickSetpoint sticks = _sticks.setpoint(_settings, input, _heading, kGains.period);
	const float thrust[3] = {0.0F, 0.0F, -_throttle.thrust(_settings, _manual.throttle)};
	memcpy(_input.attitude_setpoint, sticks.q_d, sizeof(_input.attitude_setpoint));
	_input.yaw_rate_setpoint = sticks.yaw_rate;
	set_thrust(thrust);
	_setpoint_time = hrt_absolute_time();

	if (!_hand_over.flies()) { return; }

	vehicle_attitude_setpoint_s setpoint{};
	memcpy(setpoint.q_d, sticks.q_d, sizeof(setpoint.q_d));
	memcpy(setpoint.thrust_body, _thrust, sizeof(_thrust));
	setpoint.yaw_sp_move_rate = sticks.yaw_rate;
	setpoint.timestamp = _setpoint_time;
	_vehicle_attitude_setpoint_pub.publish(setpoint);
}

void McMimoPid::update_silence(hrt_abstime now)
{
	SetpointSource source;
	const bool sticks = _control_mode.flag_control_manual_enabled && !_control_mode.flag_control_altitude_enabled;
	source.timestamp = sticks ? _manual.timestamp : _setpoint_time;
	source.since = _status.nav_state_timestamp > _status.armed_time ? _status.nav_state_timestamp : _status.armed_time;
	source.loss_time = 0.0F;

	if (sticks) {
		source.loss_time = _settings.sticks_loss_time;

	} else if (_control_mode.flag_control_offboard_enabled
		   || _status.nav_state >= vehicle_status_s::NAVIGATION_STATE_EXTERNAL1) {
		source.loss_time = _settings.offboard_loss_time;
	}

	_input.silent = (_control_mode.flag_armed && silent(now, source) ? kSetpointFault : 0)
			| (silent(now, _attitude_time, kHoldTime) ? kAttitudeFault : 0)
			| (silent(now, _rates_time, kHoldTime) ? kAllFaults & ~(kSetpointFault | kAttitudeFault) : 0);
}
