// Steps the controller in a loop of ArduPilot, driven by lines of text: a word and numbers.
#include <AP_HAL/AP_HAL.h>
#include <AP_Logger/AP_Logger.h>
#include <AP_RCMapper/AP_RCMapper.h>
#include <AP_Scheduler/AP_Scheduler.h>
#include <AP_Vehicle/AP_Vehicle.h>
#include <RC_Channel/RC_Channel.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "AC_CustomControl.h"
#include "AC_CustomControl_PID.h"

const AP_Param::GroupInfo AC_CustomControl_PID::var_info[] = {AP_GROUPEND};

namespace
{

float slope[3];  // what the main controller's integrators gain in a period
float proportional[3];
float interval = 2500;  // us

void read(float *values, int count)
{
    for (int i = 0; i < count; i++) {
        if (scanf("%f", &values[i]) != 1) { abort(); }
    }
}

Quaternion quaternion()
{
    float v[4];
    read(v, 4);
    Quaternion q;
    q.q1 = v[0];
    q.q2 = v[1];
    q.q3 = v[2];
    q.q4 = v[3];
    return q;
}

Vector3f vector()
{
    float v[3];
    read(v, 3);
    return Vector3f(v[0], v[1], v[2]);
}

AP_Float &parameter(const char *name)
{
    for (const AP_Param::GroupInfo *one = AP_Param::table(); one->name != nullptr; one++) {
        if (strcmp(one->name, name) == 0) { return AP_Param::at(*one); }
    }

    abort();
}

}  // namespace

int main()
{
    AP_AHRS_View attitude;
    ATTITUDE_CONTROL control;
    AP_MotorsMulticopter motors;
    AP_AHRS_View *ahrs = &attitude;
    ATTITUDE_CONTROL *att_control = &control;
    AP_MotorsMulticopter *multicopter = &motors;
    AP_Param::others()["CC_AXIS_MASK"] = 7;
#ifdef WITH_PERIOD
    AC_CustomControl frontend(ahrs, att_control, multicopter, 0);
#else
    AC_CustomControl frontend(ahrs, att_control, multicopter);
#endif
    frontend.init();
    char word[32];
    char name[32];

    while (scanf("%31s", word) == 1) {
        float value[4] = {0, 0, 0, 0};

        if (strcmp(word, "param") == 0 || strcmp(word, "other") == 0) {
            if (scanf("%31s", name) != 1) { abort(); }

            read(value, 1);

            if (word[0] == 'p') {
                parameter(name).set(value[0]);
            } else {
                AP_Param::others()[name] = value[0];
            }

        } else if (strcmp(word, "value") == 0) {
            if (scanf("%31s", name) != 1) { abort(); }

            printf("text %.9g\n", static_cast<double>(parameter(name).get()));

        } else if (strcmp(word, "attitude") == 0) {
            attitude.attitude = quaternion();

        } else if (strcmp(word, "target") == 0) {
            control.target = quaternion();

        } else if (strcmp(word, "target_rate") == 0) {
            control.target_rate = vector();

        } else if (strcmp(word, "rate_target") == 0) {
            control.rate_target = vector();

        } else if (strcmp(word, "gyro") == 0) {
            attitude.gyro = vector();

        } else if (strcmp(word, "main") == 0) {
            read(proportional, 3);

        } else if (strcmp(word, "ff") == 0) {
            read(motors.ff, 3);

        } else if (strcmp(word, "integral") == 0) {
            for (AC_PID &pid : control.pid) { read(&pid.integral, 1); }

        } else if (strcmp(word, "slope") == 0) {
            read(slope, 3);

        } else if (strcmp(word, "limit") == 0) {
            read(value, 3);
            motors.limit.roll = value[0] > 0;
            motors.limit.pitch = value[1] > 0;
            motors.limit.yaw = value[2] > 0;

        } else if (strcmp(word, "spool") == 0) {
            read(value, 1);
            motors.spool = static_cast<AP_Motors::SpoolState>(static_cast<int>(value[0]));

        } else if (strcmp(word, "flying") == 0) {
            read(value, 1);
            AP::vehicle()->flying = value[0] > 0;

        } else if (strcmp(word, "mode") == 0) {
            read(value, 1);
            AP::vehicle()->mode = static_cast<uint8_t>(value[0]);

        } else if (strcmp(word, "sticks") == 0) {
            read(value, 4);

            for (int i = 0; i < 4; i++) { rc().channels[i].position = value[i]; }

        } else if (strcmp(word, "period") == 0) {
            read(&AP::scheduler().period, 1);

        } else if (strcmp(word, "interval") == 0) {
            read(&interval, 1);

        } else if (strcmp(word, "switch") == 0) {
            read(value, 1);
            frontend.set_custom_controller(value[0] > 0);

        } else if (strcmp(word, "step") == 0) {
            read(value, 1);

            for (int k = 0; k < static_cast<int>(value[0]); k++) {
                for (int i = 0; i < 3; i++) {
                    control.pid[i].integral += slope[i];
                    motors.in[i] = proportional[i] + control.pid[i].integral;
                }

                AP_HAL::clock() += static_cast<uint64_t>(interval);
                AP_Logger &logger = AP::logger();
                logger = AP_Logger();
                frontend.update();
                printf("row");

                for (int i = 0; i < 3; i++) { printf(" %.9g", static_cast<double>(motors.in[i] + motors.ff[i])); }

                // Logged: 1 if it is, phase, rate setpoint, torque, excitation, faults of the clock.
                printf(" %d", logger.valid ? 1 : 0);

                for (int i = 1; i < 12; i++) { printf(" %.9g", logger.values[i]); }

                printf("\n");
            }

        } else {
            abort();
        }
    }

    return 0;
}
