// Quaternions w, x, y, z; body FRD to earth NED.
#pragma once

namespace mimopilot
{

// rad, from north to east
float heading(const float (&q)[4]);

// rad, between body z and down
float tilt(const float (&q)[4]);

// q = delta q: applies an estimator's attitude reset to a setpoint made before it.
void rotate(const float (&delta)[4], float (&q)[4]);

}  // namespace mimopilot
