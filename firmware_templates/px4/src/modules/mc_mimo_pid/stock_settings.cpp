#include "stock_settings.hpp"

#include <stddef.h>

#include "parameter_value.hpp"

namespace mimopilot {

void read(StockSettings &settings)
{
	using px4::params;
	static constexpr params kNames[] = {
		params::MPC_MAN_TILT_MAX, params::MC_MAN_TILT_TAU, params::MPC_MAN_Y_MAX, params::MPC_MAN_Y_TAU,
		params::MPC_YAW_EXPO, params::MPC_HOLD_DZ, params::MC_AIRMODE, params::MPC_THR_CURVE, params::MPC_MANTHR_MIN,
		params::MPC_THR_HOVER, params::MPC_THR_MAX, params::COM_SPOOLUP_TIME, params::MC_ACRO_R_MAX,
		params::MC_ACRO_P_MAX, params::MC_ACRO_Y_MAX, params::MC_ACRO_EXPO, params::MC_ACRO_EXPO,
		params::MC_ACRO_EXPO_Y, params::MC_ACRO_SUPEXPO, params::MC_ACRO_SUPEXPO, params::MC_ACRO_SUPEXPOY,
		params::MC_BAT_SCALE_EN, params::MC_YAW_TQ_CUTOFF, params::COM_OF_LOSS_T, params::COM_RC_LOSS_T,
	};
	static_assert(offsetof(StockSettings, autotune) / sizeof(float) == sizeof(kNames) / sizeof(kNames[0]), "one float a parameter");
	float *value = &settings.tilt_max;

	for (const params name : kNames) {
		param_set_used(param_handle(name));
		*value = parameter_value(name);
		value++;
	}

	// By name, because some boards are without it.
	const param_t autotune = param_find("MC_AT_EN");
	int32_t enabled = 0;
	settings.autotune = autotune != PARAM_INVALID && param_get(autotune, &enabled) == 0 && enabled > 0;
}

}  // namespace mimopilot
