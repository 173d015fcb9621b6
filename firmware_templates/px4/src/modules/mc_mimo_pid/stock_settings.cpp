#include "stock_settings.hpp"

#include <stddef.h>

#include "parameter_value.hpp"

namespace mimopilot
{

void read(StockSettings &settings)
{
	using px4::params;
	static constexpr params kNames[] = {
		params::MPC_MAN_TILT_MAX, params::MC_MAN_TILT_TAU, params::MPC_MAN_Y_MAX, params::MPC_MAN_Y_TAU,
		params::MC_AIRMODE, params::MPC_THR_CURVE, params::MPC_MANTHR_MIN,
		params::MPC_THR_HOVER, params::MPC_THR_MAX, params::COM_SPOOLUP_TIME, params::MC_ACRO_R_MAX,
		params::MC_ACRO_P_MAX, params::MC_ACRO_Y_MAX, params::MC_ACRO_EXPO, params::MC_ACRO_EXPO,
		params::MC_ACRO_EXPO_Y, params::MC_ACRO_SUPEXPO, params::MC_ACRO_SUPEXPO, params::MC_ACRO_SUPEXPOY,
		params::MC_BAT_SCALE_EN, params::COM_OF_LOSS_T, params::COM_RC_LOSS_T,
	};
	static_assert(offsetof(StockSettings, yaw_expo) / sizeof(float) == sizeof(kNames) / sizeof(kNames[0]),
		      "one float a parameter");
	float *value = &settings.tilt_max;

	for (const params name : kNames) {
		param_set_used(param_handle(name));
		*value = parameter_value(name);
		value++;
	}

	settings.yaw_expo = parameter_value("MPC_YAW_EXPO", 0.6F);
	settings.yaw_deadzone = parameter_value("MPC_HOLD_DZ", parameter_value("MAN_DEADZONE", 0.1F));
	settings.yaw_torque_cutoff = parameter_value("MC_YAW_TQ_CUTOFF", 0.0F);
	settings.autotune = parameter_value("MC_AT_EN", 0.0F);
}

}  // namespace mimopilot
