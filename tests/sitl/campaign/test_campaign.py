"""Campaigns: results do not depend on the workers, resume without loss, and replay bit for bit."""

import json
import os
import signal
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from pyulog import ULog

from mimopilot.sitl.autopilot.autopilot import Autopilot
from mimopilot.sitl.campaign.execution import run_campaign
from mimopilot.sitl.campaign.flights import CHUNK, FlightRunner
from mimopilot.sitl.campaign.replay import replay_flight
from mimopilot.sitl.errors import SitlError
from mimopilot.sitl.flight.simulator import fly
from mimopilot.sitl.physics.airframe import load_airframe
from tests.conftest import assert_one_clear_line
from tests.sitl.campaign.plans import RUNS, VARY, plan_of, unstable
from tests.sitl.mavlink.running import PATIENCE_S


def test_a_run_does_not_depend_on_the_runs_flown_before(vehicle):
    plan = plan_of(vehicle, vary="")
    runner = FlightRunner(plan)
    for run in (4, 0, 2):
        for index, scenario in enumerate(plan.scenarios):
            flight = runner.fly(runner.draw(run), "default", index)
            alone = fly(vehicle.airframe, Autopilot(vehicle.airframe, vehicle.default_gains()), scenario, [3, run, 1])
            assert flight.record.tobytes() == alone.record.tobytes()
            assert flight.truth.tobytes() == alone.truth.tobytes()


@pytest.fixture(scope="module")
def whole(vehicle, tmp_path_factory):
    """The results of a campaign that one process flew without an interruption."""
    plan = plan_of(vehicle, runs=RUNS, axes=["roll"])
    return run_campaign(plan, tmp_path_factory.mktemp("whole"), 1).read_bytes()


def test_the_results_are_the_same_bytes_for_any_workers_and_after_interrupts_and_kills(whole, tmp_path):
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
def test_a_cluster_that_loses_a_worker_gives_the_same_bytes(vehicle, whole, tmp_path):
    from distributed import LocalCluster

    plan = plan_of(vehicle, runs=RUNS, axes=["roll"])
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


def test_a_mistake_found_by_the_first_draw_creates_no_folder(tmp_path):
    vary = tmp_path / "vary.toml"
    vary.write_text("mass = { uniform = [-2, -1] }\n")
    arguments = ["campaign", "adam0", "--vary", str(vary), "--runs", "3", "--out", str(tmp_path / "out")]
    result = subprocess.run([sys.executable, "-m", "mimopilot", *arguments], capture_output=True, text=True)
    assert result.returncode == 2
    assert "1000 draws in a row" in result.stderr
    assert not (tmp_path / "out").exists()
