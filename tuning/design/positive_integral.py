"""Integral gains constrained to be positive through the plant, in every direction.

Short logs, noise and gusts leave the integral gains uncertain. VRFT may then find negative ones, and the loop diverges
slowly. They are replaced by the nearest gains, in the metric of their covariance, whose integral action through the
measured plant is positive. The other gains change by their correlation with the integral ones.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag
from scipy.optimize import nnls

from mimopilot.tuning.errors import TuningError
from mimopilot.tuning.estimation.instrumental_variables import Stretches
from mimopilot.tuning.estimation.vrft import LoopEstimate
from mimopilot.tuning.plant.rigid_body_fit import RigidBody

#: Smallest integral action over the smallest proportional one, 1/s: an offset decays within about ten seconds.
MIN_INTEGRAL_RATIO = 0.1
#: Most cutting planes, and the relative tolerance of the limit.
MAX_PLANES, TOLERANCE = 100, 1e-6

Matrix = NDArray[np.float64]


def with_positive_integral(
    loops: Sequence[LoopEstimate], stretches: Stretches, body: RigidBody
) -> tuple[list[LoopEstimate], list[str]]:
    """Rate-loop estimates whose integral gains are positive through the plant.

    Parameters
    ----------
    loops : sequence of LoopEstimate
        One for both axes, or one an axis.
    stretches : list of (axes, segments)
        The axes of each estimate.
    body : RigidBody
        Of the same experiment.

    Returns
    -------
    loops : list of LoopEstimate
    warnings : list of str
        One text for each estimate that was changed.

    Raises
    ------
    TuningError
        When the proportional gains are not positive through the plant.
    """
    found, warnings = [], []
    for (axes, _), loop in zip(stretches, loops, strict=True):
        B = body.B[axes, axes]
        floor = MIN_INTEGRAL_RATIO * _least(B @ loop.gain("P"))
        if floor <= 0:
            raise TuningError(
                "the proportional gains from VRFT are not positive through the measured plant: the log is too short or "
                "too noisy for this rate loop; record longer, or excite more strongly"
            )
        if "I" in loop.gains and _least(B @ loop.gains["I"]) < floor:
            before = loop.gains["I"]
            loop = _with_integral(loop, _nearest(loop, B, floor))
            old, new = (", ".join(f"{v:.3g}" for v in matrix.ravel()) for matrix in (before, loop.gains["I"]))
            warnings.append(
                f"the integral gains from this log diverge ({old}): replaced by the nearest that do not ({new}); "
                "record longer or excite lower frequencies to measure them"
            )
        found.append(loop)
    return found, warnings


def _least(action: Matrix) -> float:
    """Smallest eigenvalue of the symmetric part."""
    return float(np.linalg.eigvalsh((action + action.T) / 2)[0])


def _columns(loop: LoopEstimate) -> slice:
    """Columns of the integral gains among the coefficients."""
    n, place = len(loop.gains["I"][0]), list(loop.gains).index("I")
    return slice(n * place, n * (place + 1))


def _nearest(loop: LoopEstimate, B: Matrix, floor: float) -> Matrix:
    """The integral gains nearest to those estimated whose action is at least `floor` in every direction.

    By cutting planes: the direction v with the smallest action gives the plane v' B Ki v >= floor. The nearest point
    within all planes is a least distance problem (C. L. Lawson, R. J. Hanson, Solving Least Squares Problems,
    chapter 23).
    """
    Ki, columns = loop.gains["I"], _columns(loop)
    blocks = [np.linalg.cholesky(C[columns, columns]) for C in loop.solution.covariance]
    root = block_diag(*blocks)  # Ki = estimate + root x has the metric of x
    found, planes, limits = Ki, np.empty((0, Ki.size)), np.empty(0)
    for _ in range(MAX_PLANES):
        values, vectors = np.linalg.eigh((B @ found + found.T @ B.T) / 2)
        if values[0] >= floor * (1 - TOLERANCE):
            break
        plane = np.outer(B.T @ vectors[:, 0], vectors[:, 0]).ravel()
        planes, limits = np.vstack([planes, plane @ root]), np.append(limits, floor - plane @ Ki.ravel())
        size = np.linalg.norm(planes, axis=1)
        system = np.vstack([(planes / size[:, None]).T, limits / size])
        weights, _ = nnls(system, np.append(np.zeros(Ki.size), 1.0))
        left = system @ weights - np.append(np.zeros(Ki.size), 1.0)
        found = Ki + (root @ (-left[:-1] / left[-1])).reshape(Ki.shape)
    return found


def _with_integral(loop: LoopEstimate, Ki: Matrix) -> LoopEstimate:
    """The estimate with these integral gains, and the most likely values of the others given them."""
    columns, coefficients = _columns(loop), loop.solution.B.copy()
    for row, C, wanted in zip(coefficients, loop.solution.covariance, Ki, strict=True):
        row += C[:, columns] @ np.linalg.pinv(C[columns, columns], hermitian=True) @ (wanted - row[columns])
        row[columns] = wanted
    n = len(Ki[0])
    gains = {term: coefficients[:, i * n : (i + 1) * n] for i, term in enumerate(loop.gains)}
    return replace(loop, gains=gains, solution=replace(loop.solution, B=coefficients))
