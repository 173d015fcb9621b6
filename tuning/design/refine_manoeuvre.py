"""Gains for a manoeuvre: the whole cascade refined on a model that the same log gives.

A rate-loop model is a means: what is flown is the attitude, and how well it follows is bounded by what the rate loop
was asked for. Here the doublet is predicted from the log, `tuning.analysis.doublet_prediction`, and a descent goes
from VRFT's gains to those that follow the attitude model best within an effort. The measured frequency response sets
the margins that no step may break.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from mimopilot.tuning.analysis.certificate import DENSE, HIGH_FREQUENCY_LOOP, loop_above, sensitivity_peak
from mimopilot.tuning.analysis.closed_loop import model_spectral_radius, singular_values, whole_loop
from mimopilot.tuning.analysis.doublet_prediction import DoubletModel, effort, moment_rms
from mimopilot.tuning.certificate import DEFAULT_THRESHOLDS
from mimopilot.tuning.design.constrained_least_squares import descend
from mimopilot.tuning.errors import TuningError
from mimopilot.tuning.gain_stack import GainStack
from mimopilot.tuning.gains import Gains
from mimopilot.tuning.plant.frequency_response import MIN_FREQUENCIES, PlantResponse
from mimopilot.tuning.plant.rigid_body_fit import RigidBody, rigid_body
from mimopilot.tuning.reference_model import ReferenceModel
from numpy.typing import NDArray

#: Share of the gain that a certificate allows above the band.
SHARE = 0.99
#: The limit of the peak is corrected so often, until the certificate's is used up but for this share, or while that
#: gains another.
REPEATS, NEAR, WORTH = 5, 0.02, 0.01
#: The integral term keeps this share of what VRFT gave it, in every direction.
INTEGRAL = 0.2
#: There are several valleys, most of them firmer than VRFT's gains: Kp_i over VRFT's, Ki_i and Kd_i over Kp_i in units
#: of typical sizes (0.5 s and 20 ms).
FIRMER = ((1.4, 5.5, 0.8), (1.8, 5.5, 1.8), (1.4, 10.0, 5.0))
#: Weight of the other axis' error: what decoupling costs in following is little.
OTHER_AXIS = 2.0
#: Order of the norm over frequencies that stands for the peak: smooth, and a little more than the peak itself.
SMOOTH = 48.0
STEP = 1e-4
#: See `tuning.analysis.doublet_prediction.DoubletModel.fly`.
SOFT = 0.05

Signal = NDArray[np.float64]


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
        When the measured response is known at too few frequencies, or no gains are found that keep the limits.
    """
    known = response.at(response.coherent_run())
    if len(known.omega) < MIN_FREQUENCIES:
        raise TuningError(f"the excitation reaches only {len(known.omega)} frequencies, fewer than {MIN_FREQUENCIES}")
    wanted = np.zeros((2, 1, len(model.setpoint), 2))
    for axis, reference in enumerate(outer):
        wanted[axis, 0, :, axis] = reference.response(model.setpoint)
    allowed = np.array(limit if limit is not None else effort(gains, model))
    task = _Task(gains, model, known, known.interpolated(DENSE), rigid_body(response), wanted, allowed, terms, full)
    peak = DEFAULT_THRESHOLDS.thin_Ms
    point, cost = min((task.descended(begin, peak) for begin in task.beginnings()), key=lambda end: end[1])
    if cost == np.inf:
        raise TuningError("from none of the beginnings gains were found that keep the margins and the effort")
    # The norm is more than the peak, and what the log leaves open of the peak is known at the end only.
    kept = None
    for _ in range(REPEATS):
        Ms, error = sensitivity_peak(task.gains_at(point), response)
        room = (DEFAULT_THRESHOLDS.thin_Ms - error) / Ms
        if room >= 1 and (kept is None or cost < kept[1]):
            kept = point, cost
        if 1 <= room < 1 + NEAR:
            break
        peak *= room / (1 + NEAR / 2)
        nearby, least = task.descended(point, peak)
        if least == np.inf or (room > 1 and least > (1 - WORTH) * cost):
            break
        point, cost = nearby, least
    return task.gains_at(kept[0] if kept else point)


@dataclass(frozen=True, eq=False)
class _Task:
    """What is refined, and by what it is judged.

    Points are the free matrices in units of typical sizes, one after the other, (4 terms,).

    Attributes
    ----------
    start : Gains
    model : DoubletModel
    known, dense : PlantResponse
        Measured response where it is known, and with frequencies between its own.
    body : RigidBody
    wanted : (2, 1, N, 2) array, rad
        Angles that the attitude model asks for in the roll and in the pitch doublet.
    allowed : (2,) array
        Effort.
    terms : sequence of str
    full : bool
    """

    start: Gains
    model: DoubletModel
    known: PlantResponse
    dense: PlantResponse
    body: RigidBody
    wanted: Signal
    allowed: Signal
    terms: Sequence[str]
    full: bool

    @property
    def free(self) -> NDArray[np.bool_]:
        """Which elements of a point change."""
        pattern = np.ones((2, 2), bool) if self.full else np.eye(2, dtype=bool)
        return np.tile(pattern.ravel(), len(self.terms))

    def matrices(self, points: Signal) -> dict[str, Signal]:
        """The matrices of each of several points, (points, 2, 2)."""
        sizes = typical_sizes(self.start)
        parts = np.moveaxis(points.reshape(-1, len(self.terms), 2, 2), 1, 0)
        return {name: sizes[name] * part for name, part in zip(self.terms, parts, strict=True)}

    def gains_at(self, point: Signal) -> Gains:
        """The gain set at a point."""
        parts = {name: matrix[0] for name, matrix in self.matrices(point).items()}
        return replace(self.start, certificate=None, **parts)  # type: ignore[arg-type]

    def beginnings(self) -> Iterator[Signal]:
        """Where descents begin: VRFT's gains, and firmer ones with the coupling that VRFT found."""
        sizes, pattern = typical_sizes(self.start), self.free[:4].reshape(2, 2)
        parts = {name: getattr(self.start, name) / sizes[name] * pattern for name in self.terms}
        yield _flat(parts)
        for proportional, *ratios in FIRMER if "Kp_i" in parts else ():
            firm = {"Kp_i": proportional * parts["Kp_i"]}
            firm |= {name: ratio * firm["Kp_i"] for name, ratio in zip(("Ki_i", "Kd_i"), ratios, strict=True)}
            yield _flat({name: firm.get(name, part) for name, part in parts.items()})

    def descended(self, first: Signal, peak: float) -> tuple[Signal, float]:
        """End and cost of a descent within a limit of the sensitivity's peak; a limit that is missed and a loop that is
        unstable cost infinity: on the far side of instability nothing else would tell.
        """
        stack, free, weight = GainStack.of(self.start), self.free, self._weight()

        def spread(points: Signal) -> Signal:
            every = np.tile(first, (len(points), 1))
            every[:, free] = points
            return every

        def examine(points: Signal) -> tuple[Signal, Signal]:
            candidates = stack.varied(self.matrices(spread(points)))
            angles, moments = self.model.fly(candidates, SOFT)
            residuals = np.moveaxis((angles - self.wanted) * weight, 1, 0).reshape(len(points), -1)
            return residuals, np.hstack([1 - moment_rms(moments).T / self.allowed, self._margins(candidates, peak)])

        end, cost = descend(examine, first[free], STEP)
        point = spread(end[None])[0]
        stable = model_spectral_radius(self.gains_at(point), self.model.plant) < 1
        return point, cost if stable else np.inf

    def _weight(self) -> Signal:
        """Of each residual, so that their sum of squares is a mean square."""
        axes = np.where(np.eye(2, dtype=bool), 1.0, OTHER_AXIS)[:, None, None, :]
        weight: Signal = axes / np.sqrt(len(self.model.setpoint))
        return weight

    def _margins(self, candidates: GainStack, peak: float) -> Signal:
        """What is left of the peak of the sensitivity, of the rate loop alone and of the whole loop, of the gain above
        the band, of the integral; relative, (sets, 4).
        """
        loops = np.stack(whole_loop(candidates, self.dense)[:2], axis=1)
        differences = np.concatenate(singular_values(np.eye(2, dtype=complex) + loops), axis=-1)
        peaks = np.sum(differences**-SMOOTH, axis=-1) ** (1 / SMOOTH)
        above = loop_above(candidates, self.known)[:, -1] / HIGH_FREQUENCY_LOOP
        integral, floor = np.ones(len(above)), INTEGRAL * float(self.body.least(self.start.Ki_i))
        if floor > 0:
            integral = self.body.least(candidates.Ki_i[:, 0]) / floor - 1
        return np.column_stack([1 - peaks / peak, 1 - above / SHARE, integral])


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
