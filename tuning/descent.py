"""Least squares within limits by sequential quadratic programming with differences: how gains are refined."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cholesky, solve_triangular
from scipy.optimize import minimize

ITERATIONS = 60
#: A descent ends where one step gains less than this share of the cost that it began with.
TOLERANCE = 1e-7
#: It begins again from its end, its picture of the curvature forgotten, while that gains this share.
WORTH = 0.02
#: Curvature that a direction is taken to have at least, beside the cost at the start.
FLAT = 0.01

Signal = NDArray[np.float64]
#: Points (B, n) -> residuals (B, R) and what is left of every limit (B, m): negative is too much.
Examine = Callable[[Signal], tuple[Signal, Signal]]


def descend(examine: Examine, first: Signal, step: float, again: int = 0) -> tuple[Signal, float]:
    """The point with the least sum of squared residuals within the limits, near a first one.

    The unknowns are turned and stretched so that the sum looks round where the descent begins (Gauss and Newton's
    curvature is then the identity, which the method starts from): gains act on a flight with very unequal strength.

    Parameters
    ----------
    examine : callable
        Points (B, n) -> residuals (B, R) and what is left of every limit (B, m): negative is too much.
    first : (n,) array
        Where to begin; every number of about the size 1.
    step : float
        Of the differences.
    again : int
        How often it may begin again from its end, at most.

    Returns
    -------
    point : (n,) array
    cost : float
        Its sum of squares.
    """
    point, cost = _descent(examine, first, step)
    for _ in range(again):
        following, lower = _descent(examine, point, step)
        if not lower < (1 - WORTH) * cost:
            break
        point, cost = following, lower
    return point, cost


def _descent(examine: Examine, first: Signal, step: float) -> tuple[Signal, float]:
    size = len(first)

    def differ(point: Signal) -> tuple[Signal, Signal, Signal, Signal]:
        """Residuals and limits there, each with its Jacobian."""
        residuals, left = examine(np.vstack([point, point + step * np.eye(size)]))
        residuals = np.nan_to_num(residuals, nan=1e3, posinf=1e3, neginf=-1e3)
        left = np.nan_to_num(left, nan=-1e6, neginf=-1e6)
        return residuals[0], (residuals[1:] - residuals[0]).T / step, left[0], (left[1:] - left[0]).T / step

    residuals, slopes, _, _ = differ(first)
    unit = float(residuals @ residuals)
    round_here = solve_triangular(cholesky(2 / unit * slopes.T @ slopes + FLAT * np.eye(size)), np.eye(size))

    @lru_cache(maxsize=8)
    def around(turned: bytes) -> tuple[float, Signal, Signal, Signal]:
        residuals, slopes, left, left_slopes = differ(first + round_here @ np.frombuffer(turned))
        cost = float(residuals @ residuals) / unit
        return cost, 2 / unit * residuals @ slopes @ round_here, left, left_slopes @ round_here

    found = minimize(
        lambda turned: around(turned.tobytes())[0],
        np.zeros(size),
        jac=lambda turned: around(turned.tobytes())[1],
        method="SLSQP",
        constraints={
            "type": "ineq",
            "fun": lambda turned: around(turned.tobytes())[2],
            "jac": lambda turned: around(turned.tobytes())[3],
        },
        options={"maxiter": ITERATIONS, "ftol": TOLERANCE},
    )
    return first + round_here @ found.x, float(found.fun) * unit
