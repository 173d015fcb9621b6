"""Sequential quadratic programming with differences: how gains are refined within limits."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

ITERATIONS = 60
#: A descent ends where one step gains less than this share of the cost that it began with.
TOLERANCE = 1e-6
#: It begins again from its end, its picture of the curvature forgotten, while that gains this share.
WORTH = 0.02

Signal = NDArray[np.float64]


def descend(
    examine: Callable[[Signal], tuple[Signal, Signal]], first: Signal, step: float, again: int = 0
) -> tuple[Signal, float]:
    """The point of least cost within the limits, near a first one.

    Parameters
    ----------
    examine : callable
        Points (B, n) -> cost (B,) and what is left of every limit (B, m): negative is too much.
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
        Its cost, in the unit of `examine`.
    """
    point, cost = _descent(examine, first, step)
    for _ in range(again):
        following, lower = _descent(examine, point, step)
        if not lower < (1 - WORTH) * cost:
            break
        point, cost = following, lower
    return point, cost


def _descent(examine: Callable[[Signal], tuple[Signal, Signal]], first: Signal, step: float) -> tuple[Signal, float]:
    @lru_cache(maxsize=8)
    def around(point: bytes) -> tuple[float, Signal, Signal, Signal]:
        values = np.frombuffer(point)
        cost, left = examine(np.vstack([values, values + step * np.eye(len(values))]))
        cost = np.nan_to_num(cost, nan=1e6, posinf=1e6) / unit
        left = np.nan_to_num(left, nan=-1e6, neginf=-1e6)
        return float(cost[0]), (cost[1:] - cost[0]) / step, left[0], ((left[1:] - left[0]) / step).T

    unit = 1.0
    unit = around(first.tobytes())[0]
    around.cache_clear()
    found = minimize(
        lambda values: around(values.tobytes())[0],
        first,
        jac=lambda values: around(values.tobytes())[1],
        method="SLSQP",
        constraints={
            "type": "ineq",
            "fun": lambda values: around(values.tobytes())[2],
            "jac": lambda values: around(values.tobytes())[3],
        },
        options={"maxiter": ITERATIONS, "ftol": TOLERANCE},
    )
    return found.x, float(found.fun) * unit
