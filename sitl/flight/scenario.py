"""What a flight is asked to do, and what goes wrong on the way: set-points, injected moments and faults over time.

A scenario file names a manoeuvre and its faults:

    manoeuvre = "doublet"       # doublet, step or hover
    axis = "roll"
    amplitude_deg = 15
    period_s = 0.42
    tail_s = 1.5                # level flight after a doublet

    [[fault]]
    kind = "motor"
    motor = 3
    size = 0.7
    at = 1.2
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
from mimopilot.sitl.errors import SitlError
from mimopilot.sitl.faults.kinds import Fault, make_fault
from mimopilot.tuning.excitation import hold_from_bandwidth, prbs
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict

from mimopilot.common.toml import checked, read_toml

AXES = ("roll", "pitch")
LEAD = 1.0  # s of hover before a manoeuvre
MAX_ANGLE = np.radians(60.0)  # a vehicle that tilts further counts as lost
AMPLITUDE_DEG, PERIOD_S, TAIL_S = 22.5, 0.42, 1.5  # of a manoeuvre that says nothing else
MIN_SAMPLES, MAX_SECONDS = 10, 3600.0


@dataclass(frozen=True, eq=False)
class Scenario:
    """One flight's inputs.

    Attributes
    ----------
    name : str
        What it is.
    Ts : float, s
        Control period.
    setpoint : (N, 3) array, rad
        Attitude set-point: roll, pitch, yaw.
    excitation : (N, 3) array
        Injected moment, dimensionless.
    axis : int
        Axis of the manoeuvre: 0 roll, 1 pitch.
    window : (start, stop)
        Samples over which the manoeuvre is judged.
    faults : tuple of Fault
        What goes wrong on the way.
    """

    name: str
    Ts: float
    setpoint: NDArray[np.float64]
    excitation: NDArray[np.float64]
    axis: int
    window: tuple[int, int]
    faults: tuple[Fault, ...] = ()


def _axis_index(axis: str) -> int:
    if axis not in AXES:
        raise SitlError(f"axis: got {axis!r}, expected roll or pitch")
    return AXES.index(axis)


def _check_length(name: str, seconds: float, Ts: float) -> None:
    if not MIN_SAMPLES * Ts <= seconds <= MAX_SECONDS:
        raise SitlError(f"{name}: got {seconds} s, expected {MIN_SAMPLES * Ts:g} to {MAX_SECONDS:g} s")


def _check_angle(amplitude: float) -> None:
    if not 0 < amplitude <= MAX_ANGLE:
        got, limit = np.degrees(amplitude), np.degrees(MAX_ANGLE)
        raise SitlError(f"amplitude: got {got:.6g} degrees, expected above 0 and at most {limit:.0f}")


def doublet(
    axis: str, amplitude: float, period: float, Ts: float, tail: float = TAIL_S, lead: float = LEAD
) -> Scenario:
    """Set-point +A for half of `period`, -A for the other half, then level.

    Parameters
    ----------
    axis : str
        ``roll`` or ``pitch``.
    amplitude : float, rad
        A.
    period : float, s
        Length of the whole doublet.
    Ts : float, s
        Control period.
    tail : float, s
        Level flight after it.
    lead : float, s
        Hover before it: what a vehicle that is out of balance needs to find its trim.
    """
    _check_angle(amplitude)
    _check_length("period", period, Ts)
    if not 0 <= tail <= MAX_SECONDS:
        raise SitlError(f"tail: got {tail} s, expected 0 to {MAX_SECONDS:g} s")
    column = _axis_index(axis)
    start, half = round(lead / Ts), round(period / 2 / Ts)
    setpoint = np.zeros((start + 2 * half + round(tail / Ts), 3))
    setpoint[start : start + half, column] = amplitude
    setpoint[start + half : start + 2 * half, column] = -amplitude
    return Scenario("doublet", Ts, setpoint, np.zeros_like(setpoint), column, (start, start + 2 * half))


def step(axis: str, amplitude: float, period: float, Ts: float) -> Scenario:
    """Set-point A for `period` seconds; arguments as `doublet`."""
    _check_angle(amplitude)
    _check_length("period", period, Ts)
    column = _axis_index(axis)
    start = round(LEAD / Ts)
    setpoint = np.zeros((start + round(period / Ts), 3))
    setpoint[start:, column] = amplitude
    return Scenario("step", Ts, setpoint, np.zeros_like(setpoint), column, (start, len(setpoint)))


def hover(axis: str, period: float, Ts: float) -> Scenario:
    """Level set-point for `period` seconds; arguments as `doublet`."""
    _check_length("period", period, Ts)
    setpoint = np.zeros((round(period / Ts), 3))
    return Scenario("hover", Ts, setpoint, np.zeros_like(setpoint), _axis_index(axis), (0, len(setpoint)))


def make_scenario(
    name: str, axis: str, amplitude_deg: float, period: float, Ts: float, tail: float = TAIL_S
) -> Scenario:
    """A scenario by name: ``doublet``, ``step`` or ``hover``; amplitude in degrees, period and tail in seconds."""
    if name == "doublet":
        return doublet(axis, float(np.radians(amplitude_deg)), period, Ts, tail)
    if tail != TAIL_S:
        raise SitlError(f"tail: belongs to a doublet, not to {name}")
    if name == "step":
        return step(axis, float(np.radians(amplitude_deg)), period, Ts)
    if name == "hover":
        return hover(axis, period, Ts)
    raise SitlError(f"scenario: got {name!r}, expected doublet, step or hover")


class Task(BaseModel):
    """The manoeuvre of a scenario file; arguments of `make_scenario`."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    manoeuvre: Literal["doublet", "step", "hover"]
    axis: Literal["roll", "pitch"] = "roll"
    amplitude_deg: float = AMPLITUDE_DEG
    period_s: float = PERIOD_S
    tail_s: float = TAIL_S


def read_scenario(path: Path) -> tuple[Task, tuple[Fault, ...]]:
    """What a scenario file says: the manoeuvre and its faults.

    Parameters
    ----------
    path : Path
        See the module's text for an example; `sitl.faults.kinds.Fault` for the fields of a fault.

    Raises
    ------
    TuningError, SitlError
        When the file is not TOML, or an entry is unknown or wrong.
    """
    table = read_toml(path, "scenario file")
    faults = table.pop("fault", [])
    if not (isinstance(faults, list) and all(isinstance(fault, dict) for fault in faults)):
        raise SitlError(f"{path}: fault: expected [[fault]] tables")
    task = checked(Task, table, str(path))
    return task, tuple(make_fault(fault, f"{path}: fault {i + 1}") for i, fault in enumerate(faults))


def load_scenario(path: Path, Ts: float) -> Scenario:
    """The scenario of a file, see `read_scenario`; its control period in s.

    Raises
    ------
    SitlError
        As `read_scenario` and `make_scenario`.
    """
    task, faults = read_scenario(path)
    try:
        scenario = make_scenario(task.manoeuvre, task.axis, task.amplitude_deg, task.period_s, Ts, task.tail_s)
    except SitlError as error:
        raise SitlError(f"{path}: {error}") from error
    return replace(scenario, faults=faults)


def excitation_flight(
    seconds_per_axis: float, amplitude: float, bandwidth: float, Ts: float, generator: np.random.Generator
) -> Scenario:
    """Hover with a PRBS moment injected on roll, then on pitch.

    Parameters
    ----------
    seconds_per_axis : float, s
        Length on each axis.
    amplitude : float
        Of the moment, dimensionless, at most 1.
    bandwidth : float, rad/s
        Of the PRBS, see `tuning.excitation.hold_from_bandwidth`.
    Ts : float, s
        Control period.
    generator : numpy.random.Generator
        Source of all randomness.
    """
    _check_length("seconds_per_axis", seconds_per_axis, Ts)
    if not 0 < amplitude <= 1:
        raise SitlError(f"amplitude: got {amplitude}, expected above 0 and at most 1, the largest moment")
    hold_min, hold_max = hold_from_bandwidth(bandwidth, Ts)
    if hold_max * Ts > seconds_per_axis:
        raise SitlError(
            f"bandwidth: at {bandwidth:g} rad/s one pulse may last {hold_max * Ts:.3g} s, longer than the "
            f"{seconds_per_axis:g} s on each axis"
        )
    samples = round(seconds_per_axis / Ts)
    excitation = np.zeros((2 * samples, 3))
    for axis in range(2):
        stretch = slice(axis * samples, (axis + 1) * samples)
        excitation[stretch, axis] = prbs(samples, amplitude, hold_min, hold_max, generator)
    return Scenario("experiment", Ts, np.zeros_like(excitation), excitation, 0, (0, len(excitation)))
