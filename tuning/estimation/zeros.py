"""Non-minimum-phase zeros of a plant, by a flexible reference model.

A reference model must keep the plant's zeros outside the unit circle, so it cannot be chosen before they are known.
Its numerator is therefore free, M(z, eta) = eta' F(z) with M(1) = 1. It is found together with the controller:
|| M(eta) (u + C(rho) y) - C(rho) y ||^2 is linear least squares in eta for a given rho, and in rho for a given eta.
The zeros of M outside the unit circle are those of the plant. Here all signals enter by their correlations with an
external one, so noise causes no bias.

Source: L. Campestrini, D. Eckhard, M. Gevers, A. S. Bazanella, "Virtual Reference Feedback Tuning for non-minimum
phase plants", Automatica 47 (2011).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import lstsq

from mimopilot.tuning.errors import TuningError
from mimopilot.tuning.estimation.correlations import cross_correlation
from mimopilot.tuning.estimation.vrft import Segments, default_window
from mimopilot.tuning.law import regressors
from mimopilot.tuning.law_filters import Filters
from mimopilot.tuning.reference_model import ReferenceModel
from mimopilot.tuning.statespace import Signal

#: Free coefficients of the numerator.
NUMERATOR = 3
#: Most iterations, each a least-squares problem in rho and one in eta.
ITERATIONS = 200
#: Iterations end when the criterion falls by less than this share.
SETTLED = 1e-7
#: Largest imaginary part of a zero that counts as real: rounding of `numpy.roots`.
REAL = 1e-9


@dataclass(frozen=True, eq=False)
class FlexibleModel:
    """Flexible reference model of one axis.

    Attributes
    ----------
    model : ReferenceModel
        M(z, eta), M(1) = 1.
    misfit : float
        Criterion over the power of C y; 0 when the loop equals M.
    """

    model: ReferenceModel
    misfit: float

    def nonminimum_phase_zeros(self) -> list[float]:
        """Real zeros beyond z = 1 as frequencies ln(z)/Ts, rad/s, slowest first: they bound the bandwidth.

        Other zeros outside the unit circle come from sampling and dead time, and do not bound the bandwidth.
        """
        zeros = np.roots(self.model.num)
        outside = zeros[(np.abs(zeros.imag) < REAL) & (zeros.real > 1)].real
        return sorted(float(np.log(z) / self.model.Ts) for z in outside)


def flexible_model(
    u: Signal,
    y: Signal,
    external: Signal,
    start: ReferenceModel,
    terms: str = "PID",
    *,
    segments: Segments | None = None,
    filters: Filters | None = None,
) -> FlexibleModel:
    """Find M(z, eta) with the poles and the delay of `start`.

    Parameters
    ----------
    u, y : (N,) arrays
        Input and output of one axis.
    external : (N, n_w) array
        External signals of the experiment.
    start : ReferenceModel
        Its poles are kept; its numerator is the initial one.
    terms : str
        Structure of the controller, letters of ``PID``.
    segments : sequence of (start, stop), optional
    filters : Filters, optional
        Filters of the flown law; by default the model's period and no filter.

    Raises
    ------
    TuningError
        When the data are too short or do not excite the plant.
    """
    from scipy.signal import lfilter  # takes a second to import, which most commands do not need

    lags, drop = default_window([start]), 2 * start.settling_samples()
    lag = len(start.den) - len(start.num) + start.delay
    # F_i: one over the denominator, delayed by i samples.
    taps = [np.concatenate([np.zeros(lag + i), [1.0]]) for i in range(NUMERATOR)]
    A: list[Signal] = []
    B: list[Signal] = []
    c: list[Signal] = []
    for a, b in segments or [(0, len(u))]:
        if b - a < drop + 4 * lags:
            continue
        u_l, y_l, w_l = (start.response(s[a:b] - s[a:b].mean(axis=0)) for s in (u[:, None], y[:, None], external))
        x = regressors(terms, y_l, -y_l, y_l, filters or Filters(start.Ts))
        shifted = [lfilter(tap, start.den, np.hstack([u_l, x]), axis=0)[drop:] for tap in taps]
        w = w_l[drop:] - w_l[drop:].mean(axis=0)
        correlated = [cross_correlation(w, signal, lags).reshape(-1, signal.shape[1]) for signal in shifted]
        A.append(np.stack([part[:, 0] for part in correlated], axis=1))
        B.append(np.stack([part[:, 1:] for part in correlated], axis=1))
        c.append(cross_correlation(w, x[drop:], lags).reshape(-1, x.shape[1]))
    if not c:
        raise TuningError(
            f"too short: the search for zeros needs a stretch of {(drop + 4 * lags) * start.Ts:.2f} s without a gap; "
            "record a longer flight"
        )
    return _alternate(np.sum(A, axis=0), np.sum(B, axis=0), np.sum(c, axis=0), start, lag)


def _alternate(A: Signal, B: Signal, c: Signal, start: ReferenceModel, lag: int) -> FlexibleModel:
    """Alternate between both least-squares problems: A (L, n_eta), B (L, n_eta, n_rho), c (L, n_rho)."""
    gain_at_one = 1 / float(np.sum(start.den))  # of every F_i
    eta = np.zeros(NUMERATOR)
    eta[: len(start.num)] = start.num
    scale = np.sqrt(np.sum(c**2, axis=0))
    if not (scale > 0).all():
        raise TuningError("not excited: the output does not respond to the external signal; inject a stronger torque")
    B, c = B / scale, c / scale
    last = np.inf
    for _ in range(ITERATIONS):
        rho = lstsq(np.einsum("lij,i->lj", B, eta) - c, -A @ eta)[0]
        rows, target = A + B @ rho, c @ rho
        # eta sums to 1/F(1): the last coefficient follows from the others.
        free = lstsq(rows[:, :-1] - rows[:, -1:], target - rows[:, -1] / gain_at_one)[0]
        eta = np.append(free, 1 / gain_at_one - free.sum())
        misfit = float(np.sum((rows @ eta - target) ** 2) / np.sum(target**2))
        if last - misfit <= SETTLED * misfit:
            break
        last = misfit
    delay = lag - (len(start.den) - NUMERATOR)
    return FlexibleModel(ReferenceModel(tuple(eta), start.den, delay, start.Ts, "flexible"), misfit)


def slowest_zero(models: Sequence[FlexibleModel]) -> float | None:
    """Slowest non-minimum-phase zero of all axes, rad/s; None: there is none."""
    zeros = [zero for model in models for zero in model.nonminimum_phase_zeros()]
    return min(zeros, default=None)
