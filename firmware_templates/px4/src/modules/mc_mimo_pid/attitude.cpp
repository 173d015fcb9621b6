#include "attitude.hpp"

#include <math.h>

namespace mimopilot {

namespace {

bool is_unit(const float (&q)[4])
{
	const float norm = q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3];
	return norm > 0.99F && norm < 1.01F;  // false for NaN
}

float arcsine(float x) { return asinf(x > 1.0F ? 1.0F : (x < -1.0F ? -1.0F : x)); }

float heading_of(const float (&q)[4])
{
	return atan2f(2.0F * (q[0] * q[3] + q[1] * q[2]), 1.0F - 2.0F * (q[2] * q[2] + q[3] * q[3]));
}

void not_set(float (&roll_pitch_yaw)[3])
{
	for (float &angle : roll_pitch_yaw) { angle = NAN; }
}

}  // namespace

void angles(const float (&q)[4], float (&roll_pitch_yaw)[3])
{
	if (!is_unit(q)) {
		not_set(roll_pitch_yaw);
		return;
	}

	roll_pitch_yaw[0] = atan2f(2.0F * (q[0] * q[1] + q[2] * q[3]), 1.0F - 2.0F * (q[1] * q[1] + q[2] * q[2]));
	roll_pitch_yaw[1] = arcsine(2.0F * (q[0] * q[2] - q[1] * q[3]));
	roll_pitch_yaw[2] = heading_of(q);
}

void setpoint_angles(const float (&q_d)[4], float heading, float (&roll_pitch_yaw)[3])
{
	if (!is_unit(q_d)) {
		not_set(roll_pitch_yaw);
		return;
	}

	// Body z axis in NED, then rotated into the heading frame: (sin pitch cos roll, -sin roll, cos pitch cos roll).
	const float north = 2.0F * (q_d[1] * q_d[3] + q_d[0] * q_d[2]);
	const float east = 2.0F * (q_d[2] * q_d[3] - q_d[0] * q_d[1]);
	const float down = 1.0F - 2.0F * (q_d[1] * q_d[1] + q_d[2] * q_d[2]);
	const float cosine = cosf(heading);
	const float sine = sinf(heading);
	roll_pitch_yaw[0] = arcsine(sine * north - cosine * east);
	roll_pitch_yaw[1] = atan2f(cosine * north + sine * east, down);
	roll_pitch_yaw[2] = heading_of(q_d);
}

void rotate(const float (&delta)[4], float (&q)[4])
{
	const float w = delta[0] * q[0] - delta[1] * q[1] - delta[2] * q[2] - delta[3] * q[3];
	const float x = delta[0] * q[1] + delta[1] * q[0] + delta[2] * q[3] - delta[3] * q[2];
	const float y = delta[0] * q[2] - delta[1] * q[3] + delta[2] * q[0] + delta[3] * q[1];
	const float z = delta[0] * q[3] + delta[1] * q[2] - delta[2] * q[1] + delta[3] * q[0];
	q[0] = w;
	q[1] = x;
	q[2] = y;
	q[3] = z;
}

}  // namespace mimopilot
