"""A convex problem in second-order cones around one point, solved by Clarabel (P. Goulart, Y. Chen, 2024)."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

#: Weight of the squared step in the cost: keeps the problem definite where the data do not determine a gain.
REGULARISATION = 1e-9
#: Relative accuracy of a step: the next one corrects it.
TOLERANCE = 1e-6

Complex = NDArray[np.complex128]
Signal = NDArray[np.float64]


class ConicProblem:
    """Least g'd + d'Hd/2 + penalty sum(t) over a step d and relaxations t >= 0, within cones.

    Every constraint is linear in d and scaled so that 1 is its typical size. Each has its own relaxation, so the
    problem always has a solution.

    Parameters
    ----------
    size : int
        Length n of the step.
    """

    def __init__(self, size: int) -> None:
        self.size = size
        self._linear: list[tuple[Signal, Signal]] = []
        self._cones: list[tuple[Signal, Signal]] = []

    def above(self, slope: Signal, value: Signal) -> None:
        """Require value + slope d + t >= 0: slope (m, n), value (m,)."""
        self._linear.append((slope, value))

    def cone(self, slope: Signal, value: Signal) -> None:
        """Require v_0 + t >= |(v_1, ... v_k-1)|, v = value + slope d, of m cones: slope (m, k, n), value (m, k)."""
        self._cones.append((slope, value))

    def below_one(self, slope: Complex, value: Complex) -> None:
        """Require |value + slope d| <= 1 + t of one long vector: slope (n, M), value (M,)."""
        n, whole = self.size, np.vstack([slope, value])
        # The square as that of a vector of n + 1 numbers.
        sizes, directions = np.linalg.eigh(np.real(whole.conj() @ whole.T))
        root = (np.sqrt(np.maximum(sizes, 0.0)) * directions).T
        self.cone(np.vstack([np.zeros(n), root[:, :n]])[None], np.append(1.0, root[:, n])[None])

    def solve(self, gradient: Signal, curvature: Signal, penalty: float, radius: float) -> Signal:
        """The best step with no element above `radius`, (n,)."""
        import clarabel  # the solver and scipy.sparse: only those who design need them
        from scipy import sparse

        n, relaxations = self.size, len(self._linear) + len(self._cones)
        whole = n + relaxations
        box = np.eye(whole)
        rows, bounds = [box[:n], -box], [np.full(2 * n, radius), np.zeros(relaxations)]
        for place, (slope, value) in enumerate(self._linear):
            row = np.zeros((len(slope), whole))
            row[:, :n], row[:, n + place] = -slope, -1.0
            rows.append(row)
            bounds.append(value)
        cones: list[Any] = [clarabel.NonnegativeConeT(sum(len(bound) for bound in bounds))]
        for place, (slope, value) in enumerate(self._cones, n + len(self._linear)):
            count, length, _ = slope.shape
            row = np.zeros((count, length, whole))
            row[:, :, :n], row[:, 0, place] = -slope, -1.0
            rows.append(row.reshape(count * length, whole))
            bounds.append(value.ravel())
            cones += [clarabel.SecondOrderConeT(length)] * count
        quadratic = np.zeros((whole, whole))
        quadratic[:n, :n] = curvature + REGULARISATION * np.eye(n)
        settings = clarabel.DefaultSettings()
        settings.verbose = False
        settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = TOLERANCE
        found = clarabel.DefaultSolver(
            sparse.csc_matrix(np.triu(quadratic)),
            np.append(gradient, np.full(relaxations, penalty)),
            sparse.csc_matrix(np.vstack(rows)),
            np.concatenate(bounds),
            cones,
            settings,
        ).solve()
        return np.array(found.x)[:n]
