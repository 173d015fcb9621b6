// Sticks to an attitude set-point, for the modes in which a pilot commands angles: this module replaces the attitude
// controller, which makes them otherwise.
#pragma once

namespace mimopilot {

struct StickSettings {
	float tilt_max;      // rad, full roll or pitch stick
	float yaw_rate_max;  // rad/s, full yaw stick
	float thrust_min;    // throttle at the bottom, middle and top, 0 to 1
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
	// Hold the heading that the vehicle has at the next setpoint().
	void release() { _holding = false; }

	// The estimator's heading was reset by this angle.
	void shift(float angle) { _heading += angle; }

	// The heading is held while the yaw stick is centred and the throttle is not at the bottom.
	StickSetpoint setpoint(const StickSettings &settings, const StickInput &input, float heading);

private:
	bool _holding{false};
	float _heading{0.0F};
};

}  // namespace mimopilot
