"""Where the doublets of a check flight are in its log."""

import numpy as np
import pytest

from mimopilot.sitl.errors import SitlError
from mimopilot.sitl.field.check_flight import LEAD_S, find_doublets
from mimopilot.sitl.field.doublet_flight import BEFORE_S, DoubletPlan
from mimopilot.tuning.experiment import Experiment

TS, PLAN = 0.004, DoubletPlan(np.radians(8.0))
BEGIN = 4000  # sample at which the plan begins


def logged(late=0, smooth=1):
    """A flight whose position hold moves the setpoints by up to 6 degrees around the doublets, as PX4's does."""
    rows = round(PLAN.seconds / TS)
    setpoint = np.radians(6.0) * np.sin(0.002 * np.arange(BEGIN + rows + 5000))[:, None] * [1.0, -1.0]
    planned = np.array([PLAN.setpoint(time)[:2] for time in TS * (np.arange(rows) - late)])
    setpoint[BEGIN : BEGIN + rows] = planned
    kernel = np.ones(smooth) / smooth
    setpoint = np.column_stack([np.convolve(column, kernel)[: len(setpoint)] for column in setpoint.T])
    still = np.zeros_like(setpoint)
    return Experiment(u=still, y_i=still, y_o=still, r_o=setpoint, Ts=TS, source="check.ulg")


@pytest.mark.parametrize(("late", "smooth"), [(0, 1), (12, 1), (0, 25)])
def test_the_doublets_are_found_among_other_setpoints(late, smooth):
    found = find_doublets(logged(late, smooth), PLAN)
    delay = late + smooth // 2
    assert abs(found.start - BEGIN - delay - round((BEFORE_S - LEAD_S) / TS)) <= 1
    assert found.stop - found.start == pytest.approx((PLAN.seconds - BEFORE_S + LEAD_S) / TS, abs=1)


def test_a_log_without_the_doublets_is_refused():
    with pytest.raises(SitlError, match="does not hold the doublets"):
        find_doublets(logged(), DoubletPlan(np.radians(8.0), 3))
