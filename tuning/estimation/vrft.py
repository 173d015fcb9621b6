"""Multivariable Virtual Reference Feedback Tuning of one loop, with extended instrumental variables.

Given one experiment {u, y} and a reference model M, diagonal or full, the controller C(B) whose closed loop equals M
turns the virtual error e_V = (M^-1 - I) y into u. All signals pass one scalar filter l, so that every filter is proper.
The controller is linear in its gains, and the instrument is an external signal of the experiment at 2 l + 1 lags.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from mimopilot.tuning.errors import TuningError
from mimopilot.tuning.estimation.regression import Regression, Solution, solve
from mimopilot.tuning.law import regressors
from mimopilot.tuning.law_filters import Filters
from mimopilot.tuning.law_terms import LOOP_TERMS
from mimopilot.tuning.reference_matrix import ReferenceMatrix, Wanted
from mimopilot.tuning.reference_model import ReferenceModel

Signal = NDArray[np.float64]
Segments = Sequence[tuple[int, int]]

#: Share of its peak to which the reference model's transient decays within the instrument's lags.
DECAY = 0.1


@dataclass(frozen=True, eq=False)
class LoopEstimate:
    """Gains of one loop, by term.

    Attributes
    ----------
    gains : dict
        Term (``P``, ``I``, ``D``, ``F``) -> (n_u, n_y) array.
    samples : int
        Samples used.
    window : int
        Lags l of the instrument.
    solution : Solution
        The regression: covariance, strength of the instrument, fit.
    """

    gains: dict[str, Signal]
    samples: int
    window: int
    solution: Solution

    @cached_property
    def deviations(self) -> dict[str, Signal]:
        """Term -> (n_u, n_y) standard deviations over repeated noise."""
        variances = np.diagonal(self.solution.covariance, axis1=1, axis2=2)
        found = np.split(np.sqrt(np.maximum(variances, 0.0)), len(self.gains), axis=1)
        return dict(zip(self.gains, found, strict=True))

    def gain(self, term: str) -> Signal:
        """Matrix of a term; zeros if the structure lacks it."""
        first = next(iter(self.gains.values()))
        return self.gains.get(term, np.zeros_like(first))


def default_window(models: Wanted) -> int:
    """Lags of the instrument: until the slowest reference model has decayed to `DECAY`."""
    if isinstance(models, ReferenceMatrix):
        return models.settling_samples(DECAY)
    return max(model.settling_samples(DECAY) for model in models)


def virtual_signals(y: Signal, models: Wanted) -> tuple[Signal, Signal, Signal, list[ReferenceModel]]:
    """e_l, r_l and y_l for the filter l = product of the distinct models; for a full matrix l = det M.

    Returns
    -------
    e_l, r_l, y_l : (N, n_y) arrays
        l (M^-1 - I) y, l M^-1 y and l y, in the unit of `y`.
    factors : list of ReferenceModel
        The models whose product is l.
    """
    if isinstance(models, ReferenceMatrix):
        virtual, filtered = models.adjugate_response(y), models.determinant.response(y)
        return virtual - filtered, virtual, filtered, [models.determinant]
    factors: list[ReferenceModel] = []
    for model in models:
        if model not in factors:
            factors.append(model)
    virtual = np.empty_like(y)
    for j, model in enumerate(models):
        signal = y[:, j]
        for factor in factors:
            if factor != model:
                signal = factor.response(signal)
        virtual[:, j] = signal
    filtered = filter_by(y, factors)
    return virtual - filtered, virtual, filtered, factors


def filter_by(signal: Signal, factors: Sequence[ReferenceModel]) -> Signal:
    """Filter every column by the scalar l."""
    for factor in factors:
        signal = factor.response(signal)
    return signal


def filter_by_inverse(signal: Signal, factors: Sequence[ReferenceModel], models: Sequence[ReferenceModel]) -> Signal:
    """Filter by l and M^-1, as one proper filter l m_j^-1 for each column.

    Parameters
    ----------
    signal : (N, n) array
    factors : sequence of ReferenceModel
        Models whose product is l.
    models : sequence of n ReferenceModel
        M.

    Raises
    ------
    TuningError
        When l has less delay than M, or M cannot be inverted.
    """
    filtered = filter_by(signal, factors[1:])
    columns = [factors[0].over(model).response(filtered[:, j]) for j, model in enumerate(models)]
    return np.column_stack(columns)


def vrft(
    u: Signal,
    y: Signal,
    instrument: Signal,
    models: Wanted,
    terms: str,
    *,
    segments: Segments | None = None,
    window: int | None = None,
    filters: Filters | None = None,
    settling: int = 0,
    weight: str = "optimal",
    trim: bool = True,
    external: Signal | None = None,
    repeated: Signal | None = None,
    prefilter: Callable[[Signal], Signal] | None = None,
    emphasis: ReferenceModel | None = None,
    inverse: Sequence[ReferenceModel] | None = None,
    prior: Mapping[str, Signal] | None = None,
    pull: float = 0.0,
) -> LoopEstimate:
    """Gains that bring the closed loop closest to the reference model.

    Parameters
    ----------
    u : (N, n_u) array
        Input of the plant: the controller's output.
    y : (N, n_y) array
        Output of the plant.
    instrument : (N, n_w) array
        Signal whose lags are the instruments: an external one (the injected excitation, or the setpoint), or `u`
        itself, the thesis' choice, which in closed loop contains fed-back noise.
    models : sequence of n_y ReferenceModel, or ReferenceMatrix
        Complementary sensitivity asked of each output, or the whole matrix.
    terms : str
        Structure of the controller: ``P``, ``PI``, ``PID``, ``PIDF``...
    segments : sequence of (start, stop), optional
        Stretches without a gap; all of the data by default. Filters restart and a constant (trim and initial
        integrator) is estimated on each.
    window : int, optional
        Lags l of the instrument; see `default_window`.
    filters : Filters, optional
        Filters of the flown law; by default the models' period and no filter.
    settling : int, samples
        Further samples to drop at the start of each segment.
    weight : str
        ``identity``: least squares on the correlations, (3.28). ``optimal``: (3.30), in two steps.
    trim : bool
        False: no constant, as in the thesis; only for data without offsets.
    external : (N, n_e) array, optional
        External signal if `instrument` is not external; what it does not explain is noise.
    repeated : (N, n_y) array, optional
        y with independent noise, from a second experiment (3.13) or simulated by an identified model. Its regressors
        are then the instruments instead of lags, and `instrument` is the external signal.
    prefilter : callable, optional
        Filter of every signal before l, such as `tuning.estimation.siso.prefilter`.
    emphasis : ReferenceModel, optional
        W(z) of the criterion (3.1), ||W (M - T)||: where it is large the loop follows M more closely, if the structure
        cannot reach M. It filters every signal.
    inverse : sequence of n_u ReferenceModel, optional
        M_i of an inner loop: `u` then holds that loop's outputs, and M_i^-1 u is used.
    prior : mapping, optional
        Term -> (n_u, n_y) gains that the estimate is pulled towards.
    pull : float
        lambda of the pull, relative to the curvature of each gain: 1 goes half of the way.

    Returns
    -------
    LoopEstimate

    Raises
    ------
    TuningError
        When a segment is too short, a model's period differs, or the regressors are not excited.
    """
    letters = "".join(term for term in LOOP_TERMS if term in terms)
    if not letters or len(letters) != len(terms) or weight not in ("optimal", "identity"):
        known = "".join(LOOP_TERMS)
        raise TuningError(
            f"got terms {terms!r} and weight {weight!r}, expected letters of {known}, and optimal or identity"
        )
    if len(models) != y.shape[1]:
        raise TuningError(f"got {len(models)} reference models for {y.shape[1]} outputs, expected one for each")
    lags = default_window(models) if window is None else window
    if isinstance(models, ReferenceMatrix):
        Ts, transient = models.Ts, models.settling_samples()
    else:
        Ts, transient = models[0].Ts, sum(model.settling_samples() for model in dict.fromkeys(models))
    flown = filters or Filters(Ts)
    drop = settling + transient + (emphasis.settling_samples() if emphasis else 0)
    needed = drop + 4 * lags
    filters_before = [f for f in (emphasis.response if emphasis else None, prefilter) if f]

    def shaped(signal: Signal) -> Signal:
        for before in filters_before:
            signal = before(signal)
        return signal

    def regressor(output: Signal) -> tuple[Signal, list[ReferenceModel]]:
        e_l, r_l, y_l, factors = virtual_signals(shaped(output), models)
        return regressors(letters, e_l, y_l, r_l, flown)[drop:], factors

    xs: list[Signal] = []
    us: list[Signal] = []
    ws: list[Signal] = []
    vs: list[Signal] = []
    for start, stop in segments or [(0, len(u))]:
        if stop - start < needed:
            continue
        part = slice(start, stop)
        x, factors = regressor(y[part])
        u_l = shaped(u[part])
        u_l = (filter_by_inverse(u_l, factors, inverse) if inverse else filter_by(u_l, factors))[drop:]
        w = filter_by(shaped(instrument[part]), factors)[drop:]
        v = w if external is None else filter_by(shaped(external[part]), factors)[drop:]
        if repeated is not None:
            w = regressor(repeated[part])[0]
        if trim:
            # The constant (trim, initial integrator), filtered like the rest, is both regressor and instrument:
            # removing its projection from all other signals is equivalent to estimating it.
            constant = filter_by(np.ones((stop - start, 1)), factors)[drop:]
            _remove_projection(constant, x)
            _remove_projection(constant, u_l)
            if repeated is not None:
                _remove_projection(constant, w)
        for signals, signal in ((xs, x), (us, u_l), (ws, w), (vs, v)):
            signals.append(signal)
    if not xs:
        raise TuningError(
            f"too short: these reference models need a stretch without a gap longer than {needed * Ts:.2f} s; record a "
            "longer flight, or ask for faster models"
        )
    if repeated is not None:
        lags = 0
        # P, I and D have different units: scaled to unit norm over all stretches, the problem is well conditioned.
        size = np.sqrt(np.sum([np.einsum("ij,ij->j", w, w) for w in ws], axis=0))
        ws = [w / np.where(size > 0, size, 1.0) for w in ws]
    problem = Regression(xs, us, ws, lags, memory=max(lags, 2 * drop), external=vs)
    solution = solve(problem, weight, None if prior is None else np.hstack([prior[t] for t in letters]), pull)
    n_y = y.shape[1]
    split = {term: slice(i * n_y, (i + 1) * n_y) for i, term in enumerate(letters)}
    return LoopEstimate(
        {term: solution.B[:, columns] for term, columns in split.items()},
        problem.samples,
        lags,
        solution,
    )


def _remove_projection(constant: Signal, signal: Signal) -> None:
    """Subtract from `signal` (N, n) its projection on `constant` (N, 1), in place."""
    signal -= constant @ (constant.T @ signal / (constant.T @ constant))
