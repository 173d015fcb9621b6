// What the stock mc_rate_control does to the torque and thrust of its controller.
#pragma once

#include "stock_settings.hpp"

namespace mimopilot
{

class Actuation
{
public:
	// The last battery message of a connected battery; a scale that is not positive is ignored.
	void battery(float scale) { if (scale > 0.0F) { _scale = scale; } }

	// Low-pass on the yaw torque, then the battery scale on both.
	void apply(const StockSettings &settings, float period, float (&torque)[3], float (&thrust)[3]);

	// The controller's torque that belongs to a published one, apart from the low-pass.
	float unscaled(const StockSettings &settings, float torque) const
	{
		return settings.battery_scaling > 0.5F && _scale > 0.0F ? torque / _scale : torque;
	}

	// Mean square of the torques. True if `power` has been set, each half second.
	bool power(const float (&torque)[3], float period, float (&power)[3]);

	// The yaw torque that the low-pass starts from.
	void start(float yaw_torque) { _yaw_torque = yaw_torque; }

private:
	float _scale{0.0F};  // 0: none yet
	float _yaw_torque{0.0F};
	float _energy[3] {};
	float _time{0.0F};  // s
};

}  // namespace mimopilot
