"""Least squares within limits: how gains are refined."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

#: A round ends where a step gains less than this share of the cost, or after so many points.
TOLERANCE, POINTS = 1e-6, 60
#: Squares of what a limit is missed by count so often, beside a cost that begins at 1; so much more often from a round
#: on that does not bring what is missed down to a share.
STIFFNESS, STIFFER, SHARE = 100.0, 4.0, 0.3
#: Rounds, at most; how closely the limits are met where they end; more than the last is too much, all relative.
ROUNDS, MET, MISSED = 12, 1e-4, 2e-3

Signal = NDArray[np.float64]
Examine = Callable[[Signal], tuple[Signal, Signal]]


def descend(examine: Examine, first: Signal, step: float) -> tuple[Signal, float]:
    """The point with the least sum of squared residuals within the limits, near a first one.

    Limits are residuals, too, as far as they are missed, each shifted by its price from round to round until it is met
    (the augmented Lagrangian of Hestenes, Powell and Rockafellar); within a round scipy's trust region goes by Gauss
    and Newton's curvature.

    Parameters
    ----------
    examine : callable
        Points (B, n) -> residuals (B, R) and what is left of every limit (B, m): negative is too much.
    first : (n,) array
        Where to begin; every number of about the size 1. It need not keep the limits.
    step : float
        Of the differences.

    Returns
    -------
    point : (n,) array
    cost : float
        Its sum of squares; infinite where a limit is missed.
    """
    residuals, left = examine(first[None])
    unit, prices, stiffness, before = float(np.linalg.norm(residuals)), np.zeros(left.shape[1]), STIFFNESS, np.inf

    def values(points: Signal) -> Signal:
        residuals, left = examine(points)
        missed = np.sqrt(stiffness) * np.maximum(prices / stiffness - left, 0.0)
        every: Signal = np.nan_to_num(np.hstack([residuals / unit, missed]), nan=1e3, posinf=1e3, neginf=-1e3)
        return every

    def slopes(point: Signal) -> Signal:
        around = values(np.vstack([point, point + step * np.eye(len(point))]))
        jacobian: Signal = (around[1:] - around[0]).T / step
        return jacobian

    point = first
    for _ in range(ROUNDS):
        found = least_squares(
            lambda point: values(point[None])[0],
            point,
            jac=slopes,
            x_scale="jac",
            ftol=TOLERANCE,
            xtol=TOLERANCE,
            gtol=None,
            max_nfev=POINTS,
        )
        point = found.x
        residuals, left = examine(point[None])
        unmet = float(np.abs(np.minimum(left[0], prices / stiffness)).max())
        if unmet < MET:
            break
        prices = np.maximum(prices - stiffness * left[0], 0.0)
        stiffness, before = stiffness * (STIFFER if unmet > SHARE * before else 1.0), unmet
    return point, float(np.sum(residuals**2)) if left.min() > -MISSED else np.inf
