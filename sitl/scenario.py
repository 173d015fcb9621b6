"""What a flight is asked to do: attitude set-points and injected moments over time."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sitl.errors import SitlError
from tuning.excitation import hold_from_bandwidth, prbs

AXES = ("roll", "pitch")
LEAD = 1.0  # s of hover before a manoeuvre
MAX_ANGLE = np.radians(60.0)  # a vehicle that tilts further counts as lost
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
    """

    name: str
    Ts: float
    setpoint: NDArray[np.float64]
    excitation: NDArray[np.float64]
    axis: int
    window: tuple[int, int]


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


def doublet(axis: str, amplitude: float, period: float, Ts: float, tail: float = 1.5, lead: float = LEAD) -> Scenario:
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


def make_scenario(name: str, axis: str, amplitude_deg: float, period: float, Ts: float) -> Scenario:
    """A scenario by name: ``doublet``, ``step`` or ``hover``; amplitude in degrees, period in seconds."""
    if name == "doublet":
        return doublet(axis, float(np.radians(amplitude_deg)), period, Ts)
    if name == "step":
        return step(axis, float(np.radians(amplitude_deg)), period, Ts)
    if name == "hover":
        return hover(axis, period, Ts)
    raise SitlError(f"scenario: got {name!r}, expected doublet, step or hover")


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
