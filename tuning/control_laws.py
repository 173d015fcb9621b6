"""The control laws that gains are made for, by name: ours, and those of PX4, ArduPilot and Betaflight."""

from __future__ import annotations

from mimopilot.tuning.law_filters import ARDUPILOT_STOCK, BETAFLIGHT, MIMO, PX4_STOCK, Filters
from mimopilot.tuning.law_terms import LOOP_TERMS, ControlLaw
from mimopilot.tuning.stock_laws import ARDUPILOT_LAW, BETAFLIGHT_LAW, PX4_LAW

_MIMO_TEXT = (
    "# mimopilot gains. Row: output; column: error; roll then pitch. Positive Kd damps.",
    "# r_i = Kp_o (r_o - y_o);  u = Kp_i (r_i - y_i) + I - Kd_i dy_i/dt + Kff_i r_i,  I += Ts Ki_i (r_i - y_i)",
)
#: Name of a law -> the law.
LAWS = {
    MIMO: ControlLaw(LOOP_TERMS, _MIMO_TEXT, coupled=True, delay=0, lacks=()),
    PX4_STOCK: PX4_LAW,
    ARDUPILOT_STOCK: ARDUPILOT_LAW,
    BETAFLIGHT: BETAFLIGHT_LAW,
}


def control_law(filters: Filters) -> ControlLaw:
    """The law that a set of gains with these filters is for."""
    return LAWS[MIMO if filters.stock is None else filters.stock.controller]
