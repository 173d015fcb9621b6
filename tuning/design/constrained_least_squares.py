"""Least squares with inequality constraints, by the augmented Lagrangian."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

# All numbers are relative, and chosen by trial on the simulated airframes.
#: A round ends when a step lowers the cost by less than this share.
TOLERANCE = 1e-6
#: Most evaluations of the residuals in a round.
MAX_EVALUATIONS = 60
#: Penalty weight on squared constraint violation, where the cost begins at 1.
PENALTY = 100.0
#: The weight is multiplied by this after a round that leaves more than `ENOUGH` of the violation.
PENALTY_GROWTH = 4.0
ENOUGH = 0.3
MAX_ROUNDS = 12
#: The iteration ends when no constraint is violated by more than this.
CONSTRAINT_TOLERANCE = 1e-4
#: A result that violates a constraint by more than this is infeasible.
INFEASIBLE = 2e-3

Signal = NDArray[np.float64]
Examine = Callable[[Signal], tuple[Signal, Signal]]


def constrained_least_squares(examine: Examine, first: Signal, step: float) -> tuple[Signal, float]:
    """Point near a first one with the least sum of squared residuals within the constraints.

    The augmented Lagrangian of Hestenes, Powell and Rockafellar: a violated constraint is one more residual, shifted by
    its multiplier from round to round until the constraint holds. Within a round scipy's trust region takes
    Gauss-Newton steps.

    Parameters
    ----------
    examine : callable
        Points (B, n) -> residuals (B, R) and the remaining margin of each constraint (B, m): negative is a violation.
    first : (n,) array
        Where to begin, every number of about the size 1. It may violate the constraints.
    step : float
        Step of the finite differences.

    Returns
    -------
    point : (n,) array
    cost : float
        Its sum of squares; infinite when a constraint is violated.
    """
    residuals, left = examine(first[None])
    unit, multipliers, penalty, before = float(np.linalg.norm(residuals)), np.zeros(left.shape[1]), PENALTY, np.inf

    def values(points: Signal) -> Signal:
        residuals, left = examine(points)
        violated = np.sqrt(penalty) * np.maximum(multipliers / penalty - left, 0.0)
        every: Signal = np.nan_to_num(np.hstack([residuals / unit, violated]), nan=1e3, posinf=1e3, neginf=-1e3)
        return every

    def slopes(point: Signal) -> Signal:
        around = values(np.vstack([point, point + step * np.eye(len(point))]))
        jacobian: Signal = (around[1:] - around[0]).T / step
        return jacobian

    point = first
    for _ in range(MAX_ROUNDS):
        found = least_squares(
            lambda point: values(point[None])[0],
            point,
            jac=slopes,
            x_scale="jac",
            ftol=TOLERANCE,
            xtol=TOLERANCE,
            gtol=None,
            max_nfev=MAX_EVALUATIONS,
        )
        point = found.x
        residuals, left = examine(point[None])
        violation = float(np.abs(np.minimum(left[0], multipliers / penalty)).max())
        if violation < CONSTRAINT_TOLERANCE:
            break
        multipliers = np.maximum(multipliers - penalty * left[0], 0.0)
        penalty, before = penalty * (PENALTY_GROWTH if violation > ENOUGH * before else 1.0), violation
    return point, float(np.sum(residuals**2)) if left.min() > -INFEASIBLE else np.inf
