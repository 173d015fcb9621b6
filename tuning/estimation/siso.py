"""SISO VRFT of the thesis: one axis by itself, the baseline of its tables."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from scipy.linalg import solve_toeplitz

from mimopilot.tuning.errors import TuningError
from mimopilot.tuning.estimation.correlations import autocorrelation
from mimopilot.tuning.estimation.vrft import LoopEstimate, Segments, vrft
from mimopilot.tuning.reference_model import ReferenceModel
from mimopilot.tuning.statespace import Signal

#: Order of the autoregressive model of u whose inverse is 1/Phi_u.
WHITENING_ORDER = 10


def whitening_filter(u: Signal) -> Signal:
    """Taps of the minimum-phase filter a with |a(z)|^2 proportional to 1/Phi_u, by the Yule-Walker equations.

    Parameters
    ----------
    u : (N,) array

    Returns
    -------
    (WHITENING_ORDER + 1,) array
        First tap 1.
    """
    covariance = autocorrelation(u[:, None], WHITENING_ORDER)[WHITENING_ORDER:, 0, 0]
    if not covariance[0] > 0:
        raise TuningError("not excited: the plant input u is zero; check the log's torque")
    prediction = solve_toeplitz(covariance[:-1], covariance[1:])
    return np.concatenate([[1.0], -prediction])


def prefilter(u: Signal, model: ReferenceModel) -> Callable[[Signal], Signal]:
    """Optimal prefilter |L|^2 = |1 - M|^2 |M|^2 / Phi_u, (3.12) with W = 1, without its factor l = m.

    Parameters
    ----------
    u : (N,) array
        Plant input of the axis.
    model : ReferenceModel
        M.

    Returns
    -------
    callable
        Filters (N, n) arrays, from rest.
    """
    from scipy.signal import lfilter  # takes a second to import, which most commands do not need

    taps = whitening_filter(u)

    def shaped(signal: Signal) -> Signal:
        column = lfilter(taps, [1.0], signal, axis=0)
        rest: Signal = column - model.response(column)
        return rest

    return shaped


def siso_vrft(
    u: Signal,
    y: Signal,
    instrument: Signal,
    model: ReferenceModel,
    terms: str,
    *,
    segments: Segments | None = None,
    settling: int = 0,
    **options: Any,
) -> LoopEstimate:
    """Gains of one axis with the optimal prefilter (3.12).

    Parameters
    ----------
    u, y, instrument : (N, 1) arrays
        As in `vrft`. For the thesis' basic instruments give `repeated` as well: the output of a second experiment
        (3.13) or of an identified model, or `y` itself for plain least squares.
    model : ReferenceModel
    terms : str
        Letters of ``PIDF``.
    segments : sequence of (start, stop), optional
    settling : int, samples
    **options
        Further arguments of `tuning.estimation.vrft.vrft`.

    Raises
    ------
    TuningError
        When u is zero, or the data are too short or not excited.
    """
    stretches = segments or [(0, len(u))]
    shaped = prefilter(np.concatenate([u[start:stop, 0] for start, stop in stretches]), model)
    settling += model.settling_samples() + WHITENING_ORDER
    return vrft(u, y, instrument, [model], terms, segments=stretches, settling=settling, prefilter=shaped, **options)
