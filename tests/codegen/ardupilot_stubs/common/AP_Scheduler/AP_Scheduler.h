#pragma once

class AP_Scheduler
{
public:
    float get_loop_period_s() const { return period; }

    float period = 0.0025;
};

namespace AP
{
inline AP_Scheduler &scheduler()
{
    static AP_Scheduler one;
    return one;
}
}
