#pragma once

#include "AC_CustomControl_config.h"

#if AP_CUSTOMCONTROL_ENABLED

#include "AC_CustomControl.h"

class AC_CustomControl_Backend
{
public:
    AC_CustomControl_Backend(AC_CustomControl &frontend, AP_AHRS_View *&ahrs, AC_AttitudeControl *&att_control,
                             AP_MotorsMulticopter *&motors, float) :
        _ahrs(ahrs),
        _att_control(att_control),
        _motors(motors),
        _frontend(frontend)
    {}

    virtual ~AC_CustomControl_Backend() {}
    virtual Vector3f update() = 0;
    virtual void reset() = 0;

protected:
    AP_AHRS_View *&_ahrs;
    AC_AttitudeControl *&_att_control;
    AP_MotorsMulticopter *&_motors;
    AC_CustomControl &_frontend;
};

#endif
