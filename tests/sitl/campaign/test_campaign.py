"""Campaigns: results do not depend on the workers, resume without loss, and replay bit for bit."""

import json
import os
import re
import signal
import subprocess
import sys
import time
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pyulog import ULog
from scipy.special import ndtri
from scipy.stats import binom

from mimopilot.common.charts import FLOWN, NEW, SISO
from mimopilot.common.errors import InputFileError
from mimopilot.common.intervals import quantile, wilson
from mimopilot.sitl.autopilot.autopilot import Autopilot
from mimopilot.sitl.campaign.campaign_figures import choose_map, distribution_chart, parse_map, survival_chart
from mimopilot.sitl.campaign.draws import RunSampler
from mimopilot.sitl.campaign.execution import run_campaign
from mimopilot.sitl.campaign.flights import CHUNK, FlightRunner
from mimopilot.sitl.campaign.pairs import compare_pairs
from mimopilot.sitl.campaign.plan import make_plan
from mimopilot.sitl.campaign.replay import replay_flight
from mimopilot.sitl.campaign.report import write_campaign_report
from mimopilot.sitl.campaign.results import CampaignResults
from mimopilot.sitl.campaign.summary import summarise
from mimopilot.sitl.campaign.variation import variation_from_toml
from mimopilot.sitl.campaign.varied import COUPLING, summarise_varied
from mimopilot.sitl.errors import SitlError
from mimopilot.sitl.flight.scenario import doublet
from mimopilot.sitl.flight.simulator import fly
from mimopilot.sitl.physics.airframe import load_airframe
from mimopilot.sitl.physics.rigid_body import GRAVITY, checked_inertia
from mimopilot.sitl.studies.true_plant import optimum_on_true_plant
from mimopilot.tuning.reference_model import SecondOrder
from tests.conftest import assert_one_clear_line
from tests.paths import DOCS
from tests.sitl.mavlink.running import PATIENCE_S

RUNS = 40 * CHUNK  # enough to interrupt the campaign while it flies
VARY = """
mass = { normal = [1.0, 0.05], relative = true }
delay = { uniform = [0.5, 3.5] }
[inertia]
xx = { uniform = [0.9, 1.3], relative = true }
[motors]
effectiveness = { uniform = [0.8, 1.0] }
time_constant = { loguniform = [0.03, 0.08] }
[noise]
rate = { uniform = [0.5, 2.0], relative = true }
[attitude_deg]
roll = { normal = [0.0, 5.0] }
[rates_deg_s]
pitch = { normal = [0.0, 20.0] }
[wind]
north = { normal = [1.0, 2.0] }
"""


@pytest.fixture(scope="module")
def vehicle():
    return load_airframe("adam0")


def plan_of(vehicle, gains=None, vary=VARY, **entries):
    import tomllib

    given = {"runs": 2 * CHUNK + 5, "seed": 3, "manoeuvre": "doublet", "axes": ["roll", "pitch"]}
    given |= {"amplitude_deg": 22.5, "period_s": 0.42, "tail_s": 1.5, "vary": tomllib.loads(vary)}
    return make_plan(vehicle, gains or {"default": vehicle.default_gains()}, **(given | entries))


def unstable(gains):
    return replace(gains, Kp_i=gains.Kp_i + 5 * gains.Kp_i[::-1], certificate=None)  # couples the axes


def drawn(vehicle, vary, runs=2000):
    sampler = RunSampler(vehicle.airframe, variation_from_toml(vary, "spec"), doublet("roll", 0.4, 0.42, 0.004))
    return [sampler.draw(5, run) for run in range(runs)]


def test_a_run_does_not_depend_on_the_runs_flown_before(vehicle):
    plan = plan_of(vehicle, vary="")
    runner = FlightRunner(plan)
    for run in (4, 0, 2):
        for index, scenario in enumerate(plan.scenarios):
            flight = runner.fly(runner.draw(run), "default", index)
            alone = fly(vehicle.airframe, Autopilot(vehicle.airframe, vehicle.default_gains()), scenario, [3, run, 1])
            assert flight.record.tobytes() == alone.record.tobytes()
            assert flight.truth.tobytes() == alone.truth.tobytes()


def test_draws_have_the_moments_of_their_distributions(vehicle):
    n = 2000
    values = [draw.values for draw in drawn(vehicle, VARY, n)]
    columns = {name: np.array([value[name] for value in values]) for name in values[0]}
    own = vehicle.airframe
    low, high = np.log(0.03), np.log(0.08)
    expected = {  # mean, standard deviation
        "mass": (own.mass, 0.05 * own.mass),
        "inertia.xx": (1.1 * own.inertia[0][0], 0.4 * own.inertia[0][0] / np.sqrt(12)),
        "motors.effectiveness.3": (0.9, 0.2 / np.sqrt(12)),
        "noise.rate": (1.25 * own.noise.rate, 1.5 * own.noise.rate / np.sqrt(12)),
        "attitude_deg.roll": (0.0, 5.0),
        "rates_deg_s.pitch": (0.0, 20.0),
        "wind.north": (1.0, 2.0),
    }
    for name, (mean, deviation) in expected.items():
        assert columns[name].mean() == pytest.approx(mean, abs=4 * deviation / np.sqrt(n)), name
        assert columns[name].std() == pytest.approx(deviation, rel=4 / np.sqrt(n)), name
    logarithm = np.log(columns["motors.time_constant"])
    assert logarithm.mean() == pytest.approx((low + high) / 2, abs=4 * (high - low) / np.sqrt(12 * n))
    assert np.unique(columns["delay"], return_counts=True)[1] == pytest.approx([n / 3] * 3, abs=4 * np.sqrt(n * 2 / 9))
    motors = np.corrcoef([columns[f"motors.effectiveness.{i}"] for i in (1, 2, 3, 4)])
    assert np.abs(motors - np.eye(4)).max() < 4 / np.sqrt(n)


def test_the_flight_uses_the_drawn_values(vehicle):
    own = vehicle.airframe.plant()
    share = own.inertia[0, 1] / np.sqrt(own.inertia[0, 0] * own.inertia[1, 1])
    for draw in drawn(vehicle, VARY, 20):
        inertia = draw.plant.inertia
        assert (draw.plant.mass, draw.delay) == (draw.values["mass"], draw.values["delay"])
        assert inertia[0, 0] == pytest.approx(draw.values["inertia.xx"], rel=1e-12)
        assert inertia[0, 1] / np.sqrt(inertia[0, 0] * inertia[1, 1]) == pytest.approx(share, rel=1e-12)
        assert draw.plant.inertia_inverse @ inertia == pytest.approx(np.eye(3), abs=1e-12)
        assert draw.state[11] == np.radians(draw.values["rates_deg_s.pitch"])
        assert 2 * np.degrees(np.arcsin(draw.state[7])) == pytest.approx(draw.values["attitude_deg.roll"], abs=1e-5)
        thrust = 4 * draw.state[13] ** 2 * draw.plant.thrust_coefficient
        assert thrust == pytest.approx(draw.plant.mass * GRAVITY, rel=1e-12)


def test_impossible_draws_are_repeated_and_counted_and_an_impossible_specification_is_refused(vehicle):
    wide = "[inertia]\nzz = { uniform = [0.5, 1.5], relative = true }"
    draws = drawn(vehicle, wide, 300)
    for draw in draws:
        checked_inertia(draw.plant.inertia)
    # J_zz above J_xx + J_yy, 0.0319 of at most 0.04425: about 42 % of the draws.
    possible = 300 / (300 + sum(draw.rejected for draw in draws))
    assert possible == pytest.approx(0.58, abs=0.06)
    with pytest.raises(SitlError, match=r"run 0: 1000 draws in a row .* cannot hover"):
        drawn(vehicle, "mass = { uniform = [3.0, 4.0] }", 1)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("mass = { uniform = [1, 2], normal = [1, 2] }", "mass: expected exactly one"),
        ("mass = { uniform = [2, 1] }", "mass: uniform: expected [low, high]"),
        ("mass = { loguniform = [0, 1] }", "mass: loguniform: expected bounds above 0"),
        ("wind = { north = { normal = [1, 1], relative = true } }", "wind: the airframe has no value of its own"),
        ("weight = { normal = [1, 1] }", "weight: unknown entry"),
        ("mass = ", "not a TOML file"),
    ],
)
def test_a_wrong_specification_is_refused_with_the_name_of_its_entry(text, words):
    with pytest.raises(InputFileError) as error:
        variation_from_toml(text, "spec.toml")
    assert words in str(error.value)


def test_faults_are_those_of_the_scenario_and_the_drawn_ones_and_do_not_affect_the_next_run(vehicle):
    vary = """
[[fault]]
kind = "motor"
motor = { uniform = [0.5, 4.5] }
size = { uniform = [0.7, 0.9] }
at = { uniform = [1.0, 1.4] }
[[fault]]
kind = "gain"
matrix = "Kp_i"
size = 0.9
at = 1.2
"""
    plan = plan_of(vehicle, vary=vary, faults=["gyro-stuck:roll@1.1+0.02", "loss=0.2@0.5"], axes=["roll"])
    runner = FlightRunner(plan)
    motors = set()
    for run in (5, *range(30)):
        draw = runner.draw(run)
        assert [fault.kind for fault in draw.faults] == ["gyro-stuck", "loss", "motor", "gain"]
        assert draw.faults[2].size == draw.values["fault.1.size"]
        motors.add(draw.faults[2].motor)
        flight = runner.fly(draw, "default", 0)
        scenario = replace(plan.scenarios[0], faults=draw.faults)
        alone = fly(vehicle.airframe, Autopilot(vehicle.airframe, vehicle.default_gains()), scenario, [3, run, 1])
        assert flight.record.tobytes() == alone.record.tobytes()
        assert (flight.runs == alone.runs).all()
    assert motors == {1, 2, 3, 4}


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


def test_the_results_are_the_same_bytes_for_any_workers_and_after_interrupts_and_kills(vehicle, tmp_path):
    plan = plan_of(vehicle, runs=RUNS, axes=["roll"])
    whole = run_campaign(plan, tmp_path / "whole", 1).read_bytes()
    vary = tmp_path / "vary.toml"
    vary.write_text(VARY)
    out = tmp_path / "out"
    command = [
        sys.executable,
        "-m",
        "mimopilot",
        "campaign",
        "adam0",
        "--runs",
        str(RUNS),
        "--seed",
        "3",
        "--axis",
        "roll",
    ]
    command += ["--vary", str(vary), "--out", str(out), "--workers", "2", "--json"]

    def started(parts):
        # Background jobs of a shell ignore Ctrl-C, and so do their children.
        heed = partial(signal.signal, signal.SIGINT, signal.SIG_DFL)
        process = subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True, preexec_fn=heed)
        deadline = time.monotonic() + PATIENCE_S
        while len(list((out / "parts").glob("[0-9]*.part"))) < parts:
            assert time.monotonic() < deadline
            assert process.poll() is None, process.stderr.read()
            time.sleep(0.005)
        return process

    process = started(3)
    process.send_signal(signal.SIGINT)
    _, message = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 130
    assert f"of {RUNS} runs; give the same command again" in message
    kept = {path: path.stat().st_mtime_ns for path in (out / "parts").glob("[0-9]*.part")}
    assert len(kept) >= 3

    process = started(len(kept) + 3)
    workers = [int(pid) for pid in Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()]
    assert len(workers) == 2
    process.kill()
    process.communicate()
    assert all(path.stat().st_mtime_ns == when for path, when in kept.items())
    deadline = time.monotonic() + PATIENCE_S
    while any(alive(pid) for pid in workers):
        assert time.monotonic() < deadline, "the workers outlive the campaign"
        time.sleep(0.05)

    finished = subprocess.run(command, capture_output=True, text=True, check=True)
    assert (out / "results.parquet").read_bytes() == whole
    assert not (out / "parts").exists()
    assert json.loads(finished.stdout)["runs"] == RUNS
    assert pq.read_table(out / "results.parquet")["run"].to_pylist() == list(range(RUNS))
    assert "<svg" in (out / "report.html").read_text()


def alive(pid):
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


@pytest.fixture
def environment():
    """Restores the environment: a cluster sets the number of threads in it, which later tests would inherit."""
    before = dict(os.environ)
    yield
    os.environ.clear()
    os.environ.update(before)


@pytest.mark.usefixtures("environment")
def test_a_cluster_that_loses_a_worker_gives_the_same_bytes(vehicle, tmp_path):
    from distributed import LocalCluster

    plan = plan_of(vehicle, runs=RUNS, axes=["roll"])
    whole = run_campaign(plan, tmp_path / "whole", 1).read_bytes()
    with LocalCluster(
        n_workers=2, threads_per_worker=1, host="127.0.0.1", dashboard_address=None, scheduler_port=0
    ) as cluster:
        pids = [worker.pid for worker in cluster.workers.values()]
        killer = subprocess.Popen(
            [sys.executable, "-c", KILLER, str(tmp_path / "cluster" / "parts"), str(pids[0])], stdout=subprocess.PIPE
        )
        results = run_campaign(plan, tmp_path / "cluster", 1, cluster.scheduler_address)
        assert 3 <= int(killer.communicate(timeout=PATIENCE_S)[0]) < RUNS // CHUNK
    assert results.read_bytes() == whole


#: Waits for the third part and kills a worker while the campaign goes on.
KILLER = """
import os, signal, sys, time
from pathlib import Path
while (parts := len(list(Path(sys.argv[1]).glob("[0-9]*.part")))) < 3:
    time.sleep(0.005)
os.kill(int(sys.argv[2]), signal.SIGKILL)
print(parts)
"""


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


@pytest.mark.filterwarnings("error")
def test_the_report_says_what_varied_and_has_no_map_of_one_colour(vehicle, tmp_path):
    default = vehicle.default_gains()
    tuned = {
        name: replace(default, provenance=replace(default.provenance, method=name)) for name in ("mimo", "siso", "default")
    }
    for folder, vary in (("same", ""), ("varied", "delay = { uniform = [0.5, 2.5] }\nwind.north = { normal = [0, 1] }")):
        plan = plan_of(vehicle, tuned, vary=vary, runs=6, axes=["roll"], tail_s=0.2)
        results = CampaignResults(plan, run_campaign(plan, tmp_path / folder, 1))
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
    plan = plan_of(vehicle, vary="delay = { uniform = [0.5, 2.5] }\nwind.north = { normal = [0, 1] }", runs=4, axes=["roll"])

    class Some(CampaignResults):
        def column(self, name, gains, axis):
            columns = {"delay": [1.0, 1.0, 2.0, 2.0], "wind.north": [0.0, 1.0, 0.0, 0.0]}
            return np.array(columns[name] if name in columns else [True, False, True, False])

    (panel,) = survival_chart(Some(plan, tmp_path), "roll", ("delay", "wind.north")).panels
    heat, lost = panel.lines
    assert heat.z == pytest.approx(np.array([[100.0, 50.0], [0.0, np.nan]]), nan_ok=True)
    assert (list(heat.x), list(heat.y), heat.z_range) == ([1.0, 2.0], [0.0, 1.0], (0.0, 100.0))
    assert list(zip(lost.x, lost.y, strict=True)) == [(1.0, 1.0), (2.0, 0.0)]


def test_another_campaign_in_the_same_folder_is_refused_with_the_difference(vehicle, tmp_path):
    good = vehicle.default_gains()
    run_campaign(plan_of(vehicle, runs=2, axes=["roll"]), tmp_path, 1)
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    others = {
        "seed: 3 in the folder, 4 now": plan_of(vehicle, runs=2, axes=["roll"], seed=4),
        "vary: ": plan_of(vehicle, runs=2, axes=["roll"], vary=""),
        "gains/default.gains.toml differs": plan_of(vehicle, {"default": unstable(good)}, runs=2, axes=["roll"]),
        "airframe.toml differs": plan_of(load_airframe("adam0_nominal"), runs=2, axes=["roll"]),
    }
    for words, plan in others.items():
        with pytest.raises(SitlError, match="holds another campaign") as error:
            run_campaign(plan, tmp_path, 1)
        assert words in str(error.value)
    assert before == {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    (tmp_path / "spec.toml").unlink()
    with pytest.raises(SitlError, match="holds results but no spec"):
        run_campaign(plan_of(vehicle, runs=2, axes=["roll"]), tmp_path, 1)


def test_a_replayed_run_has_the_figures_of_the_results_and_its_log_is_the_same_flight(vehicle, mimopilot, tmp_path):
    plan = plan_of(vehicle, runs=12)
    results = run_campaign(plan, tmp_path / "c", 1)
    for row in pq.read_table(results).to_pylist():
        again = replay_flight(tmp_path / "c", row["run"], row["gains"], row["axis"])
        assert {**again.row, "lost_at_s": None} == {**row, "lost_at_s": None}
        again.compare()
    finished = mimopilot("replay", tmp_path / "c", "--run", 7, "--axis", "pitch", "--out", "w.ulg", "--json")
    assert finished.returncode == 0, finished.stderr
    shown = json.loads(finished.stdout)
    torque = ULog(str(tmp_path / "w.ulg")).get_dataset("vehicle_torque_setpoint").data
    u = np.array([torque["xyz[0]"], torque["xyz[1]"]], float)[:, slice(*plan.scenarios[1].window)]
    assert np.sqrt(np.mean(np.sum(u**2, axis=0))) == pytest.approx(shown["effort_rms"], rel=1e-12)
    assert_one_clear_line(mimopilot("replay", tmp_path / "c", "--run", 12), "runs 0 to 11")


@given(st.integers(1, 5000), st.data())
def test_wilsons_bounds_are_the_limits_of_the_score_test(n, data):
    k = data.draw(st.integers(0, n))
    z = ndtri(0.975)
    for bound, end in zip(wilson(k, n), (0, n), strict=True):
        if k == end:
            assert bound == end / n
        else:
            assert abs(k / n - bound) == pytest.approx(z * np.sqrt(bound * (1 - bound) / n), rel=1e-6)


@given(st.integers(1, 400), st.sampled_from([0.05, 0.5, 0.95]))
def test_intervals_of_quantiles_have_at_least_their_nominal_coverage(n, p):
    _, low, high = quantile(np.arange(n, dtype=float), p)
    # The quantile lies between the sorted samples i and i + 1 with the probability of i successes in n.
    first = 0 if np.isnan(low) else int(low) + 1
    last = n if np.isnan(high) else int(high)
    assert binom.pmf(np.arange(first, last + 1), n, p).sum() >= 0.95
    inside = binom.pmf(np.arange(first + 1, last), n, p).sum()
    assert inside < 0.95


def test_the_specification_in_the_manual_can_be_drawn_from(vehicle):
    section = (DOCS / "campaigns.md").read_text()
    example = "\n".join(re.findall(r"```toml\n(.*?)```", section, re.DOTALL))
    names = drawn(vehicle, example, 1)[0].values
    assert {"mass", "delay", "inertia.xx", "motors.effectiveness.4", "fault.1.motor", "amplitude_deg"} <= set(names)


def test_a_mistake_found_by_the_first_draw_creates_no_folder(tmp_path):
    vary = tmp_path / "vary.toml"
    vary.write_text("mass = { uniform = [-2, -1] }\n")
    arguments = ["campaign", "adam0", "--vary", str(vary), "--runs", "3", "--out", str(tmp_path / "out")]
    result = subprocess.run([sys.executable, "-m", "mimopilot", *arguments], capture_output=True, text=True)
    assert result.returncode == 2
    assert "1000 draws in a row" in result.stderr
    assert not (tmp_path / "out").exists()
