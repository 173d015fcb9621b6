"""Gains for a manoeuvre: the whole cascade refined on a model that the same log gives.

A rate-loop model is a means: what is flown is the attitude, and how well it follows is bounded by what the rate loop
was asked for. Here a plant identified from the log (PBSID) flies the doublet in the flown difference equation,
saturation included, and a descent goes from VRFT's gains to those that follow the attitude model best within an
effort. The measured frequency response keeps the margins: what it does not allow is not gone to.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from tuning.certificate import HIGH_FREQUENCY_LOOP, loop_above
from tuning.closed_loop import ACCURATE, MIN_FREQUENCIES, PlantResponse, longest_run, singular_values, whole_loop
from tuning.descent import MISSED, Examine, descend
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
#: A valley with twice the integral and the derivative action is looked for so often, while that gains this share.
HOPS, WORTH = 3, 0.02
#: Weight of the other axis' error: what decoupling costs in following is little.
OTHER_AXIS = 2.0
#: Order of the norm over frequencies that stands for the peak: smooth, and a little more than the peak itself.
SMOOTH = 24.0
STEP = 1e-4

Signal = NDArray[np.float64]


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

    start = np.array([getattr(gains, name) for name in terms]) / scale
    point = _axis_by_axis(examine, start, terms)
    if full:
        point = _coupled(examine, point, terms)
    found = {name: matrix[0] for name, matrix in matrices(point).items()}
    return replace(gains, certificate=None, **found)  # type: ignore[arg-type]


def _axis_by_axis(examine: Examine, start: Signal, terms: Sequence[str]) -> Signal:
    """The best diagonal gains, (4 len(terms),): each axis takes its own from the better of several descents.

    From VRFT's coupled gains the way often ends in a worse valley; a rate derivative that damps leads to another.
    """
    diagonal = np.tile(np.eye(2, dtype=bool).ravel(), len(terms))

    def spread(points: Signal) -> Signal:
        every: Signal = np.zeros((len(points), len(diagonal)))
        every[:, diagonal] = points
        return every

    ends = []
    parts = dict(zip(terms, start, strict=True))
    for proportional, derivative in BEGINNINGS if {"Kp_i", "Kd_i"} <= set(terms) else BEGINNINGS[:1]:
        begin = parts.copy()
        if derivative is not None:
            begin["Kp_i"] = proportional * parts["Kp_i"]
            begin["Kd_i"] = derivative * begin["Kp_i"]
        first = np.array([begin[name] for name in terms]).ravel()[diagonal]
        end, _ = descend(lambda points: examine(spread(points)), first, STEP)
        residuals, left = examine(spread(end[None]))
        costs = np.sum(residuals.reshape(2, -1) ** 2, axis=1)
        ends.append((costs if left.min() > -MISSED else costs + np.inf, end.reshape(-1, 2)))
    best = np.argmin([costs for costs, _ in ends], axis=0)
    together = np.column_stack([ends[best[axis]][1][:, axis] for axis in range(2)])
    return spread(together.reshape(1, -1)).ravel()


def _coupled(examine: Examine, point: Signal, terms: Sequence[str]) -> Signal:
    """The best full gains from diagonal ones on, (4 len(terms),)."""
    point, cost = descend(examine, point, STEP)
    firmer = np.repeat([2.0 if name in ("Ki_i", "Kd_i") else 1.0 for name in terms], 4)
    for _ in range(HOPS):  # the coupling in place, the axes may have a better valley than each had for itself
        following, lower = descend(examine, point * firmer, STEP)
        if not lower < (1 - WORTH) * cost:
            break
        point, cost = following, lower
    return point


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
