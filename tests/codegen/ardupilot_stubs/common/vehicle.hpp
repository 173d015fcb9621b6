// What the controller sees of the vehicle; the test writes it.
#pragma once

#include <stdint.h>

class Vector3f
{
public:
    Vector3f() : x(0), y(0), z(0) {}
    Vector3f(float a, float b, float c) : x(a), y(b), z(c) {}
    float &operator[](int i) { return i == 0 ? x : (i == 1 ? y : z); }

    float x;
    float y;
    float z;
};

class Quaternion
{
public:
    float q1 = 1;
    float q2 = 0;
    float q3 = 0;
    float q4 = 0;
};

class AP_AHRS_View
{
public:
    void get_quat_body_to_ned(Quaternion &q) const { q = attitude; }
    Vector3f get_gyro_latest() const { return gyro; }

    Quaternion attitude;
    Vector3f gyro;
};

class AC_PID
{
public:
    float get_i() const { return integral; }
    void set_integrator(float i) { integral = i; }
    float imax() const { return 0.5; }

    float integral = 0;
};

class AC_AttitudeControl
{
public:
    Quaternion get_attitude_target_quat() const { return target; }
    const Vector3f &get_attitude_target_ang_vel() const { return target_rate; }
    Vector3f rate_bf_targets() const { return rate_target; }
    AC_PID &get_rate_roll_pid() { return pid[0]; }
    AC_PID &get_rate_pitch_pid() { return pid[1]; }
    AC_PID &get_rate_yaw_pid() { return pid[2]; }

    Quaternion target;
    Vector3f target_rate;
    Vector3f rate_target;
    AC_PID pid[3];
};

class AC_AttitudeControl_Multi : public AC_AttitudeControl {};

class AP_Motors
{
public:
    enum class SpoolState : uint8_t { SHUT_DOWN, GROUND_IDLE, SPOOLING_UP, THROTTLE_UNLIMITED, SPOOLING_DOWN };
};

class AP_MotorsMulticopter : public AP_Motors
{
public:
    SpoolState get_spool_state() const { return spool; }
    float get_roll() const { return in[0]; }
    float get_pitch() const { return in[1]; }
    float get_yaw() const { return in[2]; }
    float get_roll_ff() const { return ff[0]; }
    float get_pitch_ff() const { return ff[1]; }
    float get_yaw_ff() const { return ff[2]; }
    void set_roll(float value) { in[0] = value; }
    void set_pitch(float value) { in[1] = value; }
    void set_yaw(float value) { in[2] = value; }
    void set_roll_ff(float value) { ff[0] = value; }
    void set_pitch_ff(float value) { ff[1] = value; }
    void set_yaw_ff(float value) { ff[2] = value; }

    struct {
        bool roll = false;
        bool pitch = false;
        bool yaw = false;
    } limit;
    SpoolState spool = SpoolState::THROTTLE_UNLIMITED;
    float in[3] = {0, 0, 0};
    float ff[3] = {0, 0, 0};
};
