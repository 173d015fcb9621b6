#include "actuation.hpp"

#include <math.h>

namespace mimopilot
{

void Actuation::apply(const StockSettings &settings, float period, float (&torque)[3], float (&thrust)[3])
{
	constexpr float kTurn = 6.2831853F;  // rad
	const float cutoff = kTurn * settings.yaw_torque_cutoff;  // rad/s

	if (cutoff > 1.0e-6F) { torque[2] = _yaw_torque + cutoff * period / (1.0F + cutoff * period) * (torque[2] - _yaw_torque); }

	_yaw_torque = torque[2];

	if (settings.battery_scaling > 0.5F && _scale > 0.0F) {
		for (int i = 0; i < 3; i++) {
			torque[i] = fminf(fmaxf(torque[i] * _scale, -1.0F), 1.0F);
			thrust[i] = fminf(fmaxf(thrust[i] * _scale, -1.0F), 1.0F);
		}
	}
}

bool Actuation::power(const float (&torque)[3], float period, float (&power)[3])
{
	_time += period;
	const bool full = _time > 0.5F;

	for (int i = 0; i < 3; i++) {
		_energy[i] += torque[i] * torque[i] * period;

		if (full) {
			power[i] = _energy[i] / _time;
			_energy[i] = 0.0F;
		}
	}

	if (full) { _time = 0.0F; }

	return full;
}

}  // namespace mimopilot
