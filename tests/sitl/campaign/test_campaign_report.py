"""The page of a campaign: what it says of what varied, its map of survival, and its colours."""

from dataclasses import replace

import numpy as np
import pytest

from mimopilot.common.charts import FLOWN, NEW, SISO
from mimopilot.sitl.campaign.campaign_figures import distribution_chart, survival_chart
from mimopilot.sitl.campaign.execution import run_campaign
from mimopilot.sitl.campaign.report import write_campaign_report
from mimopilot.sitl.campaign.results import CampaignResults
from mimopilot.sitl.campaign.summary import summarise
from tests.sitl.campaign.plans import plan_of

#: The delay takes two values with one distance from their median: their rank correlation with anything is not defined.
VARY = "delay = { uniform = [0.5, 2.5] }\nwind.north = { normal = [0, 1] }"


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("vary", ["", VARY])
def test_the_report_says_what_varied_and_has_no_map_of_one_colour(vehicle, tmp_path, vary):
    default = vehicle.default_gains()
    methods = ("mimo", "siso", "default")
    sets = {name: replace(default, provenance=replace(default.provenance, method=name)) for name in methods}
    plan = plan_of(vehicle, sets, vary=vary, runs=6, axes=["roll"], tail_s=0.2)
    results = CampaignResults(plan, run_campaign(plan, tmp_path, 1))
    assert results.column("survived", "mimo", "roll").all()
    page = write_campaign_report(results, summarise(results)).read_text()
    assert ("Nothing varied but the noise of the sensors" in page) == (not vary)
    assert ("wind.north [m/s]" in page) == bool(vary)
    assert ("a map of survival would have one colour" in page) == bool(vary)
    assert 'id="survival-roll-0"' not in page
    assert 'id="responses-roll-0"' in page
    # The same colours as in every other report, whatever the order of the sets.
    (panel, *_) = distribution_chart(results, "roll").panels
    assert {line.label: line.colour for line in panel.lines} == {"mimo": NEW, "siso": SISO, "default": FLOWN}


def test_a_map_of_survival_has_the_share_of_each_cell(vehicle, tmp_path):
    class Some(CampaignResults):
        def column(self, name, gains, axis):
            columns = {"delay": [1.0, 1.0, 2.0, 2.0], "wind.north": [0.0, 1.0, 0.0, 0.0]}
            return np.array(columns.get(name, [True, False, True, False]))

    results = Some(plan_of(vehicle, vary=VARY, runs=4, axes=["roll"]), tmp_path)
    (panel,) = survival_chart(results, "roll", ("delay", "wind.north")).panels
    heat, lost = panel.lines
    assert heat.z == pytest.approx(np.array([[100.0, 50.0], [0.0, np.nan]]), nan_ok=True)
    assert (list(heat.x), list(heat.y), heat.z_range) == ([1.0, 2.0], [0.0, 1.0], (0.0, 100.0))
    assert list(zip(lost.x, lost.y, strict=True)) == [(1.0, 1.0), (2.0, 0.0)]
