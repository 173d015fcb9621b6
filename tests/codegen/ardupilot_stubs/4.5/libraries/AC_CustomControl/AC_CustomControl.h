#pragma once

#if AP_CUSTOMCONTROL_ENABLED

#include <AP_Param/AP_Param.h>
#include <vehicle.hpp>

#ifndef CUSTOMCONTROL_MAX_TYPES
#define CUSTOMCONTROL_MAX_TYPES 2
#endif

class AC_CustomControl_Backend;

class AC_CustomControl
{
public:
    AC_CustomControl(AP_AHRS_View *&ahrs, AC_AttitudeControl_Multi *&att_control, AP_MotorsMulticopter *&motors, float dt);

    void init();
    void update();
    void set_custom_controller(bool enabled);
    uint8_t get_type() { return _controller_type > 0 ? (_controller_type - 1) : 0; }

    static const AP_Param::GroupInfo *_backend_var_info[CUSTOMCONTROL_MAX_TYPES];

protected:
    enum class CustomControlType : uint8_t {
        CONT_NONE            = 0,
        CONT_EMPTY           = 1,
        CONT_PID             = 2,
    };

    float _dt;
    AP_AHRS_View *&_ahrs;
    AC_AttitudeControl_Multi *&_att_control;
    AP_MotorsMulticopter *&_motors;
    uint8_t _controller_type = 3;
    bool _active = false;

private:
    AC_CustomControl_Backend *_backend = nullptr;
};

#endif
