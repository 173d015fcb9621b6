// Thrust from the throttle stick in Stabilized mode, as mc_att_control makes it.
#pragma once

#include "stock_settings.hpp"

namespace mimopilot
{

class Throttle
{
public:
	// The hover thrust estimator's last message. Until the first one, MPC_THR_HOVER counts.
	void estimate(const StockSettings &settings, bool valid, float hover_thrust);

	// One period, in any mode: moves the thrust at the bottom (0 when landed), the largest one (0 until the motors
	// have spooled up) and the one at mid-stick slowly. The first call in the air moves them at once.
	void update(const StockSettings &settings, bool landed, bool spooled_up, float period);

	// 0 to 1; throttle -1 to 1, NaN counts as bottom.
	float thrust(const StockSettings &settings, float throttle) const;

private:
	bool _started{false};
	bool _estimated{false};
	float _estimate{0.0F};
	float _minimum{0.0F};
	float _maximum{0.0F};
	float _hover{0.0F};
};

}  // namespace mimopilot
