// Cascaded MIMO PID attitude controller, a custom controller of ArduCopter.
#pragma once

#include "AC_CustomControl_Backend.h"

// ArduPilot before 4.6 has no AC_CustomControl_config.h.
#ifndef AP_CUSTOMCONTROL_MIMO_ENABLED
#define AP_CUSTOMCONTROL_MIMO_ENABLED AP_CUSTOMCONTROL_ENABLED
#endif

#if AP_CUSTOMCONTROL_MIMO_ENABLED

#include <AP_Param/AP_Param.h>

#include "utility/bumpless.hpp"
#include "utility/custom_parameters.hpp"
#include "utility/excitation.hpp"
#include "utility/mimo_pid.hpp"
#include "utility/sample_clock.hpp"

class AC_CustomControl_MIMO : public AC_CustomControl_Backend
{
public:
	// The attitude controller's type differs between versions of ArduPilot.
	template <typename AttitudeControl>
	AC_CustomControl_MIMO(AC_CustomControl &frontend, AP_AHRS_View *&ahrs, AttitudeControl *&att_control,
			      AP_MotorsMulticopter *&motors, float dt) :
		AC_CustomControl_Backend(frontend, ahrs, att_control, motors, dt)
	{
		AP_Param::setup_object_defaults(this, var_info);
	}

	// In each loop in which this controller is switched on, after the main controller: torque about roll, pitch, yaw.
	Vector3f update() override;

	// When it is switched on.
	void reset() override;

	static const AP_Param::GroupInfo var_info[];

private:
	const char *obstacle();
	void leave_to_main(const char *obstacle);
	void check_clock();
	bool update_parameters();
	void update_inputs(bool flying);
	void take_over(bool flying);
	void excite(bool flying);
	void log() const;
	Vector3f main_controller(bool flying);

	float setting(mimopilot::Place place) const { return _values[place].get(); }
	int32_t integer(mimopilot::Place place) const { return static_cast<int32_t>(setting(place)); }

	AP_Float _values[mimopilot::kValueCount];
	mimopilot::State _state {};
	mimopilot::Input _input {};
	mimopilot::Output _output {};
	mimopilot::Bumpless _bumpless {};
	mimopilot::Excitation _excitation {};
	mimopilot::SampleClock _clock{mimopilot::kGains.period};
	mimopilot::Excitation::Phase _told{mimopilot::Excitation::Phase::Off};  // to the ground station
	float _excited[mimopilot::kAxes] {};
	float _main_integral[mimopilot::kAxes] {};  // of the main controller, while it flies in our place
	const char *_obstacle{nullptr};
	int32_t _wrong{-1};        // place of the first parameter out of its range; kLimited: too large for the loop; -1: none
	int32_t _until_update{0};  // samples until the parameters are read again
	bool _taking_over{true};
	bool _rate_loop_only{false};  // ACRO's option
};

#endif  // AP_CUSTOMCONTROL_MIMO_ENABLED
