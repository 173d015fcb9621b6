// Converts quaternions (w, x, y, z; body FRD to earth NED) to the controller's roll, pitch and yaw angles.
#pragma once

namespace mimopilot {

// Vehicle angles. All NaN if q is not a unit quaternion, so that the controller holds the last valid ones.
void angles(const float (&q)[4], float (&roll_pitch_yaw)[3]);

// Angles of an attitude setpoint q_d: its tilt relative to the vehicle's heading, so that a yaw error does not
// tilt the vehicle sideways, and its heading. NaN as above.
void setpoint_angles(const float (&q_d)[4], float heading, float (&roll_pitch_yaw)[3]);

// q = delta q: applies an estimator's attitude reset to a setpoint made before it.
void rotate(const float (&delta)[4], float (&q)[4]);

}  // namespace mimopilot
