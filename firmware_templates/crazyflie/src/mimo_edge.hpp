// Units and frames. The firmware has degrees, and two frames: x forward, y left, z up (here FLU), and its older one, in
// which pitch is inverted. The controller has radians, and x forward, y right, z down (FRD), earth's axes likewise.
// Needs no firmware, so that any machine can compile and test it.
#pragma once

#include <stdint.h>

namespace mimopilot
{

float radians(float degrees);

// Quaternion w, x, y, z in FRD from x, y, z, w in FLU.
void attitude_from_flu(const float (&xyzw)[4], float (&q)[4]);

// rad/s in FRD from deg/s in FLU.
void rates_from_flu(const float (&rates)[3], float (&frd)[3]);

// Roll, pitch, yaw: rad or rad/s in FRD from deg or deg/s in the older frame, where pitch is positive with the nose up
// and yaw to the left.
void angles_from_legacy(const float (&angles)[3], float (&frd)[3]);

// Quaternion w, x, y, z of roll, pitch and yaw in rad, FRD: turned by yaw first.
void quaternion_of(const float (&angles)[3], float (&q)[4]);

// Its inverse.
void angles_of(const float (&q)[4], float (&angles)[3]);

// N m in FLU from normalised torque in FRD. `scale`: N m of u = 1.
void torque_to_flu(const float (&u)[3], const float (&scale)[3], float (&torque)[3]);

// N from the firmware's 0 to 65535. `largest`: N of all motors at their limit. 0 if it is no number.
float thrust_to_newton(float thrust, float largest);

// A quadrotor in X, as in the firmware's power distribution.
struct Motors {
	float arm;           // m, from the centre to a motor
	float torque_ratio;  // m, torque over thrust
	float largest;       // N, of one motor
	float least;         // N, of one motor: it idles, and never stops
};

// Signs of the torque (N m, FLU) that the motors cannot give, as axes of FRD. The firmware lowers all motors alike until
// none is above its limit, and raises those below their least thrust to it.
void unallocated(float thrust, const float (&torque)[3], const Motors &motors, int32_t (&sign)[3]);

}  // namespace mimopilot
