// Setpoints from the sticks, as the stock controllers make them: attitude in Stabilized mode, rates in Acro.
#pragma once

#include "stock_settings.hpp"

namespace mimopilot
{

struct StickInput {
	float roll;      // -1 to 1, right positive; NaN counts as centred
	float pitch;     // forward positive
	float yaw;       // clockwise positive
	float throttle;  // -1 to 1; NaN counts as bottom
};

struct StickSetpoint {
	float q_d[4];
	float yaw_rate;  // rad/s
};

struct VehicleHeading {
	float angle;    // rad
	bool good;      // for control
	float unaided;  // rad, from the gyros alone, with an unknown offset; NaN: none
};

class Sticks
{
public:
	// The next setpoint() starts level, without yaw rate, at the vehicle's heading.
	void release() { *this = Sticks{}; }

	// The estimator reset its heading by this, rad.
	void shift(float angle);

	// One period. The setpoint's heading follows the vehicle's while turning, at the bottom of the throttle, or if it
	// is not good; else it is held. While the estimate converges, the held one moves with it.
	StickSetpoint setpoint(const StockSettings &settings, const StickInput &input, const VehicleHeading &vehicle,
			       float period);

private:
	float converge(const VehicleHeading &vehicle, float period);

	bool _holding{false};
	float _heading{0.0F};
	float _yaw_rate{0.0F};  // rad/s, filtered
	float _tilt[2] {};      // rad about roll and pitch, filtered

	// The error of the heading, against the unaided one.
	bool _started{false};
	bool _converging{false};
	float _filtered{0.0F};
	float _reference{0.0F};
	float _correction{0.0F};
};

// Acro: rate setpoint, rad/s.
void acro_rates(const StockSettings &settings, const StickInput &input, float (&rates)[3]);

// Acro: thrust upwards, 0 to 1.
float acro_thrust(const StickInput &input);

}  // namespace mimopilot
