#pragma once

#include "AC_CustomControl_Backend.h"

// Only its name and its constructor are needed.
class AC_CustomControl_PID : public AC_CustomControl_Backend
{
public:
    using AC_CustomControl_Backend::AC_CustomControl_Backend;
    Vector3f update() override { return Vector3f(); }
    void reset() override {}
    static const AP_Param::GroupInfo var_info[];
};
