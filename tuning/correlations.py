"""Cross-correlations at many lags by FFT: what the instruments of VRFT reduce to."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.fft import irfft, next_fast_len, rfft


def cross_correlation(w: NDArray[np.float64], x: NDArray[np.float64], lags: int) -> NDArray[np.float64]:
    """Sums over k of w(k + tau) x(k)' for tau = -lags..lags; samples beyond the ends count as zero.

    These are S and Q of (3.28)-(3.31) for the instrument zeta(k) = [w(k-l); ...; w(k+l)], without ever
    forming zeta: O(N log N).

    Parameters
    ----------
    w : (N, n_w) array
        Instrument.
    x : (N, n_x) array
        Regressors, or controlled inputs.
    lags : int, samples
        l.

    Returns
    -------
    (2 lags + 1, n_w, n_x) array
        In the product of the units of `w` and `x`.
    """
    size = next_fast_len(len(w) + lags, real=True)
    W, X = rfft(w, size, axis=0), rfft(x, size, axis=0)
    full = irfft(W[:, :, None] * X.conj()[:, None, :], size, axis=0)
    lagged: NDArray[np.float64] = np.concatenate([full[size - lags :], full[: lags + 1]])
    return lagged


def autocorrelation(w: NDArray[np.float64], lags: int) -> NDArray[np.float64]:
    """`cross_correlation` of a signal with itself."""
    return cross_correlation(w, w, lags)
