#include "mimo_edge.hpp"

#include <math.h>

namespace mimopilot
{

namespace
{

constexpr float kDegree = 0.017453293F;        // rad
constexpr float kFullThrust = 65535.0F;
constexpr float kDiagonal = 0.70710678F;       // arm of a motor about x or y, of that from the centre
constexpr float kSmall = 1.0e-3F;              // of the torque that all motors could give: rounding

float clamp_unit(float value) { return fminf(fmaxf(value, -1.0F), 1.0F); }

}  // namespace

float radians(float degrees) { return kDegree * degrees; }

void attitude_from_flu(const float (&xyzw)[4], float (&q)[4])
{
	q[0] = xyzw[3];
	q[1] = xyzw[0];
	q[2] = -xyzw[1];
	q[3] = -xyzw[2];
}

void rates_from_flu(const float (&rates)[3], float (&frd)[3])
{
	frd[0] = radians(rates[0]);
	frd[1] = -radians(rates[1]);
	frd[2] = -radians(rates[2]);
}

void angles_from_legacy(const float (&angles)[3], float (&frd)[3])
{
	frd[0] = radians(angles[0]);
	frd[1] = radians(angles[1]);
	frd[2] = -radians(angles[2]);
}

void quaternion_of(const float (&angles)[3], float (&q)[4])
{
	float c[3];
	float s[3];

	for (int i = 0; i < 3; i++) {
		c[i] = cosf(0.5F * angles[i]);
		s[i] = sinf(0.5F * angles[i]);
	}

	q[0] = c[0] * c[1] * c[2] + s[0] * s[1] * s[2];
	q[1] = s[0] * c[1] * c[2] - c[0] * s[1] * s[2];
	q[2] = c[0] * s[1] * c[2] + s[0] * c[1] * s[2];
	q[3] = c[0] * c[1] * s[2] - s[0] * s[1] * c[2];
}

void angles_of(const float (&q)[4], float (&angles)[3])
{
	angles[0] = atan2f(2.0F * (q[0] * q[1] + q[2] * q[3]), 1.0F - 2.0F * (q[1] * q[1] + q[2] * q[2]));
	angles[1] = asinf(clamp_unit(2.0F * (q[0] * q[2] - q[3] * q[1])));
	angles[2] = atan2f(2.0F * (q[0] * q[3] + q[1] * q[2]), 1.0F - 2.0F * (q[2] * q[2] + q[3] * q[3]));
}

void torque_to_flu(const float (&u)[3], const float (&scale)[3], float (&torque)[3])
{
	torque[0] = u[0] * scale[0];
	torque[1] = -(u[1] * scale[1]);
	torque[2] = -(u[2] * scale[2]);
}

float thrust_to_newton(float thrust, float largest)
{
	if (!(thrust > 0.0F)) { return 0.0F; }  // also if it is no number

	return fminf(thrust, kFullThrust) / kFullThrust * largest;
}

void unallocated(float thrust, const float (&torque)[3], const Motors &motors, int32_t (&sign)[3])
{
	// Signs of each motor's part of the torque about x, y, z.
	constexpr float kSigns[4][3] = {{-1.0F, -1.0F, -1.0F}, {-1.0F, 1.0F, 1.0F}, {1.0F, 1.0F, -1.0F}, {1.0F, -1.0F, 1.0F}};
	const float lever[3] = {kDiagonal * motors.arm, kDiagonal * motors.arm, motors.torque_ratio};
	float force[4];
	float highest = 0.0F;

	for (int i = 0; i < 4; i++) {
		force[i] = thrust;

		for (int j = 0; j < 3; j++) { force[i] += kSigns[i][j] * torque[j] / lever[j]; }

		force[i] = fmaxf(0.25F * force[i], 0.0F);
		highest = fmaxf(highest, force[i]);
	}

	const float lower = fmaxf(highest - motors.largest, 0.0F);

	for (int j = 0; j < 3; j++) {
		float given = 0.0F;

		for (int i = 0; i < 4; i++) { given += kSigns[i][j] * fmaxf(force[i] - lower, motors.least); }

		const float missing = torque[j] - lever[j] * given;
		const float small = 4.0F * kSmall * lever[j] * motors.largest;
		const int32_t flu = missing > small ? 1 : (missing < -small ? -1 : 0);
		sign[j] = j == 0 ? flu : -flu;
	}
}

}  // namespace mimopilot
