#include "multicopter.hpp"

#include <px4_platform_common/param.h>
#include <uORB/Subscription.hpp>
#include <uORB/topics/vehicle_status.h>

namespace mimopilot {

const char *not_flown()
{
	uORB::Subscription subscription{ORB_ID(vehicle_status)};
	vehicle_status_s status{};

	if (subscription.copy(&status)
	    && (status.is_vtol || status.vehicle_type != vehicle_status_s::VEHICLE_TYPE_ROTARY_WING)) {
		return "flies multicopters only, no VTOL";
	}

	// It would move the rate setpoint, which this module makes itself, and tune gains that are not flown. By name,
	// because some boards are without it.
	const param_t autotune = param_find("MC_AT_EN");
	int32_t enabled = 0;

	if (autotune != PARAM_INVALID && param_get(autotune, &enabled) == 0 && enabled > 0) {
		return "PX4's autotune is on: set MC_AT_EN to 0 and reboot";
	}

	return nullptr;
}

}  // namespace mimopilot
