"""Prediction against flight: what the new gains should do with the doublets of a check flight, and what they did.

The closed loop around the measured response gives angles and torque for the setpoints that were logged:

    T = G_o U,  U = S C_ref,  S = (I + C_y G_i + C_o G_o)^-1
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mimopilot.sitl.errors import SitlError
from mimopilot.tuning import law
from mimopilot.tuning.experiment import Experiment
from mimopilot.tuning.gains import Gains
from mimopilot.tuning.plant.plant_estimates import PlantEstimates
from mimopilot.tuning.plant.wide_response import WideResponse, wide_response

AXES = ("roll", "pitch")
# All chosen, see the tests for what healthy and damaged vehicles reach:
#: Share by which a figure may be worse than predicted.
SHARE = 0.5
#: And in addition: RMS of the angles (deg), which gusts move, and of the torque (normalised).
ANGLE_FLOOR_DEG, TORQUE_FLOOR = 0.2, 0.005
#: Level flight before the first doublet, and after each, that belongs to it, s.
LEAD_S, TAIL_S = 2.0, 1.0
#: Time after the last motion of the setpoint from which on the vehicle rests, s.
REST_S = 1.0
#: Least size of a doublet, rad (1 degree).
SMALLEST = np.radians(1.0)
#: Time without a setpoint that is added behind the flight, s: its response has come to rest by then.
SILENCE_S = 8.0

Signal = NDArray[np.float64]
Complex = NDArray[np.complex128]
NOISELESS: Signal = np.zeros(2)


@dataclass(frozen=True)
class CheckFigures:
    """Figures of the doublets; pairs are for roll and pitch, over the doublets of that axis and 1 s after each.

    Attributes
    ----------
    follow_deg : tuple of 2 float, deg
        RMS of the angle's distance from the attitude model.
    offaxis_deg : tuple of 2 float, deg
        RMS of the other axis' angle.
    torque : tuple of 2 float
        RMS of the axis' torque (normalised).
    rest_torque : tuple of 2 float
        Standard deviation of the torque in level flight: an oscillation is seen there.
    """

    follow_deg: tuple[float, float]
    offaxis_deg: tuple[float, float]
    torque: tuple[float, float]
    rest_torque: tuple[float, float]


@dataclass(frozen=True, eq=False)
class CheckResult:
    """A check flight beside its prediction.

    Attributes
    ----------
    predicted, flown : CheckFigures
    worse : tuple of str
        Figures that are worse than predicted by more than `SHARE`; empty: none is.
    times : (N,) array, s
    setpoint, angles, expected : (N, 2) arrays, rad
        Logged setpoints and angles, and predicted angles.
    """

    predicted: CheckFigures
    flown: CheckFigures
    worse: tuple[str, ...]
    times: Signal
    setpoint: Signal
    angles: Signal
    expected: Signal

    def as_table(self) -> dict[str, Any]:
        """The figures, for files."""
        return {"predicted": asdict(self.predicted), "flown": asdict(self.flown), "worse": list(self.worse)}


#: Figure -> its description, unit, and floor.
FIGURES: Mapping[str, tuple[str, str, float]] = {
    "follow_deg": ("distance from the attitude model", "deg", ANGLE_FLOOR_DEG),
    "offaxis_deg": ("motion of the other axis", "deg", ANGLE_FLOOR_DEG),
    "torque": ("torque", "", TORQUE_FLOOR),
    "rest_torque": ("torque in level flight", "", TORQUE_FLOOR),
}


def check_flight(flight: Experiment, experiment: Experiment, gains: Gains) -> CheckResult:
    """Compare a check flight with what the measured response predicts for its gains.

    Parameters
    ----------
    flight : Experiment
        The check flight.
    experiment : Experiment
        The flight with excitation.
    gains : Gains
        The set that flew the check flight.

    Raises
    ------
    SitlError
        If the log does not hold the doublets.
    TuningError
        If the response is known at too few frequencies.
    """
    plant = wide_response(PlantEstimates(experiment))
    setpoint, angles, torque = _doublets(flight)
    T, U, *noise = _closed_loop(gains, plant)
    expected = _respond(T, setpoint, plant, flight.Ts)
    expected_torque = _respond(U, setpoint, plant, flight.Ts)
    model = _respond(_attitude_model(gains, plant), setpoint, plant, flight.Ts)
    parts = [_parts(setpoint[:, axis], flight.Ts) for axis in range(2)]
    rest = _rest(setpoint, flight.Ts)
    predicted = _figures(expected, expected_torque, model, parts, rest, *noise)
    flown = _figures(angles, torque, model, parts, rest, NOISELESS, NOISELESS)
    times = np.arange(len(setpoint), dtype=np.float64) * flight.Ts
    return CheckResult(predicted, flown, _worse(predicted, flown), times, setpoint, angles, expected)


def _doublets(flight: Experiment) -> tuple[Signal, Signal, Signal]:
    """Setpoints, angles and torque, (N, 2) each without their level values, from before the first doublet on."""
    if flight.r_o is None:
        raise SitlError(f"{flight.source}: no attitude setpoints are logged", exit_code=1)
    start, stop = max(flight.segments, key=lambda part: part[1] - part[0])
    setpoint = flight.r_o[start:stop] - np.median(flight.r_o[start:stop], axis=0)
    moving = [np.flatnonzero(np.abs(setpoint[:, axis]) > SMALLEST) for axis in range(2)]
    for axis, rows in zip(AXES, moving, strict=True):
        if not len(rows):
            raise SitlError(f"{flight.source}: the log does not hold the doublets on {axis}", exit_code=1)
    lead, tail = round(LEAD_S / flight.Ts), round((REST_S + TAIL_S) / flight.Ts)
    first = max(0, min(rows[0] for rows in moving) - lead)
    last = min(len(setpoint), max(rows[-1] for rows in moving) + tail)
    used = slice(first, last)
    before = slice(start + first, start + min(rows[0] for rows in moving))
    angles = flight.y_o[start:stop][used] - np.median(flight.y_o[before], axis=0)
    torque = flight.u[start:stop][used] - np.median(flight.u[before], axis=0)
    return setpoint[used], angles, torque


def _closed_loop(gains: Gains, plant: WideResponse) -> tuple[Complex, Complex, Signal, Signal]:
    """T and U, (K, 2, 2), and the RMS of angles and of the torque at hover that noise and gusts cause, (2,) each."""
    C_ref, C_o, C_y = law.cascade_response(gains, plant.omega)
    S = np.linalg.inv(np.eye(2) + C_y @ plant.G_i + C_o @ plant.G_o)
    U = S @ C_ref
    N = plant.noise
    torque = S @ (C_y @ N[:, :2] + C_o @ N[:, 2:])
    angles = N[:, 2:] - plant.G_o @ torque
    rms = [np.sqrt(plant.noise_weight @ np.sum(np.abs(one) ** 2, axis=2)) for one in (angles, torque)]
    return (plant.G_o @ U).astype(np.complex128), U.astype(np.complex128), rms[0], rms[1]


def _attitude_model(gains: Gains, plant: WideResponse) -> Complex:
    """Responses of the attitude models of a set, (K, 2, 2)."""
    found = np.zeros((len(plant.omega), 2, 2), complex)
    for axis in range(2):
        found[:, axis, axis] = gains.reference_models(axis)[1].frequency_response(plant.omega)
    return found


def _respond(response: Complex, signal: Signal, plant: WideResponse, Ts: float) -> Signal:
    """Response (N, 2) to a signal (N, 2) that begins and ends at zero."""
    length = len(signal) + round(SILENCE_S / Ts)
    spectrum = np.fft.rfft(signal, length, axis=0)
    omega = 2 * np.pi * np.fft.rfftfreq(length, Ts)
    # Between the frequencies of the plant the response is linear; at rest it is that of the slowest.
    at = np.empty((len(omega), 2, 2), complex)
    for i, j in np.ndindex(2, 2):
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
    """Figures of angles and torque; noise (2,) is added to those of a prediction, which has none."""
    follow, offaxis, effort, still = [], [], [], []
    for axis, part in enumerate(parts):
        other = 1 - axis
        follow.append(_degrees(np.hypot(_rms(angles[part, axis] - model[part, axis]), angle_noise[axis])))
        offaxis.append(_degrees(np.hypot(_rms(angles[part, other] - model[part, other]), angle_noise[other])))
        effort.append(float(np.hypot(_rms(torque[part, axis]), torque_noise[axis])))
        still.append(float(np.hypot(np.std(torque[rest, axis]), torque_noise[axis])))
    return CheckFigures((follow[0], follow[1]), (offaxis[0], offaxis[1]), (effort[0], effort[1]), (still[0], still[1]))


def _worse(predicted: CheckFigures, flight: CheckFigures) -> tuple[str, ...]:
    found = []
    for name, (text, unit, floor) in FIGURES.items():
        for axis, expected, got in zip(AXES, getattr(predicted, name), getattr(flight, name), strict=True):
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
