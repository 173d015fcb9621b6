"""Cross-correlations at many lags by FFT: all that VRFT needs of its instruments."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.fft import irfft, next_fast_len, rfft

#: Smallest transform, samples: blocks of this order fit into the processor's cache.
BLOCK = 4096


def cross_correlation(w: NDArray[np.float64], x: NDArray[np.float64], lags: int) -> NDArray[np.float64]:
    """Sums over k of w(k + tau) x(k)' for tau = -lags..lags; samples beyond the ends count as zero.

    These are S and Q of (3.28)-(3.31) for the instrument zeta(k) = [w(k-l); ...; w(k+l)], without forming zeta. Each
    block of x is correlated with its stretch of w, which is longer by the lags on both sides. The products of their
    transforms are summed, so time is linear in N and memory is constant.

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
    size = next_fast_len(min(max(BLOCK, 8 * lags), len(w) + 2 * lags), real=True)
    step = size - 2 * lags
    padded = np.zeros((w.shape[1], size))
    total = np.zeros((size // 2 + 1, w.shape[1], x.shape[1]), complex)
    for start in range(0, len(x), step):
        low, high = max(start - lags, 0), min(start + step + lags, len(w))
        offset = low - (start - lags)
        padded[:, :offset] = 0.0
        padded[:, offset : offset + high - low] = w[low:high].T
        padded[:, offset + high - low :] = 0.0
        W, X = rfft(padded), rfft(np.ascontiguousarray(x[start : start + step].T), size)
        total += W.T[:, :, None] * X.conj().T[:, None, :]
    lagged: NDArray[np.float64] = irfft(total, size, axis=0)[: 2 * lags + 1]
    return lagged


def autocorrelation(w: NDArray[np.float64], lags: int) -> NDArray[np.float64]:
    """`cross_correlation` of a signal with itself."""
    return cross_correlation(w, w, lags)
