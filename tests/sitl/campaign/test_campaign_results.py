"""Results of campaigns: gain sets on the same vehicles, pairs, the summary and the map."""

from dataclasses import replace

import numpy as np
import pyarrow.parquet as pq
import pytest

from mimopilot.common.intervals import wilson
from mimopilot.sitl.campaign.campaign_figures import choose_map, parse_map
from mimopilot.sitl.campaign.execution import run_campaign
from mimopilot.sitl.campaign.flights import FlightRunner
from mimopilot.sitl.campaign.pairs import compare_pairs
from mimopilot.sitl.campaign.results import CampaignResults
from mimopilot.sitl.campaign.summary import summarise
from mimopilot.sitl.campaign.varied import COUPLING, summarise_varied
from mimopilot.sitl.errors import SitlError
from mimopilot.sitl.studies.true_plant import optimum_on_true_plant
from mimopilot.tuning.reference_model import SecondOrder
from tests.paths import DOCS
from tests.sitl.campaign.plans import plan_of, unstable


def test_every_gain_set_flies_the_same_vehicles_and_an_unstable_one_never_survives(vehicle, tmp_path):
    good = vehicle.default_gains()
    plan = plan_of(vehicle, {"good": good, "bad": unstable(good)}, axes=["pitch"])
    results = run_campaign(plan, tmp_path, 2)
    table = pq.read_table(results)
    n = plan.description.runs
    good_rows, bad_rows = (table.filter(np.array(table["gains"].to_pylist()) == name) for name in ("good", "bad"))
    assert good_rows["run"].to_pylist() == bad_rows["run"].to_pylist() == list(range(n))
    for name in table.column_names[table.column_names.index("rejected_draws") :]:
        assert good_rows[name].equals(bad_rows[name]), name
    survived = {
        group.gains: (group.survived, group.survived_share)
        for group in summarise(CampaignResults(plan, results)).groups
    }
    assert survived == {"good": (n, wilson(n, n)), "bad": (0, wilson(0, n))}
    worst = summarise(CampaignResults(plan, results)).groups[1].worst[0]
    assert worst.lost_at_s == min(bad_rows["lost_at_s"].to_pylist())


def test_pairs_are_compared_run_by_run(vehicle, tmp_path):
    own = vehicle.default_gains()
    softer = replace(own, Kp_o=0.7 * own.Kp_o, certificate=None)
    other = replace(own.provenance, outer_model=(SecondOrder(8.0, 0.7),) * 2)
    sets = {"own": own, "softer": softer, "third": replace(own, provenance=other, certificate=None)}
    plan = plan_of(vehicle, sets, axes=["roll"])
    results = run_campaign(plan, tmp_path, 2)
    pairs = {(one.figure, one.first, one.second): one for one in compare_pairs(CampaignResults(plan, results))}
    # J_M,o is not compared when each set is judged by another model.
    assert {key[1:] for key in pairs if key[0] == "J_M_o"} == {("own", "softer")}
    assert len(pairs) == 3 * 3 + 1
    rows = pq.read_table(results).to_pylist()
    for figure in ("J_M_o", "effort_rms"):
        softer, own = ({row["run"]: row[figure] for row in rows if row["gains"] == key} for key in ("softer", "own"))
        difference = np.sort([value - own[run] for run, value in softer.items()])
        one = pairs[figure, "own", "softer"]
        assert one.runs == len(difference) == plan.description.runs
        assert (one.only_first, one.only_second) == (0, 0)
        assert one.difference[0] == difference[(len(difference) - 1) // 2]
        assert one.difference[1] < one.difference[0] < one.difference[2]
        assert one.lower == (difference < 0).sum()
        assert one.lower_share == wilson(one.lower, one.runs)
    assert pairs["effort_rms", "own", "softer"].difference[2] < 0  # lower gains move the motors less
    # The same gains under another name: no run differs, in any figure that has no model.
    same = pairs["offaxis_peak_deg", "own", "third"]
    assert (same.difference, same.lower) == ((0.0, 0.0, 0.0), 0)


def test_a_pair_counts_the_runs_that_only_one_set_survives(vehicle, tmp_path):
    good = vehicle.default_gains()
    plan = plan_of(vehicle, {"good": good, "bad": unstable(good)}, axes=["pitch"], runs=20)
    (one, *_) = compare_pairs(CampaignResults(plan, run_campaign(plan, tmp_path, 1)))
    assert (one.runs, one.only_first, one.only_second) == (0, 20, 0)
    assert np.isnan(one.difference).all()


def test_the_summary_says_what_varied_and_that_the_coupling_is_the_vehicles_own(vehicle, tmp_path):
    inertia = vehicle.airframe.inertia
    own = inertia[0][1] / np.sqrt(inertia[0][0] * inertia[1][1])
    kept = """
delay = { uniform = [0.5, 2.5] }
inertia.xx = { uniform = [0.9, 1.2], relative = true }
inertia.yy = { normal = [1.0, 0.02], relative = true }
"""
    plan = plan_of(vehicle, vary=kept, axes=["roll"], runs=200)
    found = {one.name: one for one in summarise_varied(CampaignResults(plan, run_campaign(plan, tmp_path / "a", 1)))}
    assert set(found) == {"delay [samples]", "inertia.xx [kg m^2]", "inertia.yy [kg m^2]", COUPLING}
    assert found["inertia.xx [kg m^2]"].distribution == "uniform 0.9, 1.2 x own"
    assert found["inertia.xx [kg m^2]"].own == inertia[0][0]
    low, middle, high = found["inertia.xx [kg m^2]"].drawn
    assert low / inertia[0][0] == pytest.approx(0.915, abs=0.02)
    assert middle / inertia[0][0] == pytest.approx(1.05, abs=0.03)
    assert high / inertia[0][0] == pytest.approx(1.185, abs=0.02)
    assert found[COUPLING].drawn == pytest.approx([own] * 3, rel=1e-12)
    runner = FlightRunner(plan)
    J = runner.draw(7).plant.inertia
    assert J[0, 1] / np.sqrt(J[0, 0] * J[1, 1]) == pytest.approx(own, rel=1e-12)
    other = kept + "products.xy = { uniform = [0.5, 2.0], relative = true }\n"
    plan = plan_of(vehicle, vary=other, axes=["roll"], runs=200)
    found = {one.name: one for one in summarise_varied(CampaignResults(plan, run_campaign(plan, tmp_path / "b", 1)))}
    low, _, high = found[COUPLING].drawn
    J = FlightRunner(plan).draw(7).plant.inertia
    assert low < J[0, 1] / np.sqrt(J[0, 0] * J[1, 1]) < 2.1 * own
    assert high > 1.5 * own


def test_the_example_of_the_manual_shows_the_benefit_of_decoupling(vehicle, tmp_path):
    text = (DOCS / "campaigns.md").read_text()
    vary = text.partition("```toml\n")[2].partition("```")[0]
    assert "inertia.xx" in vary
    assert "products" not in vary
    truth = vehicle.airframe
    gains = vehicle.default_gains()
    full = optimum_on_true_plant(truth, gains).gains
    diagonal = {name: np.diag(np.diag(getattr(full, name))) for name in ("Kp_o", "Kp_i", "Ki_i", "Kd_i")}
    sets = {"diagonal": replace(full, certificate=None, **diagonal), "full": replace(full, certificate=None)}
    plan = plan_of(vehicle, sets, vary=vary, runs=100)
    pairs = compare_pairs(CampaignResults(plan, run_campaign(plan, tmp_path, 2)))
    for one in pairs:
        if one.figure == "offaxis_peak_deg":
            assert one.difference[2] < -0.4
            assert one.lower_share[0] > 0.9


def test_the_summary_agrees_with_the_results(vehicle, tmp_path):
    plan = plan_of(vehicle, axes=["roll"])
    results = run_campaign(plan, tmp_path, 1)
    (group,) = summarise(CampaignResults(plan, results)).groups
    figures = np.sort(pq.read_table(results)["J_M_o"].to_numpy())
    value, low, high = group.quantiles["J_M_o"]["0.5"]
    assert value == figures[(len(figures) - 1) // 2]
    assert low < value < high
    assert group.worst[0].J_M_o == figures[-1]


def test_the_map_shows_the_most_influential_quantities_and_only_varied_ones(vehicle, tmp_path):
    vary = """
wind = { north = { normal = [0, 0.1] }, east = { normal = [0, 0.1] } }
motors = { time_constant = { loguniform = [0.03, 0.5] }, effectiveness = { uniform = [0.99, 1.0] } }
[[fault]]
kind = "gain"
size = { uniform = [0.5, 5.0] }
at = 1.1
"""
    plan = plan_of(vehicle, vary=vary, axes=["roll"])
    results = CampaignResults(plan, run_campaign(plan, tmp_path, 1))
    survived = results.column("survived", "default", "roll")
    assert 0.1 < survived.mean() < 0.9
    assert set(choose_map(results)) == {"motors.time_constant", "fault.1.size"}
    assert parse_map(plan, "wind.north,wind.east") == ("wind.north", "wind.east")
    for wrong in ("mass,drag", "wind.north", "wind.north,wind.north"):
        with pytest.raises(
            SitlError, match=f"--map: got '{wrong}', expected two varied quantities: motors.time_constant"
        ):
            parse_map(plan, wrong)
