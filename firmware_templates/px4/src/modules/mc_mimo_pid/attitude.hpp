// Quaternions (w, x, y, z; body FRD to earth NED) to the roll, pitch and yaw angles that the controller takes.
#pragma once

namespace mimopilot {

// Angles of a vehicle. NaN, three times, when q is not a unit quaternion: the controller then holds the last ones.
void angles(const float (&q)[4], float (&roll_pitch_yaw)[3]);

// Angles of a set-point q_d: its tilt as seen from the vehicle's own heading, so that a turn under way does not
// tilt the vehicle sideways, and its heading. NaN as above.
void setpoint_angles(const float (&q_d)[4], float heading, float (&roll_pitch_yaw)[3]);

// q = delta q: what an estimator's reset of the attitude does to a set-point made before it.
void rotate(const float (&delta)[4], float (&q)[4]);

}  // namespace mimopilot
