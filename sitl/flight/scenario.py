"""Scenarios: the setpoints, injected torques and faults of a flight over time.

A scenario file names a manoeuvre and its faults:

    manoeuvre = "doublet"       # doublet, step or hover
    axis = "roll"
    amplitude_deg = 15
    period_s = 0.42
    tail_s = 1.5                # level flight after a doublet
    rate_limit_deg_s = 220      # largest rate of the setpoint; without it the setpoint jumps

    [[fault]]
    kind = "motor"
    motor = 3
    size = 0.7
    at = 1.2
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict

from mimopilot.common.errors import check_choice, check_not_given
from mimopilot.common.toml import checked, read_toml
from mimopilot.sitl.autopilot.failure_detector import MAX_TILT
from mimopilot.sitl.errors import SitlError
from mimopilot.sitl.faults.kinds import Fault, make_fault, parse_fault
from mimopilot.tuning.excitation import YAW_HOLD, hold_from_bandwidth, prbs

AXES = ("roll", "pitch")
#: Name -> axes that an experiment excites, one after the other.
EXCITED_AXES = {"roll": (0,), "pitch": (1,), "both": (0, 1), "yaw": (2,), "all": (0, 1, 2)}
LEAD = 1.0  # s of hover before a manoeuvre; chosen: the measured rates and the integrators have settled
#: Defaults of a manoeuvre, deg, s, s: the doublet of the thesis; the tail is chosen.
AMPLITUDE_DEG, PERIOD_S, TAIL_S = 22.5, 0.42, 1.5
MIN_SAMPLES, MAX_SECONDS = 10, 3600.0  # of a manoeuvre; chosen: enough to judge, and bounded memory


@dataclass(frozen=True, eq=False)
class Scenario:
    """Inputs of one flight.

    Attributes
    ----------
    name : str
        Kind of scenario.
    Ts : float, s
        Control period.
    setpoint : (N, 3) array, rad
        Attitude setpoint: roll, pitch, yaw.
    excitation : (N, 3) array
        Injected torque (normalised).
    axis : int
        Axis of the manoeuvre: 0 roll, 1 pitch.
    window : (start, stop)
        Samples of the manoeuvre, over which performance is computed.
    faults : tuple of Fault
    yaw_rate : (N,) array, rad/s, optional
        Yaw rate of the setpoint, fed forward; by default 0.
    rate_mode : (N,) array of bool, optional
        Where True, the setpoint is of body rates, rad/s; by default nowhere.
    """

    name: str
    Ts: float
    setpoint: NDArray[np.float64]
    excitation: NDArray[np.float64]
    axis: int
    window: tuple[int, int]
    faults: tuple[Fault, ...] = ()
    yaw_rate: NDArray[np.float64] | None = None
    rate_mode: NDArray[np.bool_] | None = None


def _axis_index(axis: str) -> int:
    check_choice("axis", axis, AXES, SitlError)
    return AXES.index(axis)


def _check_length(name: str, seconds: float, Ts: float) -> None:
    if not MIN_SAMPLES * Ts <= seconds <= MAX_SECONDS:
        raise SitlError(f"{name}: got {seconds} s, expected {MIN_SAMPLES * Ts:g} to {MAX_SECONDS:g} s")


def _check_angle(amplitude: float) -> None:
    if not 0 < amplitude <= MAX_TILT:
        got, limit = np.degrees(amplitude), np.degrees(MAX_TILT)
        raise SitlError(f"amplitude: got {got:.6g} degrees, expected above 0 and at most {limit:.0f}")


def doublet(
    axis: str, amplitude: float, period: float, Ts: float, tail: float = TAIL_S, lead: float = LEAD
) -> Scenario:
    """Setpoint +A for half of `period`, -A for the other half, then level.

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
        Level flight after the doublet.
    lead : float, s
        Hover before the doublet; an unbalanced vehicle needs it to trim.
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
    """Setpoint A for `period` seconds; arguments as `doublet`."""
    _check_angle(amplitude)
    _check_length("period", period, Ts)
    column = _axis_index(axis)
    start = round(LEAD / Ts)
    setpoint = np.zeros((start + round(period / Ts), 3))
    setpoint[start:, column] = amplitude
    return Scenario("step", Ts, setpoint, np.zeros_like(setpoint), column, (start, len(setpoint)))


def hover(axis: str, period: float, Ts: float) -> Scenario:
    """Level setpoint for `period` seconds; arguments as `doublet`."""
    _check_length("period", period, Ts)
    setpoint = np.zeros((round(period / Ts), 3))
    return Scenario("hover", Ts, setpoint, np.zeros_like(setpoint), _axis_index(axis), (0, len(setpoint)))


def limit_rate(scenario: Scenario, rate: float) -> Scenario:
    """The scenario with setpoints that change by at most `rate` rad/s, as a setpoint rate limiter passes them on.

    Raises
    ------
    SitlError
        When the rate is not above 0.
    """
    if not 0 < rate < np.inf:
        raise SitlError(f"rate_limit_deg_s: got {np.degrees(rate):.6g} deg/s, expected above 0")
    limited, most = scenario.setpoint.copy(), rate * scenario.Ts
    for k in range(1, len(limited)):
        limited[k] = limited[k - 1] + np.clip(scenario.setpoint[k] - limited[k - 1], -most, most)
    return replace(scenario, setpoint=limited)


def make_scenario(
    name: str, axis: str, amplitude_deg: float, period: float, Ts: float, tail: float = TAIL_S
) -> Scenario:
    """Make a scenario by name: ``doublet``, ``step`` or ``hover``; amplitude in degrees, period and tail in seconds."""
    if name == "doublet":
        return doublet(axis, float(np.radians(amplitude_deg)), period, Ts, tail)
    if tail != TAIL_S:
        raise SitlError(f"tail: only a doublet has one, not {name}; leave it out")
    if name == "step":
        return step(axis, float(np.radians(amplitude_deg)), period, Ts)
    if name == "hover":
        return hover(axis, period, Ts)
    raise SitlError(f"scenario: got {name!r}, expected doublet, step or hover")


class ScenarioManoeuvre(BaseModel):
    """The manoeuvre of a scenario file: arguments of `make_scenario`, and the rate of `limit_rate` in deg/s."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    manoeuvre: Literal["doublet", "step", "hover"]
    axis: Literal["roll", "pitch"] = "roll"
    amplitude_deg: float = AMPLITUDE_DEG
    period_s: float = PERIOD_S
    tail_s: float = TAIL_S
    rate_limit_deg_s: float | None = None


def read_scenario(path: Path) -> tuple[ScenarioManoeuvre, tuple[Fault, ...]]:
    """Read the manoeuvre and the faults of a scenario file.

    Parameters
    ----------
    path : Path
        See the docstring of this module for an example and `sitl.faults.kinds.Fault` for the fields of a fault.

    Raises
    ------
    InputFileError, SitlError
        When the file is not TOML, or an entry is unknown or wrong.
    """
    table = read_toml(path, "scenario file")
    faults = table.pop("fault", [])
    if not (isinstance(faults, list) and all(isinstance(fault, dict) for fault in faults)):
        raise SitlError(f"{path}: fault: expected [[fault]] tables")
    manoeuvre = checked(ScenarioManoeuvre, table, str(path))
    return manoeuvre, tuple(make_fault(fault, f"{path}: fault {i + 1}") for i, fault in enumerate(faults))


def load_scenario(path: Path, Ts: float) -> Scenario:
    """Load the scenario of a file, see `read_scenario`, for a control period in s.

    Raises
    ------
    SitlError
        As `read_scenario` and `make_scenario`.
    """
    asked, faults = read_scenario(path)
    try:
        scenario = make_scenario(asked.manoeuvre, asked.axis, asked.amplitude_deg, asked.period_s, Ts, asked.tail_s)
        if asked.rate_limit_deg_s is not None:
            scenario = limit_rate(scenario, float(np.radians(asked.rate_limit_deg_s)))
    except SitlError as error:
        raise SitlError(f"{path}: {error}") from error
    return replace(scenario, faults=faults)


def excitation_flight(
    seconds_per_axis: float,
    amplitude: float,
    bandwidth: float,
    Ts: float,
    generator: np.random.Generator,
    together: bool = False,
    axes: str = "both",
    yaw_amplitude: float | None = None,
) -> Scenario:
    """Hover with a PRBS torque injected on one axis after the other; or on roll and pitch at once, each with its own.

    Parameters
    ----------
    seconds_per_axis : float, s
        Duration on each axis.
    amplitude : float
        Torque (normalised), at most 1.
    bandwidth : float, rad/s
        Bandwidth of the PRBS, see `tuning.excitation.hold_from_bandwidth`.
    Ts : float, s
        Control period.
    generator : numpy.random.Generator
        Source of the pulse lengths.
    together : bool
        Excite roll and pitch at once, for `seconds_per_axis`.
    axes : str
        One of `EXCITED_AXES`. The pulses of an axis do not depend on which others are excited.
    yaw_amplitude : float, optional
        Torque on yaw (normalised), at most 1; by default `amplitude`. Its pulses are `YAW_HOLD` times longer.
    """
    _check_length("seconds_per_axis", seconds_per_axis, Ts)
    check_choice("axis", axes, EXCITED_AXES, SitlError)
    excited = EXCITED_AXES[axes]
    if together and not {0, 1} <= set(excited):
        raise SitlError(f"axis: got {axes!r}, expected both or all to excite roll and pitch at once")
    amplitudes = (amplitude, amplitude, amplitude if yaw_amplitude is None else yaw_amplitude)
    for name, value in zip(("amplitude", "yaw_amplitude"), amplitudes[1:], strict=True):
        if not 0 < value <= 1:
            raise SitlError(f"{name}: got {value}, expected above 0 and at most 1, the largest torque")
    hold_min, hold_max = hold_from_bandwidth(bandwidth, Ts)
    longest = hold_max * (YAW_HOLD if 2 in excited else 1)
    if longest * Ts > seconds_per_axis:
        raise SitlError(
            f"bandwidth: at {bandwidth:g} rad/s a pulse may last {longest * Ts:.3g} s, longer than the "
            f"{seconds_per_axis:g} s on each axis; raise one of them"
        )
    samples = round(seconds_per_axis / Ts)
    stretches = [(0, 1), *((axis,) for axis in excited if axis == 2)] if together else [(axis,) for axis in excited]
    excitation = np.zeros((len(stretches) * samples, 3))
    for axis in range(max(excited) + 1):
        longer = YAW_HOLD if axis == 2 else 1
        pulses = prbs(samples, amplitudes[axis], longer * hold_min, longer * hold_max, generator)
        for number, stretch in enumerate(stretches):
            if axis in stretch:
                excitation[number * samples : (number + 1) * samples, axis] = pulses
    return Scenario("experiment", Ts, np.zeros_like(excitation), excitation, 0, (0, len(excitation)))


def scenario_of(
    name: str,
    axis: str | None,
    amplitude_deg: float | None,
    period_s: float | None,
    tail_s: float | None,
    faults: Sequence[str],
    Ts: float,
) -> Scenario:
    """A manoeuvre by its name, or a scenario file, with faults added.

    Parameters
    ----------
    name : str
        ``doublet``, ``step``, ``hover``, or a file whose name ends in ``.toml``.
    axis, amplitude_deg, period_s, tail_s
        Of a manoeuvre; None: the usual one. A file has its own.
    faults : sequence of str
        Further faults, see `sitl.faults.kinds.parse_fault`.
    Ts : float, s
        Control period.

    Raises
    ------
    Error
        When something of a file is given here, too, or a value is out of its range.
    """
    if name.endswith(".toml"):
        reason = f"defined in {name}; change it there"
        check_not_given(reason, axis=axis, amplitude_deg=amplitude_deg, period_s=period_s, tail_s=tail_s)
        task = load_scenario(Path(name), Ts)
    else:
        amplitude = AMPLITUDE_DEG if amplitude_deg is None else amplitude_deg
        period, tail = PERIOD_S if period_s is None else period_s, TAIL_S if tail_s is None else tail_s
        task = make_scenario(name, axis or "roll", amplitude, period, Ts, tail)
    return replace(task, faults=(*task.faults, *map(parse_fault, faults)))
