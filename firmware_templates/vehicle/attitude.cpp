#include "attitude.hpp"

#include <math.h>

namespace mimopilot
{

float heading(const float (&q)[4])
{
	return atan2f(2.0F * (q[0] * q[3] + q[1] * q[2]), 1.0F - 2.0F * (q[2] * q[2] + q[3] * q[3]));
}

float tilt(const float (&q)[4]) { return 2.0F * asinf(fminf(sqrtf(q[1] * q[1] + q[2] * q[2]), 1.0F)); }

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
