// Setpoints from the sticks, as the stock controllers make them: attitude in Stabilized mode, rates in Acro.
#pragma once

#include "stock_settings.hpp"

namespace mimopilot {

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

class Sticks
{
public:
	// The next setpoint() starts level, without yaw rate, at the heading it is given.
	void release() { *this = Sticks{}; }

	// The estimator reset its heading by this, rad.
	void shift(float angle) { _heading += angle; }

	// One period. `heading` is the vehicle's, rad. The setpoint's follows it while turning, at the bottom of the
	// throttle, or if it is not `good`; else it is held.
	StickSetpoint setpoint(const StockSettings &settings, const StickInput &input, float heading, bool good, float period);

private:
	bool _holding{false};
	float _heading{0.0F};
	float _yaw_rate{0.0F};  // rad/s, filtered
	float _tilt[2] {};      // rad about roll and pitch, filtered
};

// Acro: rate setpoint, rad/s.
void acro_rates(const StockSettings &settings, const StickInput &input, float (&rates)[3]);

// Acro: thrust upwards, 0 to 1.
float acro_thrust(const StickInput &input);

}  // namespace mimopilot
