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
from tuning.closed_loop import ACCURATE, MIN_FREQUENCIES, PlantResponse, cascade_loop, longest_run
from tuning.descent import descend
from tuning.errors import TuningError
from tuning.experiment import Experiment
from tuning.gains import Gains
from tuning.identification import identify_rates
from tuning.reference import ReferenceModel
from tuning.spec import Manoeuvre
from tuning.statespace import StateSpace

#: The certificate's limits with some room: peak of the sensitivity, share of the gain allowed above the band.
PEAK, SHARE = 2.3, 0.9
#: The integral term keeps this share of what VRFT gave it, in every direction.
INTEGRAL = 0.2
#: Weight of the other axis' error: what decoupling costs in following is little.
OTHER_AXIS = 2.0
#: Order of the norm over frequencies that stands for the peak: smooth, and a little more than the peak itself.
SMOOTH = 24
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

    def fly(self, candidates: Sequence[Gains]) -> tuple[Signal, Signal]:
        """Doublets on roll and on pitch under several gain sets of one vehicle, without noise.

        Returns
        -------
        angles, moments : (2, len(candidates), N, 2) arrays, rad, dimensionless
            First index: the axis that moves.
        """
        first = candidates[0]
        Ts, a = first.Ts, first.derivative_pole
        rate_max = first.limits.rate_max[:2]
        moment_max, integral_max = np.array(first.limits.moment_max[:2]), np.array(first.limits.integral_max[:2])
        Kp_o, Kp_i, Ki_i, Kd_i, Kff_i = (
            np.stack([getattr(gains, name) for gains in candidates])
            for name in ("Kp_o", "Kp_i", "Ki_i", "Kd_i", "Kff_i")
        )
        shape = (2, len(candidates), 2)
        angle, rate, integral, slope = (np.zeros(shape) for _ in range(4))
        state = np.zeros((*shape[:2], len(self.plant.A)))
        angles, moments = (np.zeros((*shape[:2], len(self.setpoint), 2)) for _ in range(2))
        direction = np.eye(2)[:, None, :]
        # Moments are counted from the trim, which the flown integral holds.
        lowest, highest = -moment_max - self.trim, moment_max - self.trim
        least, most = -integral_max - self.trim, integral_max - self.trim

        def times(matrices: Signal, vectors: Signal) -> Signal:
            return np.asarray(np.einsum("cij,acj->aci", matrices, vectors))

        for k, height in enumerate(self.setpoint):
            now = state @ self.plant.C.T
            angle = angle + Ts / 2 * (now + rate)
            wanted = np.clip(times(Kp_o, height * direction - angle), np.negative(rate_max), rate_max)
            slope = a * slope + (1 - a) / Ts * (now - rate)
            rest = times(Kp_i, wanted - now) - times(Kd_i, slope) + times(Kff_i, wanted)
            growth = Ts * times(Ki_i, wanted - now)
            tried = rest + integral + growth
            wound_up = ((tried > highest) & (growth > 0)) | ((tried < lowest) & (growth < 0))
            integral = np.clip(integral + np.where(wound_up, 0.0, growth), least, most)
            moment = np.clip(rest + integral, lowest, highest)
            angles[:, :, k], moments[:, :, k] = angle, moment + self.trim
            rate, state = now, state @ self.plant.A.T + moment @ self.plant.B.T
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
    roll, pitch = _effort(model.fly([gains])[1])[:, 0]
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
    coherent = response.at(longest_run(np.flatnonzero(response.coherent())))
    allowed = np.array(limit if limit is not None else effort(gains, model))
    wanted = np.zeros((2, 1, len(model.setpoint), 2))
    for axis, reference in enumerate(outer):
        wanted[axis, 0, :, axis] = reference.response(model.setpoint)
    weight = np.where(np.eye(2, dtype=bool), 1.0, OTHER_AXIS)[:, None, None, :] / np.sqrt(len(model.setpoint))
    where = np.tile(np.ones(4, bool) if full else np.eye(2, dtype=bool).ravel(), len(terms))
    sizes = typical_sizes(gains)
    scale = np.repeat([sizes[name] for name in terms], 4)[where]
    start = np.concatenate([getattr(gains, name).ravel() for name in terms])
    floor = INTEGRAL * integral_rate(gains.Ki_i, gains.Kp_i)

    def placed(values: Signal) -> Gains:
        every = start.copy()
        every[where] = values * scale
        parts = np.split(every, len(terms))
        matrices = {name: part.reshape(2, 2) for name, part in zip(terms, parts, strict=True)}
        return replace(gains, certificate=None, **matrices)  # type: ignore[arg-type]

    def left(candidate: Gains) -> list[float]:
        """Of the peak of the sensitivity, of the gain above the band, of the integral; relative."""
        differences = np.linalg.svd(np.eye(2) + cascade_loop(candidate, known).L_u, compute_uv=False)
        above = float(loop_above(candidate, coherent)[-1]) / HIGH_FREQUENCY_LOOP
        # VRFT's Kp_i is nearly the inverse of the plant's gain: beside it the directions are alike.
        integral = integral_rate(candidate.Ki_i, gains.Kp_i) / floor - 1 if floor > 0 else 1.0
        return [1 - float(np.linalg.norm(1 / differences.ravel(), ord=SMOOTH)) / PEAK, 1 - above / SHARE, integral]

    def examine(points: Signal) -> tuple[Signal, Signal]:
        candidates = [placed(values) for values in points]
        angles, moments = model.fly(candidates)
        residuals = np.moveaxis((angles - wanted) * weight, 1, 0).reshape(len(points), -1)
        return residuals, np.hstack([1 - _effort(moments).T / allowed, [left(candidate) for candidate in candidates]])

    diagonal = np.tile(np.eye(2, dtype=bool).ravel(), len(terms))[where]
    # Each axis for itself, then the coupling: from VRFT's coupled gains the way often ends in a worse valley.
    point = np.where(diagonal, start[where] / scale, 0.0)
    point[diagonal], _ = descend(lambda points: examine(_spread(points, diagonal)), point[diagonal], STEP)
    return placed(descend(examine, point, STEP)[0] if full else point)


def _spread(points: Signal, where: NDArray[np.bool_]) -> Signal:
    """Points of fewer dimensions among zeros."""
    every = np.zeros((len(points), len(where)))
    every[:, where] = points
    return every


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
