"""Gains for a manoeuvre: the whole cascade refined on a model that the same log gives.

A rate-loop model is a means: what is flown is the attitude, and how well it follows is bounded by what the rate loop
was asked for. Here a plant identified from the log (PBSID) flies the doublet in the flown difference equation,
saturation included, and a descent goes from VRFT's gains to those that follow the attitude model best within an
effort. The measured frequency response keeps the margins: what it does not allow is not gone to.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from tuning.certificate import HIGH_FREQUENCY_LOOP, loop_above
from tuning.closed_loop import ACCURATE, MIN_FREQUENCIES, PlantResponse, longest_run, singular_values, whole_loop
from tuning.descent import MISSED, descend
from tuning.errors import TuningError
from tuning.experiment import Experiment
from tuning.gain_stack import GainStack
from tuning.gains import Gains
from tuning.identification import identify_rates
from tuning.reference import ReferenceModel
from tuning.spec import Manoeuvre
from tuning.statespace import StateSpace

#: The certificate's limits with some room: peak of the sensitivity, share of the gain allowed above the band.
PEAK, SHARE = 2.35, 0.95
#: The integral term keeps this share of what VRFT gave it, in every direction.
INTEGRAL = 0.2
#: Where descents begin: VRFT's gains; its Kp_i so many times, with Kd_i over Kp_i in units of typical sizes (20 ms).
BEGINNINGS = ((1.0, None), (1.0, 0.5), (1.0, 1.0), (1.7, 1.0))
#: Other valleys are looked for so often, while that gains this share.
HOPS, WORTH = 2, 0.02
#: Over Kp_i, in units of typical sizes (0.5 s and 20 ms): what a cascade that spends its whole effort tends to.
FIRM = {"Ki_i": 10.0, "Kd_i": 5.0}
#: Weight of the other axis' error: what decoupling costs in following is little.
OTHER_AXIS = 2.0
#: Order of the norm over frequencies that stands for the peak: smooth, and a little more than the peak itself.
SMOOTH = 24.0
STEP = 1e-4

Signal = NDArray[np.float64]
#: From a point and which of its elements are free to the end, its cost and that of either axis.
Descent = Callable[[Signal, NDArray[np.bool_]], tuple[Signal, float, Signal]]


@dataclass(frozen=True, eq=False)
class DoubletModel:
    """A doublet around an identified plant.

    Attributes
    ----------
    plant : StateSpace
        From moment to body rates.
    trim : (2,) array
        Moment that holds the vehicle level.
    setpoint : (N,) array, rad
        Of the axis that moves; the other's is zero.
    """

    plant: StateSpace
    trim: Signal
    setpoint: Signal

    def fly(self, stack: GainStack) -> tuple[Signal, Signal]:
        """Doublets on roll and on pitch under each of several gain sets, without noise.

        Returns
        -------
        angles, moments : (2, sets, N, 2) arrays, rad, dimensionless
            First index: the axis that moves.
        """
        from tuning.compiled_doublet import fly  # takes longer to import than all of the rest

        gains, plant = stack.stacked(), self.plant
        angles, moments = (np.empty((2, len(gains), len(self.setpoint), 2)) for _ in range(2))
        matrices = (np.ascontiguousarray(matrix) for matrix in (plant.A, plant.B, plant.C))
        fly(*matrices, self.trim, self.setpoint, gains, stack.limits, stack.Ts, stack.derivative_pole, angles, moments)
        return angles, moments

    def spectral_radius(self, stack: GainStack) -> float:
        """Of the first set: the larger of the rate loop's alone and of the cascade's, limits aside."""
        Kp_o, Kp_i, Ki_i, Kd_i, Kff_i = stack.stacked()[0]
        n, Ts, a = len(self.plant.A), stack.Ts, stack.derivative_pole
        start = np.eye(n + 8)
        state, rate, slope, integral, angle = np.split(start, [n, n + 2, n + 4, n + 6])
        now = self.plant.C @ state
        angle = angle + Ts / 2 * (now + rate)
        slope = a * slope + (1 - a) / Ts * (now - rate)
        radius = 0.0
        for wanted in (np.zeros_like(now), -Kp_o @ angle):
            summed = integral + Ts * Ki_i @ (wanted - now)
            moment = Kp_i @ (wanted - now) - Kd_i @ slope + Kff_i @ wanted + summed
            step = np.vstack([self.plant.A @ state + self.plant.B @ moment, now, slope, summed, angle])
            if not wanted.any():  # nobody looks at the angle
                step = step[:-2, :-2]
            radius = max(radius, float(np.abs(np.linalg.eigvals(step)).max()))
        return radius


def doublet_model(experiment: Experiment, manoeuvre: Manoeuvre) -> DoubletModel:
    """The manoeuvre around the plant that PBSID finds in an experiment.

    Raises
    ------
    TuningError
        When the log is too short or not excited.
    """
    half = round(manoeuvre.period_s / 2 / experiment.Ts)
    height = np.radians(manoeuvre.amplitude_deg) * np.ones(half)
    u = np.concatenate([experiment.u[start:stop] for start, stop in experiment.segments])
    plant = identify_rates(experiment)[0].plant
    return DoubletModel(plant, np.median(u, axis=0), np.concatenate([height, -height]))


def effort(gains: Gains, model: DoubletModel) -> tuple[float, float]:
    """Predicted RMS of both moments together over the roll and over the pitch doublet."""
    roll, pitch = _effort(model.fly(GainStack.of(gains))[1])[:, 0]
    return float(roll), float(pitch)


def _effort(moments: Signal) -> Signal:
    power: Signal = np.sqrt(np.mean(np.sum(moments**2, axis=-1), axis=-1))
    return power


def refine_cascade(
    gains: Gains,
    model: DoubletModel,
    response: PlantResponse,
    outer: Sequence[ReferenceModel],
    *,
    terms: Sequence[str],
    full: bool,
    limit: Sequence[float] | None = None,
) -> Gains:
    """Gains that follow the attitude model best in the manoeuvre.

    Parameters
    ----------
    gains : Gains
        Where to start: VRFT's.
    model : DoubletModel
    response : PlantResponse
        From the same experiment.
    outer : sequence of 2 ReferenceModel
        Of the attitude loop.
    terms : sequence of str
        Names of the matrices that are free.
    full : bool
        False: their diagonals only (SISO).
    limit : sequence of 2 float, optional
        Effort allowed in the roll and the pitch doublet; by default what `gains` need.

    Raises
    ------
    TuningError
        When the measured response is known at too few frequencies.
    """
    known = response.at(response.coherent() & (response.relative_error() < ACCURATE))
    if len(known.omega) < MIN_FREQUENCIES:
        raise TuningError(f"only {len(known.omega)} frequencies of the measured response are known to 10 %")
    end = response.at(longest_run(np.flatnonzero(response.coherent()))[-1:])
    allowed = np.array(limit if limit is not None else effort(gains, model))
    wanted = np.zeros((2, 1, len(model.setpoint), 2))
    for axis, reference in enumerate(outer):
        wanted[axis, 0, :, axis] = reference.response(model.setpoint)
    weight = np.where(np.eye(2, dtype=bool), 1.0, OTHER_AXIS)[:, None, None, :] / np.sqrt(len(model.setpoint))
    sizes, stack = typical_sizes(gains), GainStack.of(gains)
    scale = np.array([sizes[name] for name in terms])[:, None, None]
    floor = INTEGRAL * integral_rate(gains.Ki_i, gains.Kp_i)

    def matrices(points: Signal) -> dict[str, Signal]:
        parts = points.reshape(-1, len(terms), 2, 2) * scale
        return dict(zip(terms, np.moveaxis(parts, 1, 0), strict=True))

    def left(candidates: GainStack) -> Signal:
        """Of the peak of the sensitivity, of the rate loop alone and of the whole loop, of the gain above the band, of
        the integral; relative, (sets, 4).
        """
        loops = np.stack(whole_loop(candidates, known)[:2], axis=1)
        differences = np.concatenate(singular_values(np.eye(2, dtype=complex) + loops), axis=-1)
        peaks = np.sum(differences**-SMOOTH, axis=-1) ** (1 / SMOOTH)
        above = loop_above(candidates, end)[:, -1] / HIGH_FREQUENCY_LOOP
        # VRFT's Kp_i is nearly the inverse of the plant's gain: beside it the directions are alike.
        integral = np.ones(len(above))
        if floor > 0:
            integral = np.array([integral_rate(Ki_i[0], gains.Kp_i) for Ki_i in candidates.Ki_i]) / floor - 1
        return np.column_stack([1 - peaks / PEAK, 1 - above / SHARE, integral])

    def examine(points: Signal) -> tuple[Signal, Signal]:
        candidates = stack.varied(matrices(points))
        angles, moments = model.fly(candidates)
        residuals = np.moveaxis((angles - wanted) * weight, 1, 0).reshape(len(points), -1)
        return residuals, np.hstack([1 - _effort(moments).T / allowed, left(candidates)])

    def descended(first: Signal, free: NDArray[np.bool_]) -> tuple[Signal, float, Signal]:
        """End, cost and cost of either axis from a first point on, some of whose elements are free; a limit that is
        missed and a loop that is unstable cost infinity: on the far side of instability nothing else would tell.
        """

        def spread(points: Signal) -> Signal:
            every = np.tile(first, (len(points), 1))
            every[:, free] = points
            return every

        end = spread(descend(lambda points: examine(spread(points)), first[free], STEP)[0][None])
        residuals, left = examine(end)
        costs = np.sum(residuals.reshape(2, -1) ** 2, axis=1)
        if left.min() < -MISSED or model.spectral_radius(stack.varied(matrices(end))) >= 1:
            costs = np.full(2, np.inf)
        return end[0], float(costs.sum()), costs

    start = np.array([getattr(gains, name) for name in terms]) / scale
    point = _axis_by_axis(descended, start, terms)
    if full:
        point = _coupled(descended, point, terms)
    found = {name: matrix[0] for name, matrix in matrices(point).items()}
    return replace(gains, certificate=None, **found)  # type: ignore[arg-type]


def _axis_by_axis(descended: Descent, start: Signal, terms: Sequence[str]) -> Signal:
    """The best diagonal gains, (4 len(terms),): each axis takes its own from the better of several descents.

    From VRFT's coupled gains the way often ends in a worse valley; a rate derivative that damps leads to another.
    """
    diagonal = np.tile(np.eye(2, dtype=bool).ravel(), len(terms))
    ends, parts = [], dict(zip(terms, start * np.eye(2), strict=True))
    for proportional, derivative in BEGINNINGS if {"Kp_i", "Kd_i"} <= set(terms) else BEGINNINGS[:1]:
        begin = parts.copy()
        if derivative is not None:
            begin["Kp_i"] = proportional * parts["Kp_i"]
            begin["Kd_i"] = derivative * begin["Kp_i"]
        ends.append(descended(_flat(begin), diagonal))
    costs = np.array([costs for _, _, costs in ends])
    if np.isinf(costs.min(axis=0)).any():
        return _flat(parts)
    best = np.argmin(costs, axis=0)
    rows = [ends[best[axis]][0].reshape(-1, 2, 2)[:, axis] for axis in range(2)]
    return np.stack(rows, axis=1).ravel()


def _coupled(descended: Descent, point: Signal, terms: Sequence[str]) -> Signal:
    """The best full gains from diagonal ones on, (4 len(terms),).

    The coupling in place, there may be a better valley than each axis had for itself: with firmer integral and
    derivative action. Where no end keeps the limits the point stays where it was.
    """
    every = np.ones(len(point), bool)
    end, cost, _ = descended(point, every)
    point = end if cost < np.inf else point
    for _ in range(HOPS):
        parts = dict(zip(terms, point.reshape(-1, 2, 2), strict=True))
        doubled = parts | {name: 2 * parts[name] for name in ("Ki_i", "Kd_i") if name in parts}
        firm = parts | {name: FIRM[name] * parts["Kp_i"] for name in FIRM if {name, "Kp_i"} <= parts.keys()}
        following, lower, _ = min((descended(_flat(begin), every) for begin in (doubled, firm)), key=lambda end: end[1])
        if not lower < (1 - WORTH) * cost:
            break
        point, cost = following, lower
    return point


def _flat(parts: Mapping[str, Signal]) -> Signal:
    return np.array(list(parts.values())).ravel()


def typical_sizes(gains: Gains) -> dict[str, float]:
    """A typical change of each matrix' elements: the starting point of some may be zero."""
    proportional = float(np.abs(gains.Kp_i).max())
    return {
        "Kp_o": float(np.abs(gains.Kp_o).max()),
        "Kp_i": proportional,
        "Ki_i": 2.0 * proportional,
        "Kd_i": 0.02 * proportional,
        "Kff_i": proportional,
    }


def integral_rate(Ki_i: Signal, Kp_i: Signal) -> float:
    """Least integral action beside the proportional one, in any direction, 1/s."""
    action = Ki_i @ np.linalg.inv(Kp_i)
    return float(np.linalg.eigvalsh((action + action.T) / 2)[0])
