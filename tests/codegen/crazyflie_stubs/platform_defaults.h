/* Numbers of our own, near those of a Crazyflie 2. */
#pragma once

#define ARM_LENGTH 0.05f
#define THRUST2TORQUE 0.006f
#define THRUST_MAX 0.125f
