#include "AC_CustomControl.h"

#if AP_CUSTOMCONTROL_ENABLED

#include "AC_CustomControl_Backend.h"
// #include "AC_CustomControl_Empty.h"
#include "AC_CustomControl_PID.h"
#include <AP_Scheduler/AP_Scheduler.h>
#include <new>

#define NEW_NOTHROW new (std::nothrow)
// The stub has no groups within groups.
#define AP_SUBGROUPVARPTR(element, group, idx, clazz, info) { group, idx, 0, 0 }

extern const AP_Param::GroupInfo groups[];

const AP_Param::GroupInfo groups[] = {
    // AP_SUBGROUPVARPTR(_backend, "1_", 6, AC_CustomControl, _backend_var_info[0]),

    AP_SUBGROUPVARPTR(_backend, "2_", 7, AC_CustomControl, _backend_var_info[1]),

    AP_GROUPEND
};

const AP_Param::GroupInfo *AC_CustomControl::_backend_var_info[CUSTOMCONTROL_MAX_TYPES];

AC_CustomControl::AC_CustomControl(AP_AHRS_View *&ahrs, AC_AttitudeControl_Multi *&att_control, AP_MotorsMulticopter *&motors, float dt) :
    _dt(dt),
    _ahrs(ahrs),
    _att_control(att_control),
    _motors(motors)
{
}

void AC_CustomControl::init()
{
    _dt = AP::scheduler().get_loop_period_s();

    switch (CustomControlType(_controller_type))
    {
        case CustomControlType::CONT_NONE:
            break;
        case CustomControlType::CONT_EMPTY:
            // _backend = new AC_CustomControl_Empty(*this, _ahrs, _att_control, _motors, _dt);
            break;
        case CustomControlType::CONT_PID:
            _backend = new AC_CustomControl_PID(*this, _ahrs, _att_control, _motors, _dt);
            _backend_var_info[get_type()] = AC_CustomControl_PID::var_info;
            break;
        default:
            return;
    }
}

void AC_CustomControl::update()
{
    if (!_active || _backend == nullptr) { return; }

    const Vector3f torque = _backend->update();
    _motors->set_roll(torque.x);
    _motors->set_pitch(torque.y);
    _motors->set_yaw(torque.z);
    _att_control->get_rate_roll_pid().set_integrator(0.0);
    _att_control->get_rate_pitch_pid().set_integrator(0.0);
    _att_control->get_rate_yaw_pid().set_integrator(0.0);
}

void AC_CustomControl::set_custom_controller(bool enabled)
{
    if (enabled) { _backend->reset(); }
    _active = enabled;
}

#endif
