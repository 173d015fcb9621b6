"""95 % confidence intervals from repeated trials: of a success probability, of a quantile."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri
from scipy.stats import binom

#: Confidence level.
LEVEL = 0.95


def wilson(successes: int, trials: int) -> tuple[float, float]:
    """Wilson's score interval of a probability (Wilson 1927).

    Parameters
    ----------
    successes, trials : int
        k successes in n trials.

    Returns
    -------
    low, high : float
        0 and 1 without trials.

    Examples
    --------
    >>> [round(value, 4) for value in wilson(10, 10)]
    [0.7225, 1.0]
    """
    if trials == 0:
        return 0.0, 1.0
    z = float(ndtri(0.5 + LEVEL / 2))
    p, square = successes / trials, z * z / trials
    middle = (p + square / 2) / (1 + square)
    half = z / (1 + square) * float(np.sqrt(p * (1 - p) / trials + square / (4 * trials)))
    # At 0 or n successes the bound is exactly 0 or 1; rounding must not change it.
    return 0.0 if successes == 0 else middle - half, 1.0 if successes == trials else middle + half


def quantile(ordered: NDArray[np.float64], p: float) -> tuple[float, float, float]:
    """A quantile and its confidence interval between order statistics: exact for any distribution.

    Parameters
    ----------
    ordered : (n,) array
        Ascending; may end with infinity.
    p : float
        Between 0 and 1.

    Returns
    -------
    value, low, high : float
        Each one of the samples. NaN: an end for which there are too few samples, and all three without samples.
    """
    n = len(ordered)
    if n == 0:
        return np.nan, np.nan, np.nan
    value = ordered[min(int(np.ceil(p * n)), n) - 1] if p > 0 else ordered[0]
    low, high = (int(rank) for rank in binom.ppf([0.5 - LEVEL / 2, 0.5 + LEVEL / 2], n, p))
    ends = (float(ordered[rank]) if 0 <= rank < n else np.nan for rank in (low - 1, high))
    return float(value), *ends  # type: ignore[return-value]
