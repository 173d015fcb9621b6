// PX4's own parameters that the stock controllers use and this module uses alike, in PX4's units.
#pragma once

namespace mimopilot
{

// Switches and choices are whole numbers.
struct StockSettings {
	float tilt_max;              // MPC_MAN_TILT_MAX, deg
	float tilt_time_constant;    // MC_MAN_TILT_TAU, s
	float yaw_rate_max;          // MPC_MAN_Y_MAX, deg/s
	float yaw_time_constant;     // MPC_MAN_Y_TAU, s
	float airmode;               // MC_AIRMODE; 2: yaw too
	float throttle_curve;        // MPC_THR_CURVE
	float thrust_min;            // MPC_MANTHR_MIN
	float thrust_hover;          // MPC_THR_HOVER
	float thrust_max;            // MPC_THR_MAX
	float spool_up_time;         // COM_SPOOLUP_TIME, s
	float acro_rate_max[3];      // MC_ACRO_R_MAX, _P_MAX, _Y_MAX, deg/s
	float acro_expo[3];          // MC_ACRO_EXPO twice, MC_ACRO_EXPO_Y
	float acro_superexpo[3];     // MC_ACRO_SUPEXPO twice, MC_ACRO_SUPEXPOY
	float battery_scaling;       // MC_BAT_SCALE_EN
	float offboard_loss_time;    // COM_OF_LOSS_T, s
	float sticks_loss_time;      // COM_RC_LOSS_T, s

	// Not in every PX4; then as this PX4 does without.
	float yaw_expo;              // MPC_YAW_EXPO, up to v1.16
	float yaw_deadzone;          // MPC_HOLD_DZ, up to v1.16; then MAN_DEADZONE
	float yaw_torque_cutoff;     // MC_YAW_TQ_CUTOFF, Hz, from v1.16; 0: no filter
	float autotune;              // MC_AT_EN; 0: off
};

void read(StockSettings &settings);

}  // namespace mimopilot
