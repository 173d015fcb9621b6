// Makes the attitude setpoint from the sticks in Stabilized mode, as mc_att_control does, which this module
// replaces.
#pragma once

namespace mimopilot {

struct StickSettings {
	float tilt_max;      // rad, full roll or pitch stick
	float yaw_rate_max;  // rad/s, full yaw stick
	float thrust_min;    // at bottom, middle and top throttle, 0 to 1
	float thrust_hover;
	float thrust_max;
};

struct StickInput {
	float roll;      // -1 to 1, right positive
	float pitch;     // forward positive
	float yaw;       // clockwise positive
	float throttle;  // -1 to 1
};

struct StickSetpoint {
	float q_d[4];
	float yaw_rate;  // rad/s
	float thrust;    // 0 to 1, upwards
};

class Sticks
{
public:
	// The next setpoint() holds the heading it is given.
	void release() { _holding = false; }

	// The estimator reset its heading by this, rad.
	void shift(float angle) { _heading += angle; }

	// The heading is held while the yaw stick is centred and the throttle is not at the bottom.
	StickSetpoint setpoint(const StickSettings &settings, const StickInput &input, float heading);

private:
	bool _holding{false};
	float _heading{0.0F};
};

}  // namespace mimopilot
