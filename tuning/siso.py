"""SISO VRFT as the thesis has it: one axis by itself, the baseline of its tables."""

from __future__ import annotations

import numpy as np
from scipy.linalg import solve_toeplitz
from scipy.signal import lfilter

from tuning.correlations import autocorrelation
from tuning.errors import TuningError
from tuning.loop import LoopController
from tuning.reference import ReferenceModel
from tuning.statespace import Signal
from tuning.vrft import regressors, vrft

#: Order of the autoregressive model of u whose inverse is 1/Phi_u.
WHITENING_ORDER = 10


def whitening_filter(u: Signal) -> Signal:
    """Taps a of the minimum-phase filter with |a(z)|^2 proportional to 1/Phi_u, by the Yule-Walker equations.

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
        raise TuningError("not excited: the plant input is zero")
    prediction = solve_toeplitz(covariance[:-1], covariance[1:])
    return np.concatenate([[1.0], -prediction])


def siso_vrft(
    u: Signal,
    y: Signal,
    model: ReferenceModel,
    terms: str,
    *,
    repeated: Signal | None = None,
    external: Signal | None = None,
    window: int | None = None,
    derivative_cutoff_hz: float = 0.0,
) -> LoopController:
    """Gains of one axis with the optimal prefilter |L|^2 = |1 - M|^2 |M|^2 / Phi_u, (3.12) with W = 1.

    Exactly one instrument against noise, or none for noise-free data:

    - `repeated`: regressors of an output with other noise than y: of a second experiment with the same
      excitation (3.13), or simulated from u_bar by an identified model (`tuning.identification.pbsid`);
    - `external`: extended instruments, lags of an external signal, see `tuning.vrft.vrft`.

    Parameters
    ----------
    u, y : (N,) arrays
        Input and output of the axis.
    model : ReferenceModel
    terms : str
        Letters of ``PID``.
    repeated : (N,) array, optional
        Unit of y.
    external : (N,) array, optional
    window : int, samples, optional
        Lags of `external`.
    derivative_cutoff_hz : float, Hz

    Returns
    -------
    LoopController
        With 1x1 matrices.

    Raises
    ------
    TuningError
        When two instruments are given, u is zero, or the data are too short or not excited.
    """
    if repeated is not None and external is not None:
        raise TuningError("SISO VRFT: got both a repeated output and an external instrument; expected one of them")
    taps = whitening_filter(u)

    def shaped(signal: Signal) -> Signal:
        """Whitening and (1 - m) of a signal; m itself is `vrft`'s own filter, or the next lines' here."""
        column = lfilter(taps, [1.0], signal[:, None], axis=0)
        rest: Signal = column - model.response(column)
        return rest

    if external is not None:
        estimate = vrft(
            shaped(u),
            shaped(y),
            shaped(external),
            [model],
            terms,
            window=window,
            derivative_cutoff_hz=derivative_cutoff_hz,
            weight="identity",
        )
        return LoopController(estimate.gains, model.Ts, derivative_cutoff_hz)

    drop = 2 * model.settling_samples() + WHITENING_ORDER
    if len(u) < 4 * drop:
        raise TuningError(f"too short: got {len(u)} samples, expected at least {4 * drop} for this reference model")
    letters = "".join(term for term in "PID" if term in terms)

    def regressor(output: Signal) -> Signal:
        virtual = shaped(output)
        filtered = model.response(virtual)
        x = regressors(letters, virtual - filtered, filtered, virtual, model.Ts, derivative_cutoff_hz)[drop:]
        rest: Signal = x - x.mean(axis=0)
        return rest

    x = regressor(y)
    zeta = x if repeated is None else regressor(repeated)
    u_l = model.response(shaped(u))[drop:, 0]
    moment = zeta.T @ x
    size = np.sqrt(np.diag(zeta.T @ zeta))[:, None] * np.sqrt(np.diag(x.T @ x))
    if not np.all(size > 0) or np.linalg.cond(moment / size) > 1e12:
        raise TuningError("not excited: the output's regressors do not move independently")
    b = np.linalg.solve(moment, zeta.T @ (u_l - u_l.mean()))
    gains = {term: np.array([[value]]) for term, value in zip(letters, b, strict=True)}
    return LoopController(gains, model.Ts, derivative_cutoff_hz)
