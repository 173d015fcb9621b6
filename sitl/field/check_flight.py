"""Prediction against flight: what the new gains should do with the doublets of a check flight, and what they did.

The closed loop around the measured response gives angles and torque for the setpoints that were logged:

    T = G_o U,  U = S C_ref,  S = (I + C_y G_i + C_o G_o)^-1
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.signal import correlate

from mimopilot.sitl.errors import SitlError
from mimopilot.sitl.field.doublet_flight import BEFORE_S, DoubletPlan
from mimopilot.tuning import law
from mimopilot.tuning.analysis.closed_loop import cascade_loop
from mimopilot.tuning.axes import Law, axis_names, law_of, yaw_axis
from mimopilot.tuning.design.yaw_design import yaw_model
from mimopilot.tuning.experiment import Experiment
from mimopilot.tuning.gains import Gains
from mimopilot.tuning.parameter_row import AXES
from mimopilot.tuning.plant.plant_estimates import PlantEstimates
from mimopilot.tuning.plant.wide_response import WideResponse, wide_response
from mimopilot.tuning.reference_model import ReferenceModel

# All chosen, see the tests for what healthy and damaged vehicles reach:
#: Share by which a figure may be worse than predicted.
SHARE = 0.5
#: And in addition: RMS of the angles (deg), which gusts move, and of the torque (normalised).
ANGLE_FLOOR_DEG, TORQUE_FLOOR = 0.2, 0.005
#: Level flight before the first doublet, and after each, that belongs to it, s.
LEAD_S, TAIL_S = 2.0, 1.0
#: Time after the last motion of the setpoint from which on the vehicle rests, s.
REST_S = 1.0
#: Largest share of the doublets' power by which the logged setpoints may differ from the plan: late ones, and those
#: that an autopilot smooths, differ by a part; other flight, by more than all of it.
DIFFERENT = 0.5
#: Least size of a doublet, rad (1 degree).
SMALLEST = np.radians(1.0)
#: Time without a setpoint that is added behind the flight, s: its response has come to rest by then.
SILENCE_S = 8.0

Signal = NDArray[np.float64]
Complex = NDArray[np.complex128]


@dataclass(frozen=True)
class CheckFigures:
    """Figures of the doublets, a value for each axis, over the doublets of that axis and 1 s after each.

    Attributes
    ----------
    follow_deg : tuple of float, deg
        RMS of the angle's distance from the attitude model.
    offaxis_deg : tuple of float, deg
        RMS of pitch in roll doublets, and of roll in pitch doublets.
    torque : tuple of float
        RMS of the axis' torque (normalised).
    rest_torque : tuple of float
        Standard deviation of the torque in level flight: an oscillation is seen there.
    """

    follow_deg: tuple[float, ...]
    offaxis_deg: tuple[float, ...]
    torque: tuple[float, ...]
    rest_torque: tuple[float, ...]

    def __add__(self, other: CheckFigures) -> CheckFigures:
        """Of the axes of both."""
        return CheckFigures(*(getattr(self, name) + getattr(other, name) for name in FIGURES))


@dataclass(frozen=True, eq=False)
class CheckedAxis:
    """Signals of one axis: time (N,), s; logged setpoint and angle, and predicted angle, (N,), rad."""

    name: str
    time: Signal
    setpoint: Signal
    angle: Signal
    expected: Signal


@dataclass(frozen=True, eq=False)
class CheckResult:
    """A check flight beside its prediction.

    Attributes
    ----------
    predicted, flown : CheckFigures
    worse : tuple of str
        Figures that are worse than predicted by more than `SHARE`; empty: none is.
    axes : tuple of CheckedAxis
        The signals.
    """

    predicted: CheckFigures
    flown: CheckFigures
    worse: tuple[str, ...]
    axes: tuple[CheckedAxis, ...]

    def as_table(self) -> dict[str, Any]:
        """The figures, for files."""
        return {"predicted": asdict(self.predicted), "flown": asdict(self.flown), "worse": list(self.worse)}


#: Figure -> its description, unit, and floor.
FIGURES: Mapping[str, tuple[str, str, float]] = {
    "follow_deg": ("tracking error to the attitude model", "deg", ANGLE_FLOOR_DEG),
    "offaxis_deg": ("off-axis motion", "deg", ANGLE_FLOOR_DEG),
    "torque": ("torque", "", TORQUE_FLOOR),
    "rest_torque": ("torque in level flight", "", TORQUE_FLOOR),
}


def check_flight(flight: Experiment, experiment: Experiment, gains: Gains, plan: DoubletPlan) -> CheckResult:
    """Compare a check flight with what the measured response predicts for its gains.

    Parameters
    ----------
    flight : Experiment
        The check flight.
    experiment : Experiment
        The flight with excitation.
    gains : Gains
        The set that flew the check flight.
    plan : DoubletPlan
        Its doublets.

    Raises
    ------
    SitlError
        If the log does not hold the doublets.
    TuningError
        If the response is known at too few frequencies.
    """
    measured = PlantEstimates(experiment)
    models: list[ReferenceModel] = [gains.reference_models(axis)[1] for axis in range(2)]
    part = find_doublets(flight, plan)
    predicted, flown, axes = _compare(flight, part, measured, gains, models)
    yaw = yaw_model(gains)
    if yaw is not None and flight.yaw is not None:
        more = _compare(yaw_axis(flight), part, measured.yaw, law_of(gains, 1), [yaw])
        predicted, flown, axes = predicted + more[0], flown + more[1], axes + more[2]
    return CheckResult(predicted, flown, _worse(predicted, flown), axes)


def _compare(
    flight: Experiment, part: slice, measured: PlantEstimates, gains: Law, models: Sequence[ReferenceModel]
) -> tuple[CheckFigures, CheckFigures, tuple[CheckedAxis, ...]]:
    """Predicted and flown figures of n axes, and their signals."""
    plant = wide_response(measured)
    names = axis_names(len(models))
    setpoint, angles, torque = _doublets(flight, names, part)
    T, U, *noise = _closed_loop(gains, plant)
    expected = _respond(T, setpoint, plant, flight.Ts)
    expected_torque = _respond(U, setpoint, plant, flight.Ts)
    wanted = np.zeros_like(T)
    for axis, model in enumerate(models):
        wanted[:, axis, axis] = model.frequency_response(plant.omega)
    follows = _respond(wanted, setpoint, plant, flight.Ts)
    parts = [_parts(setpoint[:, axis], flight.Ts) for axis in range(len(names))]
    rest = _rest(setpoint, flight.Ts)
    none = np.zeros(len(names))
    predicted = _figures(expected, expected_torque, follows, parts, rest, *noise)
    flown = _figures(angles, torque, follows, parts, rest, none, none)
    time = np.arange(len(setpoint), dtype=np.float64) * flight.Ts
    shown = (
        CheckedAxis(name, time, *signals)
        for name, *signals in zip(names, setpoint.T, angles.T, expected.T, strict=True)
    )
    return predicted, flown, tuple(shown)


def _doublets(flight: Experiment, names: Sequence[str], part: slice) -> tuple[Signal, Signal, Signal]:
    """Setpoints, angles and torque, (N, n) each without their level values, of the rows that hold the doublets."""
    assert flight.r_o is not None
    setpoint = flight.r_o[part] - np.median(flight.r_o[part], axis=0)
    moving = [np.flatnonzero(np.abs(column) > SMALLEST) for column in setpoint.T]
    for axis, rows in zip(names, moving, strict=True):
        if not len(rows):
            raise SitlError(f"{flight.source}: the log does not hold the doublets on {axis}", exit_code=1)
    before = slice(part.start, part.start + max(1, min(rows[0] for rows in moving)))
    angles = flight.y_o[part] - np.median(flight.y_o[before], axis=0)
    torque = flight.u[part] - np.median(flight.u[before], axis=0)
    return setpoint, angles, torque


def find_doublets(flight: Experiment, plan: DoubletPlan) -> slice:
    """Rows of the planned doublets, from `LEAD_S` before the first one on.

    A log also holds the setpoints of taking off, holding the position and landing. The doublets are where roll's and
    pitch's setpoints differ least from the plan.

    Raises
    ------
    SitlError
        If they differ too much everywhere.
    """
    if flight.r_o is None:
        raise SitlError(f"{flight.source}: no attitude setpoints are logged", exit_code=1)
    times = np.arange(BEFORE_S - LEAD_S, plan.seconds, flight.Ts)
    wanted = np.array([plan.setpoint(time)[:2] for time in times])
    found, least = 0, np.inf
    for start, stop in flight.segments:
        if stop - start < len(wanted):
            continue
        differs = np.full(stop - start - len(wanted) + 1, np.sum(wanted**2))
        for logged, planned in zip(flight.r_o[start:stop].T, wanted.T, strict=True):
            squares = np.concatenate([[0.0], np.cumsum(logged**2)])
            differs += squares[len(planned) :] - squares[: -len(planned)]
            differs -= 2 * correlate(logged, planned, mode="valid", method="fft")
        place = int(np.argmin(differs))
        if differs[place] < least:
            found, least = start + place, differs[place]
    if not least < DIFFERENT * np.sum(wanted**2):
        raise SitlError(
            f"{flight.source}: the log does not hold the doublets of the check flight without a gap", exit_code=1
        )
    return slice(found, found + len(wanted))


def _closed_loop(gains: Law, plant: WideResponse) -> tuple[Complex, Complex, Signal, Signal]:
    """T and U, (K, n, n), and the RMS of angles and of the torque at hover that noise and gusts cause, (n,) each."""
    loop = cascade_loop(gains, plant)
    _, C_o, C_y = law.cascade_response(gains, plant.omega)
    n, N = plant.axes, plant.noise
    torque = np.linalg.solve(np.eye(n) + loop.L_u, C_y @ N[:, :n] + C_o @ N[:, n:])
    angles = N[:, n:] - plant.G_o @ torque
    rms = [np.sqrt(plant.noise_weight @ np.sum(np.abs(one) ** 2, axis=2)) for one in (angles, torque)]
    return loop.T_o, loop.U_o, rms[0], rms[1]


def _respond(response: Complex, signal: Signal, plant: WideResponse, Ts: float) -> Signal:
    """Response (N, n) to a signal (N, n) that begins and ends at zero."""
    length = len(signal) + round(SILENCE_S / Ts)
    spectrum = np.fft.rfft(signal, length, axis=0)
    omega = 2 * np.pi * np.fft.rfftfreq(length, Ts)
    # Between the frequencies of the plant the response is linear; at rest it is that of the slowest.
    at = np.empty((len(omega), *response.shape[1:]), complex)
    for i, j in np.ndindex(*response.shape[1:]):
        at[:, i, j] = np.interp(omega, plant.omega, response[:, i, j].real) + 1j * np.interp(
            omega, plant.omega, response[:, i, j].imag
        )
    answer: Signal = np.fft.irfft(np.einsum("kij,kj->ki", at, spectrum), length, axis=0)[: len(signal)]
    return answer


def _parts(setpoint: Signal, Ts: float) -> NDArray[np.bool_]:
    """Samples of an axis' doublets, (N,), and of the time after each."""
    tail = round(TAIL_S / Ts)
    moving = np.abs(setpoint) > SMALLEST
    late = np.convolve(moving, np.ones(tail + 1))[: len(moving)] > 0
    return np.asarray(late, bool)


def _rest(setpoint: Signal, Ts: float) -> NDArray[np.bool_]:
    """Samples of level flight, (N,): the setpoint has not moved for a while."""
    pause = round(REST_S / Ts)
    moving = (np.abs(setpoint) > SMALLEST).any(axis=1)
    return np.asarray(np.convolve(moving, np.ones(pause + 1))[: len(moving)] == 0, bool)


def _figures(
    angles: Signal,
    torque: Signal,
    model: Signal,
    parts: list[NDArray[np.bool_]],
    rest: NDArray[np.bool_],
    angle_noise: Signal,
    torque_noise: Signal,
) -> CheckFigures:
    """Figures of angles and torque; noise (n,) is added to those of a prediction, which has none."""
    follow, offaxis, effort, still = [], [], [], []
    for axis, part in enumerate(parts):
        follow.append(_degrees(np.hypot(_rms(angles[part, axis] - model[part, axis]), angle_noise[axis])))
        effort.append(float(np.hypot(_rms(torque[part, axis]), torque_noise[axis])))
        still.append(float(np.hypot(np.std(torque[rest, axis]), torque_noise[axis])))
        if len(parts) > 1:
            other = 1 - axis
            offaxis.append(_degrees(np.hypot(_rms(angles[part, other] - model[part, other]), angle_noise[other])))
    return CheckFigures(tuple(follow), tuple(offaxis), tuple(effort), tuple(still))


def _worse(predicted: CheckFigures, flight: CheckFigures) -> tuple[str, ...]:
    found = []
    for name, (text, unit, floor) in FIGURES.items():
        for axis, expected, got in zip(AXES, getattr(predicted, name), getattr(flight, name), strict=False):
            limit = (1 + SHARE) * expected + floor
            if not got <= limit:
                found.append(
                    f"{axis}: {text} {got:.3g} {unit}".rstrip() + f", predicted {expected:.3g}, limit {limit:.3g}"
                )
    return tuple(found)


def _degrees(angle: float) -> float:
    return float(np.degrees(angle))


def _rms(values: Signal) -> float:
    return float(np.sqrt(np.mean(values**2)))
