"""The closed-loop experiment that gains are tuned from, once or many times."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from mimopilot.sitl.autopilot.autopilot import Autopilot
from mimopilot.sitl.flight.flight_log import save_flight
from mimopilot.sitl.flight.scenario import excitation_flight
from mimopilot.sitl.flight.simulator import Flight, fly
from mimopilot.sitl.physics.airframe import Airframe
from mimopilot.sitl.physics.rigid_body import GRAVITY
from mimopilot.tuning.gains import Gains

from mimopilot.common.files import inside
from mimopilot.common.parallel import processes, run_all

#: Largest amplitude of the injected torque that is proposed, and the share of the motors' room that it may take.
AMPLITUDE, ROOM = 0.15, 0.2


@dataclass(frozen=True, eq=False)
class ExperimentPlan:
    """An experiment.

    Attributes
    ----------
    airframe : Airframe
    gains : Gains
        Under which it is flown.
    seconds_per_axis, amplitude, bandwidth : float
        See `sitl.flight.scenario.excitation_flight`.
    excitation_seed : int or None
        Of the injected moment; None: that of the flight, so that each has another excitation.
    """

    airframe: Airframe
    gains: Gains
    seconds_per_axis: float
    amplitude: float
    bandwidth: float
    excitation_seed: int | None

    def fly(self, seed: int) -> Flight:
        """Fly it; the seed is that of the measurement noise."""
        generator = np.random.default_rng(seed if self.excitation_seed is None else self.excitation_seed)
        scenario = excitation_flight(self.seconds_per_axis, self.amplitude, self.bandwidth, self.gains.Ts, generator)
        return fly(self.airframe, Autopilot(self.airframe, self.gains), scenario, seed)

    def record(self, path: Path, seed: int) -> Flight:
        """Fly it and write its log."""
        flight = self.fly(seed)
        save_flight(path, flight, self.airframe, self.gains)
        return flight


def default_amplitude(airframe: Airframe) -> float:
    """Amplitude of the injected torque that leaves the motors room: 0.15, or less near an end of theirs.

    The loop's own answer and the other axes' add to what is injected, so only a share of the room is taken.
    """
    plant, allocation = airframe.plant(), airframe.allocation()
    hover = plant.mass * GRAVITY / (len(plant.rotors) * plant.thrust_max)
    room = min(hover, 1 - hover) / float(np.abs(allocation.mixer[:, :2]).max())
    return min(AMPLITUDE, float(f"{ROOM * room:.2g}"))


def repeat_experiment(
    plan: ExperimentPlan, folder: Path, seeds: range, workers: int, done: Callable[[], Any]
) -> dict[int, float]:
    """Write the log of an experiment for each seed: `flight-SEED.ulg`.

    Parameters
    ----------
    plan : ExperimentPlan
        What to fly.
    folder : Path
        Where the logs go.
    seeds : range
        One flight each.
    workers : int
        Processes.
    done : callable
        Called after each flight.

    Returns
    -------
    dict
        Seeds of the vehicles that were lost -> when, s. Their logs are written too.
    """
    lost: dict[int, float] = {}
    first = plan.record(log_name(folder, seeds[0]), seeds[0])  # compiles before workers are forked

    def keep(seed: int, crashed_at: float | None) -> None:
        if crashed_at is not None:
            lost[seed] = crashed_at
        done()

    keep(seeds[0], first.crashed_at)
    with processes(workers) as executor:
        run_all(executor, 2 * workers, partial(_record, plan, folder), seeds[1:], keep)
    return dict(sorted(lost.items()))


def log_name(folder: Path, seed: int) -> Path:
    """Where the log of a seed lies."""
    return inside(folder, f"flight-{seed:04d}.ulg")


def _record(plan: ExperimentPlan, folder: Path, seed: int) -> float | None:
    return plan.record(log_name(folder, seed), seed).crashed_at
