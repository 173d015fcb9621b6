#include "AC_CustomControl_MIMO.h"

#if AP_CUSTOMCONTROL_MIMO_ENABLED

#include <AP_HAL/AP_HAL.h>
#include <AP_Logger/AP_Logger.h>
#include <AP_RCMapper/AP_RCMapper.h>
#include <AP_Scheduler/AP_Scheduler.h>
#include <AP_Vehicle/AP_Vehicle.h>
#include <GCS_MAVLink/GCS.h>
#include <RC_Channel/RC_Channel.h>
#include <string.h>

#include "utility/attitude.hpp"
#include "utility/gains.hpp"
#include "utility/stored_set.hpp"

using namespace mimopilot;

namespace
{

constexpr float kPeriodTolerance = 0.05F;  // relative, as for the gyro of PX4
constexpr int32_t kUpdateSamples = static_cast<int32_t>(1.0F / kGains.period + 0.5F);  // parameters: once a second
constexpr int32_t kForeign = kLimited + 1;  // of the set: stored for another firmware
constexpr float kAllAxes = 7.0F;       // CC_AXIS_MASK: roll, pitch and yaw
constexpr const char *kWrongRate = "loop rate is not the gains'";
constexpr uint8_t kAcro = 1;           // flight mode ACRO
constexpr uint32_t kRateLoopOnly = 2;  // bit of ACRO_OPTIONS

bool period_differs()
{
	const float difference = AP::scheduler().get_loop_period_s() - kGains.period;
	return !(__builtin_fabsf(difference) <= kPeriodTolerance * kGains.period);
}

// A parameter of ArduPilot; `otherwise` if this version does not have it.
float parameter(const char *name, float otherwise)
{
	float value = otherwise;
	return AP_Param::get(name, value) ? value : otherwise;
}

int32_t samples(float seconds)
{
	return seconds > 0.0F && seconds < 1.0e3F ? static_cast<int32_t>(seconds / kGains.period + 0.5F) : 0;
}

void store(const Quaternion &from, float (&to)[4])
{
	to[0] = from.q1;
	to[1] = from.q2;
	to[2] = from.q3;
	to[3] = from.q4;
}

void store(const Vector3f &from, float (&to)[kAxes])
{
	to[0] = from.x;
	to[1] = from.y;
	to[2] = from.z;
}

// The law has no input for rates of roll and pitch that the setpoint has. A setpoint that is ahead by Kp_o^-1 times them
// gives their rate setpoint: Kp_o e_o + rate.
void lead(const Gains &gains, float roll, float pitch, float (&q)[4])
{
	constexpr float kSmallest = 1.0e-6F;  // s^-2; the smallest accepted diagonal gains give 1e-4
	constexpr float kLargest = 0.25F;     // half angle, rad
	const float(&kp)[2][2] = gains.kp_o;
	const float determinant = kp[0][0] * kp[1][1] - kp[0][1] * kp[1][0];

	if (!(__builtin_fabsf(determinant) > kSmallest)) { return; }

	const float scale = 0.5F / determinant;
	float x = scale * (kp[1][1] * roll - kp[0][1] * pitch);
	float y = scale * (kp[0][0] * pitch - kp[1][0] * roll);
	const float half_angle = __builtin_sqrtf(x * x + y * y);

	if (!(half_angle <= kLargest)) {
		if (!(half_angle < kLargest / kSmallest)) { return; }  // not finite

		x *= kLargest / half_angle;
		y *= kLargest / half_angle;
	}

	const float length = 1.0F / __builtin_sqrtf(1.0F + x * x + y * y);
	const float ahead[4] {
		length * (q[0] - q[1] * x - q[2] * y),
		length * (q[1] + q[0] * x - q[3] * y),
		length * (q[2] + q[0] * y + q[3] * x),
		length * (q[3] + q[1] * y - q[2] * x),
	};
	memcpy(q, ahead, sizeof(ahead));
}

// Turns the sign of the last torque into that of the torque that the motors could not give.
int32_t unallocated(bool limited, float torque) { return !limited ? 0 : (torque > 0.0F ? 1 : (torque < 0.0F ? -1 : 0)); }

}  // namespace

void AC_CustomControl_MIMO::reset()
{
	_taking_over = true;
	_excitation = Excitation{};  // a run asked for earlier is none
	_told = _excitation.phase();
	_rate_loop_only = (static_cast<uint32_t>(parameter("ACRO_OPTIONS", 0.0F)) & kRateLoopOnly) != 0;
	memset(_main_integral, 0, sizeof(_main_integral));
	_wrong = -1;
	_clock = SampleClock(kGains.period);
	leave_to_main(initialise(_state, kGains) && update_parameters() ? obstacle() : refusal());
}

// Until it is switched on again; null: this controller flies.
void AC_CustomControl_MIMO::leave_to_main(const char *obstacle)
{
	_obstacle = obstacle;

	if (_obstacle != nullptr) {
		GCS_SEND_TEXT(MAV_SEVERITY_WARNING, "MIMO: %s: main flies", _obstacle);
	}
}

// Why the parameters were refused.
const char *AC_CustomControl_MIMO::refusal() const { return _wrong == kForeign ? "SET_ID is not the firmware's" : "parameter out of range"; }

// Why this controller must not fly; null if it may.
const char *AC_CustomControl_MIMO::obstacle()
{
	if (period_differs()) { return kWrongRate; }

	if (!(__builtin_fabsf(parameter("CC_AXIS_MASK", 0.0F) - kAllAxes) < 0.5F)) { return "CC_AXIS_MASK is not 7"; }

	// The main controller would run in a thread of its own and overwrite the torque.
	if (parameter("FSTRATE_ENABLE", 0.0F) > 0.5F) { return "FSTRATE_ENABLE is not 0"; }

	return nullptr;
}

// Returns false, and changes no gain, if a parameter is out of its range.
bool AC_CustomControl_MIMO::update_parameters()
{
	static_assert(sizeof(Gains) == kGainCount * sizeof(float), "Gains is a row of floats");
	_until_update = kUpdateSamples;
	Gains gains;
	float *const gain = &gains.kp_o[0][0];
	const int32_t before = _wrong;
	_wrong = -1;

	for (int32_t i = kLimited - 1; i >= 0; i--) {
		if (published(i)) {
			// Read-only for ground stations: restore the built-in value if a parameter file has stored another one.
			_values[i].set(programmed(i));

		} else if (!accepted(i, _values[i].get())) {
			_wrong = i;
		}

		if (i < kGainCount) { gain[i] = _values[i].get(); }
	}

	if (_wrong < 0 && !for_this_firmware(gains, setting(SET_ID))) { _wrong = kForeign; }

	if (_wrong < 0 && memcmp(&gains, &_state.gains, sizeof(gains)) != 0 && !set_gains(_state, gains)) { _wrong = kLimited; }

	if (_wrong >= 0 && _wrong != before) {
		if (_wrong == kForeign) {
			GCS_SEND_TEXT(MAV_SEVERITY_WARNING, "MIMO: CC3_SET_ID is not %d, no gain changed",
				      static_cast<int>(kFirmwareNumber));

		} else {
			const char *const name = _wrong < kLimited ? var_info[_wrong].name : "SP_SLEW or M_OMEGA";
			GCS_SEND_TEXT(MAV_SEVERITY_WARNING, "MIMO: %s out of range, no gain changed", name);
		}
	}

	ExcitationSettings settings;
	settings.axis = integer(EX_AX);
	settings.amplitude[0] = settings.amplitude[1] = setting(EX_AMP);
	settings.amplitude[2] = setting(EX_AMPY);
	settings.hold_min = integer(EX_HMIN);
	settings.hold_max = integer(EX_HMAX);
	settings.duration = samples(setting(EX_DUR));
	settings.pause = samples(1.0F);
	settings.seed = integer(EX_SEED);
	settings.tilt_max = setting(EX_TILT);
	settings.period = kGains.period;
	_excitation.configure(settings);
	return _wrong < 0;
}

Vector3f AC_CustomControl_MIMO::update()
{
	const AP_Motors::SpoolState spool = _motors->get_spool_state();
	const bool flying = spool != AP_Motors::SpoolState::SHUT_DOWN && spool != AP_Motors::SpoolState::GROUND_IDLE;

	if (_obstacle == nullptr) { check_clock(); }

	if (_obstacle != nullptr) { return main_controller(flying); }

	if (--_until_update <= 0) { update_parameters(); }

	update_inputs(flying);

	if (_taking_over) { take_over(flying); }

	excite(flying);
	_bumpless.add(_input.excitation);
	const int32_t faults = _output.fault;
	step(_state, _input, _output);

	if (_output.fault != faults && _output.fault != 0) {
		GCS_SEND_TEXT(MAV_SEVERITY_CRITICAL, "MIMO: invalid inputs 0x%x, only rates are damped",
			      static_cast<unsigned>(_output.fault));
	}

	// The main controller's feed-forward would be added by the mixer.
	_motors->set_roll_ff(0.0F);
	_motors->set_pitch_ff(0.0F);
	_motors->set_yaw_ff(0.0F);
	log();
	return Vector3f(_output.moment[0], _output.moment[1], _output.moment[2]);
}

// The scheduler's rate is what is asked for; a processor that is too busy runs slower. The main controller then goes on
// with our integrators.
void AC_CustomControl_MIMO::check_clock()
{
	_clock.advance(AP_HAL::micros64());

	if (_clock.rate() == SampleClock::Rate::Wrong) {
		memcpy(_main_integral, _state.integral, sizeof(_main_integral));
		leave_to_main(kWrongRate);
	}
}

void AC_CustomControl_MIMO::update_inputs(bool flying)
{
	Quaternion attitude;
	_ahrs->get_quat_body_to_ned(attitude);
	const Quaternion target = _att_control->get_attitude_target_quat();
	const Vector3f rate = _att_control->get_attitude_target_ang_vel();
	store(attitude, _input.attitude);
	store(target, _input.attitude_setpoint);
	store(_ahrs->get_gyro_latest(), _input.rates);
	store(_att_control->rate_bf_targets(), _input.rates_setpoint);

	// Earth's z axis in the target's axes, in which its rate is. The rate of the heading is an input of the law.
	const Vector3f down(2.0F * (target.q2 * target.q4 - target.q1 * target.q3),
			    2.0F * (target.q3 * target.q4 + target.q1 * target.q2),
			    1.0F - 2.0F * (target.q2 * target.q2 + target.q3 * target.q3));
	_input.yaw_rate_setpoint = down.x * rate.x + down.y * rate.y + down.z * rate.z;

	// The attitude model makes its own rates.
	if (!(_state.gains.model_omega > 0.0F)) {
		lead(_state.gains, rate.x - down.x * _input.yaw_rate_setpoint, rate.y - down.y * _input.yaw_rate_setpoint,
		     _input.attitude_setpoint);
	}

	_input.rate_mode = _rate_loop_only && AP::vehicle()->get_mode() == kAcro ? 1 : 0;
	_input.armed = flying ? 1 : 0;
	_input.landed = AP::vehicle()->get_likely_flying() ? 0 : 1;
	_input.saturation[0] = unallocated(_motors->limit.roll, _output.moment[0]);
	_input.saturation[1] = unallocated(_motors->limit.pitch, _output.moment[1]);
	_input.saturation[2] = unallocated(_motors->limit.yaw, _output.moment[2]);
	memset(_input.excitation, 0, sizeof(_input.excitation));
}

// The main controller has run in this loop, too: our torque goes on from its own.
void AC_CustomControl_MIMO::take_over(bool flying)
{
	_taking_over = false;
	_bumpless = Bumpless{};
	memcpy(_state.rates, _input.rates, sizeof(_state.rates));  // the derivative starts at zero
	const int32_t armed = _input.armed;
	_input.armed = 0;
	step(_state, _input, _output);
	_input.armed = armed;

	if (flying) {
		const float torque[kAxes] {
			_motors->get_roll() + _motors->get_roll_ff(),
			_motors->get_pitch() + _motors->get_pitch_ff(),
			_motors->get_yaw() + _motors->get_yaw_ff(),
		};
		const float integral[kAxes] {
			_att_control->get_rate_roll_pid().get_i(),
			_att_control->get_rate_pitch_pid().get_i(),
			_att_control->get_rate_yaw_pid().get_i(),
		};
		_bumpless.start(_state, _output, integral, torque);
	}
}

void AC_CustomControl_MIMO::excite(bool flying)
{
	ExcitationConditions conditions{};
	conditions.ready = flying && _input.landed == 0 && _output.fault == 0
			   && static_cast<int32_t>(AP::vehicle()->get_mode()) == integer(EX_MODE);
	conditions.tilt = tilt(_input.attitude);
	conditions.yaw_rate = _input.rates[2];
	const RCMapper *const map = AP::rcmap();

	if (map != nullptr && rc().has_valid_input()) {
		const uint8_t channels[] {map->roll(), map->pitch(), map->yaw(), map->throttle()};

		for (int i = 0; i < 4; i++) {
			const RC_Channel *const channel = rc().channel(channels[i] - 1);
			conditions.sticks[i] = channel != nullptr ? channel->norm_input_ignore_trim() : 0.0F;
		}
	}

	_excitation.step(conditions, _input.excitation);
	memcpy(_excited, _input.excitation, sizeof(_excited));

	if (_excitation.phase() != _told) {
		_told = _excitation.phase();
		const bool off = _excitation.phase() == Excitation::Phase::Off;
		GCS_SEND_TEXT(MAV_SEVERITY_INFO, "MIMO excitation: %s",
			      off ? describe(_excitation.end()) : describe(_excitation.phase()));
	}
}

// ArduPilot zeroes the main controller's integrators after each update: what they would hold is added here.
Vector3f AC_CustomControl_MIMO::main_controller(bool flying)
{
	Vector3f torque(_motors->get_roll(), _motors->get_pitch(), _motors->get_yaw());

	if (!flying) {
		memset(_main_integral, 0, sizeof(_main_integral));
		return torque;
	}

	AC_PID *const pids[kAxes] {
		&_att_control->get_rate_roll_pid(), &_att_control->get_rate_pitch_pid(), &_att_control->get_rate_yaw_pid(),
	};

	for (int i = 0; i < kAxes; i++) {
		torque[i] += _main_integral[i];
		const float integral = _main_integral[i] + pids[i]->get_i();
		const float limit = pids[i]->imax();
		_main_integral[i] = integral > limit ? limit : (integral < -limit ? -limit : integral);
	}

	return torque;
}

// In each sample: what `mimopilot tune` needs beside ArduPilot's own RATE and ANG.
void AC_CustomControl_MIMO::log() const
{
#if HAL_LOGGING_ENABLED
	const int phase = _excitation.running() ? static_cast<int>(_excitation.phase()) : -1;
	const unsigned faults = _clock.faults() < UINT16_MAX ? static_cast<unsigned>(_clock.faults()) : UINT16_MAX;
	// @LoggerMessage: MIMO
	// @Description: the custom controller's rate setpoint, torque and excitation
	// @Field: TimeUS: Time since system startup
	// @Field: Ph: phase of the excitation: 0 roll, 1 pitch, 2 pause, 3 yaw, -1 off
	// @Field: RR: rate setpoint, roll
	// @Field: RP: rate setpoint, pitch
	// @Field: RY: rate setpoint, yaw
	// @Field: UR: torque, roll, excitation included
	// @Field: UP: torque, pitch, excitation included
	// @Field: UY: torque, yaw, excitation included
	// @Field: XR: excitation, roll
	// @Field: XP: excitation, pitch
	// @Field: XY: excitation, yaw
	// @Field: TF: intervals outside 0.5 to 1.5 periods since this controller was switched on
	AP::logger().WriteStreaming("MIMO", "TimeUS,Ph,RR,RP,RY,UR,UP,UY,XR,XP,XY,TF", "s-EEE-------", "F-----------",
				    "QbfffffffffH", AP_HAL::micros64(), phase,
				    static_cast<double>(_output.rates_setpoint[0]),
				    static_cast<double>(_output.rates_setpoint[1]),
				    static_cast<double>(_output.rates_setpoint[2]),
				    static_cast<double>(_output.moment[0]), static_cast<double>(_output.moment[1]),
				    static_cast<double>(_output.moment[2]), static_cast<double>(_excited[0]),
				    static_cast<double>(_excited[1]), static_cast<double>(_excited[2]), faults);
#endif
}

#endif  // AP_CUSTOMCONTROL_MIMO_ENABLED
