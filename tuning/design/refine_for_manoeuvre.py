"""All gains of the cascade refined for one manoeuvre, on a model identified from the same log.

The rate loop's reference model bounds how well the attitude can follow. Here the doublet is predicted from the log, see
`tuning.analysis.doublet_prediction`. A constrained least-squares search starts at VRFT's gains and finds those that
follow the attitude model best within a given effort. Its constraints are margins of the measured frequency response.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from mimopilot.tuning.analysis.beyond_band import MAX_GAIN_ABOVE_BAND, loop_gain_above
from mimopilot.tuning.analysis.closed_loop import model_spectral_radius, singular_values, whole_loop
from mimopilot.tuning.analysis.doublet_prediction import DoubletModel, doublet_effort, moment_rms
from mimopilot.tuning.analysis.stability_figures import GRID_STEP, sensitivity_peak
from mimopilot.tuning.certificate import DEFAULT_THRESHOLDS
from mimopilot.tuning.design.constrained_least_squares import constrained_least_squares
from mimopilot.tuning.errors import TuningError
from mimopilot.tuning.gain_stack import GainStack
from mimopilot.tuning.gains import Gains
from mimopilot.tuning.plant.frequency_response import MIN_FREQUENCIES, PlantResponse
from mimopilot.tuning.plant.rigid_body_fit import RigidBody, rigid_body
from mimopilot.tuning.reference_model import ReferenceModel

#: Share of the certificate's limit on the loop gain above the band that is used; the rest is for rounding.
ABOVE_BAND_SHARE = 0.99
#: The limit on the peak is corrected at most so often...
MAX_CORRECTIONS = 5
#: ... until the peak is this near to the certificate's limit, or a correction lowers the cost by less than that (both
#: relative).
PEAK_TOLERANCE, WORTHWHILE = 0.02, 0.01
#: Share of VRFT's integral action that is kept in every direction: the vehicle must find its trim.
INTEGRAL_SHARE = 0.2
#: The cost has several local minima, most of them at higher gains than VRFT's. Further starting points, found on the
#: simulated airframes: Kp_i over VRFT's, then Ki_i and Kd_i over Kp_i in units of `typical_sizes` (0.5 s and 20 ms).
STARTS = ((1.4, 5.5, 0.8), (1.8, 5.5, 1.8), (1.4, 10.0, 5.0))
#: Weight of the other axis' error: decoupling costs little tracking accuracy.
OTHER_AXIS = 2.0
#: Order of the norm over frequencies that replaces the peak: it is smooth, and slightly larger than the peak.
NORM_ORDER = 48.0
#: Step of the finite differences, in units of `typical_sizes`.
STEP = 1e-4
#: Torque (normalised) over which anti-windup switches, see `tuning.analysis.doublet_prediction.DoubletModel.simulate`.
SOFT_SWITCH = 0.05

Signal = NDArray[np.float64]


def refine_for_manoeuvre(
    gains: Gains,
    model: DoubletModel,
    response: PlantResponse,
    outer: Sequence[ReferenceModel],
    *,
    terms: Sequence[str],
    full: bool,
    limit: Sequence[float] | None = None,
) -> Gains:
    """Gains that follow the attitude model best in the manoeuvre, within the effort and the margins.

    Parameters
    ----------
    gains : Gains
        VRFT's, where the search starts.
    model : DoubletModel
    response : PlantResponse
        From the same experiment.
    outer : sequence of 2 ReferenceModel
        Of the attitude loop.
    terms : sequence of str
        Names of the matrices that may change.
    full : bool
        False: their diagonals only (SISO).
    limit : sequence of 2 float, optional
        Largest effort in the roll and the pitch doublet; by default what `gains` need.

    Raises
    ------
    TuningError
        When the measured response is known at too few frequencies, or no gains are found within the limits.
    """
    known = response.at(response.coherent_run())
    if len(known.omega) < MIN_FREQUENCIES:
        raise TuningError(
            f"the excitation reaches only {len(known.omega)} frequencies, {MIN_FREQUENCIES} are needed; record a "
            "longer or stronger excitation"
        )
    wanted = np.zeros((2, 1, len(model.setpoint), 2))
    for axis, reference in enumerate(outer):
        wanted[axis, 0, :, axis] = reference.response(model.setpoint)
    allowed = np.array(limit if limit is not None else doublet_effort(gains, model))
    task = _ManoeuvreProblem(
        start=gains,
        model=model,
        known=known,
        dense=known.interpolated(GRID_STEP),
        body=rigid_body(response),
        wanted=wanted,
        allowed=allowed,
        terms=terms,
        full=full,
    )
    peak = DEFAULT_THRESHOLDS.thin_Ms
    point, cost = min((task.minimum_from(start, peak) for start in task.starting_points()), key=lambda end: end[1])
    if cost == np.inf:
        raise TuningError("no gains were found within the margins and the effort; allow more effort")
    # The norm is larger than the peak, and the peak's error is known only for the gains that were found.
    kept = None
    for _ in range(MAX_CORRECTIONS):
        Ms, error = sensitivity_peak(task.gains_at(point), response)
        ratio = (DEFAULT_THRESHOLDS.thin_Ms - error) / Ms
        if ratio >= 1 and (kept is None or cost < kept[1]):
            kept = point, cost
        if 1 <= ratio < 1 + PEAK_TOLERANCE:
            break
        peak *= ratio / (1 + PEAK_TOLERANCE / 2)
        nearby, least = task.minimum_from(point, peak)
        if least == np.inf or (ratio > 1 and least > (1 - WORTHWHILE) * cost):
            break
        point, cost = nearby, least
    return task.gains_at(kept[0] if kept else point)


@dataclass(frozen=True, eq=False)
class _ManoeuvreProblem:
    """The optimisation problem: variables, cost and constraints.

    A point holds the matrices that may change, in units of `typical_sizes`, one after the other: (4 terms,).

    Attributes
    ----------
    start : Gains
    model : DoubletModel
    known, dense : PlantResponse
        Measured response where it is known, and the same interpolated to a finer grid.
    body : RigidBody
    wanted : (2, 1, N, 2) array, rad
        Angles that the attitude model asks for in the roll and in the pitch doublet.
    allowed : (2,) array
        Largest effort.
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
        """Which elements of a point may change."""
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

    def starting_points(self) -> Iterator[Signal]:
        """VRFT's gains, and higher ones with the same coupling; see `STARTS`."""
        sizes, pattern = typical_sizes(self.start), self.free[:4].reshape(2, 2)
        parts = {name: getattr(self.start, name) / sizes[name] * pattern for name in self.terms}
        yield _flat(parts)
        for proportional, *ratios in STARTS if "Kp_i" in parts else ():
            high = {"Kp_i": proportional * parts["Kp_i"]}
            high |= {name: ratio * high["Kp_i"] for name, ratio in zip(("Ki_i", "Kd_i"), ratios, strict=True)}
            yield _flat({name: high.get(name, part) for name, part in parts.items()})

    def minimum_from(self, first: Signal, peak: float) -> tuple[Signal, float]:
        """Point and cost of the local minimum near `first`, with a limit on the sensitivity's peak.

        The cost is infinite when a constraint is violated or the loop is unstable: the margins of an unstable loop
        can look as good as those of a stable one.
        """
        stack, free, weight = GainStack.of(self.start), self.free, self._weight()

        def spread(points: Signal) -> Signal:
            every = np.tile(first, (len(points), 1))
            every[:, free] = points
            return every

        def examine(points: Signal) -> tuple[Signal, Signal]:
            candidates = stack.varied(self.matrices(spread(points)))
            angles, moments = self.model.simulate(candidates, SOFT_SWITCH)
            residuals = np.moveaxis((angles - self.wanted) * weight, 1, 0).reshape(len(points), -1)
            return residuals, np.hstack([1 - moment_rms(moments).T / self.allowed, self._margins(candidates, peak)])

        end, cost = constrained_least_squares(examine, first[free], STEP)
        point = spread(end[None])[0]
        stable = model_spectral_radius(self.gains_at(point), self.model.plant) < 1
        return point, cost if stable else np.inf

    def _weight(self) -> Signal:
        """Weight of each residual: their sum of squares is then a mean square."""
        axes = np.where(np.eye(2, dtype=bool), 1.0, OTHER_AXIS)[:, None, None, :]
        weight: Signal = axes / np.sqrt(len(self.model.setpoint))
        return weight

    def _margins(self, candidates: GainStack, peak: float) -> Signal:
        """Relative margins to the limits, negative when violated, (sets, 4).

        Of the sensitivity's peak for the rate loop alone and for the whole loop, of the gain above the band, and of the
        integral action.
        """
        loops = np.stack(whole_loop(candidates, self.dense)[:2], axis=1)
        differences = np.concatenate(singular_values(np.eye(2, dtype=complex) + loops), axis=-1)
        peaks = np.sum(differences**-NORM_ORDER, axis=-1) ** (1 / NORM_ORDER)
        above = loop_gain_above(candidates, self.known)[:, -1] / MAX_GAIN_ABOVE_BAND
        integral, floor = np.ones(len(above)), INTEGRAL_SHARE * float(self.body.least(self.start.Ki_i))
        if floor > 0:
            integral = self.body.least(candidates.Ki_i[:, 0]) / floor - 1
        return np.column_stack([1 - peaks / peak, 1 - above / ABOVE_BAND_SHARE, integral])


def _flat(parts: Mapping[str, Signal]) -> Signal:
    return np.array(list(parts.values())).ravel()


def typical_sizes(gains: Gains) -> dict[str, float]:
    """Typical size of each matrix' elements: units of the search, since some start at zero.

    Ki_i over Kp_i is 1 / 0.5 s and Kd_i over Kp_i is 20 ms, the order of those of the simulated airframes.
    """
    proportional = float(np.abs(gains.Kp_i).max())
    return {
        "Kp_o": float(np.abs(gains.Kp_o).max()),
        "Kp_i": proportional,
        "Ki_i": 2.0 * proportional,
        "Kd_i": 0.02 * proportional,
        "Kff_i": proportional,
    }
