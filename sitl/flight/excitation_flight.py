"""The closed-loop experiment that gains are tuned from, flown once or many times."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from mimopilot.common.files import inside
from mimopilot.common.parallel import processes, run_all
from mimopilot.sitl.autopilot.autopilot import Autopilot
from mimopilot.sitl.errors import SitlError
from mimopilot.sitl.flight.flight_log import save_flight
from mimopilot.sitl.flight.scenario import EXCITED_AXES, excitation_flight
from mimopilot.sitl.flight.simulator import Flight, fly
from mimopilot.sitl.physics.airframe import Airframe
from mimopilot.sitl.physics.rigid_body import GRAVITY
from mimopilot.tuning.gains import Gains

#: Largest amplitude (normalised) of the injected torque that is proposed, as in the demo.
AMPLITUDE = 0.15
#: The same of yaw, which a unit of torque accelerates 10 to 20 times less.
YAW_AMPLITUDE = 0.3
#: On a vehicle whose motors are not known: the default of MIMO_EX_AMPY.
VEHICLE_YAW_AMPLITUDE = 0.2
#: Share of the torque that saturates a motor in hover; chosen: the response of the loop and the other axes add to it.
TORQUE_SHARE = 0.2


@dataclass(frozen=True, eq=False)
class ExperimentPlan:
    """Settings of an experiment.

    Attributes
    ----------
    airframe : Airframe
    gains : Gains
        The controller in flight.
    seconds_per_axis, amplitude, bandwidth : float
        See `sitl.flight.scenario.excitation_flight`.
    excitation_seed : int or None
        Seed of the injected torque; None: that of the flight, so that each flight has another excitation.
    both_axes : bool
        Excite roll and pitch at once, not one after the other.
    axes : str
        Axes to excite, see `sitl.flight.scenario.EXCITED_AXES`.
    yaw_amplitude : float or None
        On yaw; None: `default_yaw_amplitude`.
    """

    airframe: Airframe
    gains: Gains
    seconds_per_axis: float
    amplitude: float
    bandwidth: float
    excitation_seed: int | None
    both_axes: bool = False
    axes: str = "all"
    yaw_amplitude: float | None = None

    @property
    def seconds(self) -> float:
        """Length of the flight, s."""
        return self.seconds_per_axis * (len(EXCITED_AXES[self.axes]) - self.both_axes)

    def fly(self, seed: int) -> Flight:
        """Fly the experiment; `seed` is that of the measurement noise."""
        generator = np.random.default_rng(seed if self.excitation_seed is None else self.excitation_seed)
        scenario = excitation_flight(
            self.seconds_per_axis,
            self.amplitude,
            self.bandwidth,
            self.gains.Ts,
            generator,
            self.both_axes,
            self.axes,
            default_yaw_amplitude(self.airframe) if self.yaw_amplitude is None else self.yaw_amplitude,
        )
        return fly(self.airframe, Autopilot(self.airframe, self.gains), scenario, seed)

    def record(self, path: Path, seed: int) -> Flight:
        """Fly the experiment and write its log."""
        flight = self.fly(seed)
        save_flight(path, flight, self.airframe, self.gains)
        return flight


def default_amplitude(airframe: Airframe) -> float:
    """Amplitude of the injected torque (normalised) that saturates no motor: 0.15, or less when hover is near a limit.

    The response of the loop and the other axes add to the injected torque, so only a share of the margin is used.
    """
    return _unsaturated(airframe, slice(0, 2), AMPLITUDE)


def default_yaw_amplitude(airframe: Airframe) -> float:
    """The same on yaw: at most 0.3."""
    return _unsaturated(airframe, slice(2, 3), YAW_AMPLITUDE)


def _unsaturated(airframe: Airframe, axes: slice, largest: float) -> float:
    plant, allocation = airframe.plant(), airframe.allocation()
    hover = plant.mass * GRAVITY / (len(plant.rotors) * plant.thrust_max)
    margin = min(hover, 1 - hover) / float(np.abs(allocation.mixer[:, axes]).max())
    return min(largest, float(f"{TORQUE_SHARE * margin:.2g}"))


def check_survived(flight: Flight) -> None:
    """Refuse a flight whose vehicle was lost.

    Raises
    ------
    SitlError
        With the time, and what to change.
    """
    if flight.crashed_at is not None:
        raise SitlError(f"the vehicle was lost at {flight.crashed_at:.2f} s; lower --amplitude", exit_code=1)


def repeat_experiment(
    plan: ExperimentPlan, folder: Path, seeds: range, workers: int, done: Callable[[], Any]
) -> dict[int, float]:
    """Fly an experiment with each seed and write the logs `flight-SEED.ulg`.

    Parameters
    ----------
    plan : ExperimentPlan
        The experiment.
    folder : Path
        Folder of the logs.
    seeds : range
        One flight with each.
    workers : int
        Number of processes.
    done : callable
        Called after each flight.

    Returns
    -------
    dict
        Seed of each flight in which the vehicle was lost -> time of the loss, s. Their logs are written too.
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
    """Path of the log of a seed."""
    return inside(folder, f"flight-{seed:04d}.ulg")


def _record(plan: ExperimentPlan, folder: Path, seed: int) -> float | None:
    return plan.record(log_name(folder, seed), seed).crashed_at
