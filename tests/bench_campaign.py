"""Speed and memory of campaigns beside another simulator; part of `make bench`."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

from mimopilot.common.parallel import cores
from mimopilot.sitl.campaign.flights import FlightRunner
from mimopilot.sitl.campaign.plan import plan_from_files, read_files
from tests.bench_tuning import best

RUNS, FLIGHT_S = 10_000, 4.0
#: What the campaign varies: a dozen quantities.
VARY = """
mass = { normal = [1.0, 0.05], relative = true }
delay = { uniform = [0.5, 3.5] }
inertia.xx = { uniform = [0.8, 1.2], relative = true }
inertia.yy = { uniform = [0.8, 1.2], relative = true }
products.xy = { uniform = [-0.0032, 0.0032] }
motors.effectiveness = { uniform = [0.8, 1.0] }
motors.time_constant = { loguniform = [0.03, 0.08] }
wind.north = { normal = [0.0, 2.0] }
attitude_deg.roll = { normal = [0.0, 5.0] }
"""


def campaign_rows(folder: Path) -> list[list[str]]:
    """Rows (what, figure, beside): a campaign by its command, and its memory beside that of a smaller one."""
    spec = folder / "vary.toml"
    spec.write_text(VARY)
    seconds, large = _campaign(folder, spec, RUNS)
    _, small = _campaign(folder, spec, RUNS // 10)
    pace = RUNS * FLIGHT_S / seconds / cores()
    title = f"campaign of {RUNS} doublet flights of {FLIGHT_S:g} s, with its report"
    return [
        [f"{title}, {cores()} processes", f"{seconds:.1f} s", "under 10 s on two cores"],
        ["the same, for each core", f"{pace:.0f} x real time", ""],
        [f"one of its {FLIGHT_S:g} s flights: draw, noise, flight, figures", *_parts(folder / f"campaign-{RUNS}")],
        ["its memory, largest process", f"{large:.0f} MB", f"{small:.0f} MB with {RUNS // 10}"],
    ]


def _campaign(folder: Path, spec: Path, runs: int) -> tuple[float, float]:
    """Duration of the command, s, and memory of its largest process, MB."""
    line = [sys.executable, "-m", "mimopilot", "campaign", "adam0", "--runs", str(runs), "--axis", "roll"]
    line += ["--period-s", "1.5", "--vary", str(spec), "--out", str(folder / f"campaign-{runs}")]
    begin = time.perf_counter()
    process = subprocess.Popen(line, stdout=subprocess.DEVNULL)
    _, status, usage = os.wait4(process.pid, 0)
    if status:
        raise RuntimeError(f"the campaign ended with {status}")
    return time.perf_counter() - begin, usage.ru_maxrss / 1024


def _parts(folder: Path) -> tuple[str, str]:
    """Duration of one flight of a campaign, by parts and in total."""
    runner = FlightRunner(plan_from_files(read_files(folder)))
    seed, noise = runner.plan.description.seed, runner.noise
    draw = runner.draw(0)
    flight = runner.fly(draw, "default", 0)
    seconds = (
        best(lambda: runner.sampler.draw(seed, 0), 50),
        best(lambda: np.random.default_rng([seed, 0, 1]).standard_normal(out=noise), 50),
        best(lambda: runner.fly(draw, "default", 0), 50),
        best(lambda: runner.row(0, draw, "default", "roll", flight), 50),
    )
    return " + ".join(f"{part * 1e6:.0f}" for part in seconds) + " us", f"{sum(seconds) * 1e6:.0f} us"


def rotorpy_rows(speed: float) -> list[list[str]]:
    """A row for rotorpy if it is installed: one Runge-Kutta step of 1 ms as here, without a controller.

    Parameters
    ----------
    speed : float
        Of the flight in process, controller and sensors included, times real time.
    """
    try:
        from rotorpy.vehicles.crazyflie_params import quad_params
        from rotorpy.vehicles.multirotor import Multirotor
    except ImportError:
        return []
    one_step = {"method": "RK45", "first_step": 1e-3, "rtol": 1e9, "atol": 1e9}
    vehicle = Multirotor(quad_params, integrator_kwargs=one_step)
    command = {"cmd_motor_speeds": vehicle.initial_state["rotor_speeds"]}
    steps = 200

    def fly() -> None:
        state = dict(vehicle.initial_state)
        for _ in range(steps):
            state = vehicle.step(state, command, 1e-3)

    other = steps * 1e-3 / best(fly, 3)
    return [["rotorpy, one vehicle, step of 1 ms, no controller", f"{other:.2f} x real time", f"1/{speed / other:.0f}"]]
