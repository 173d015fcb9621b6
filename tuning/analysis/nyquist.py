"""Nyquist's count: how often det(n (I + L)) encircles 0, for the rate loop and for the whole cascade."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from mimopilot.tuning.analysis.closed_loop import CascadeLoop
from mimopilot.tuning.reference_model import ReferenceModel

#: Frequencies between the band's beginning and Nyquist at which the phase of n is followed: it turns by a few degrees
#: from one to the next.
PHASE_POINTS = 4000

Complex = NDArray[np.complex128]
Signal = NDArray[np.float64]


class NyquistCount:
    """Encirclements of 0 by det(n (I + L)) for loops that are known on one frequency grid.

    n is a product of 1 - m, one reference model m for each integrator of the loop: for the rate controller on axes
    with an integral gain, and for the angles. Its zeros at z = 1 cancel the loop's poles there.

    Parameters
    ----------
    inner, outer : sequence of n ReferenceModel
        Of the rate and the attitude loop.
    omega : (K,) array, rad/s
        Frequencies of the loops.
    Ki_i : (n, n) array
        Integral gains of the rate controller.
    """

    def __init__(
        self,
        inner: Sequence[ReferenceModel],
        outer: Sequence[ReferenceModel],
        omega: Signal,
        Ki_i: Signal,
    ) -> None:
        # n is a product of scalars 1 - m: its phase is followed on a fine grid up to Nyquist, once.
        fine = np.linspace(omega[0], np.pi / inner[0].Ts, PHASE_POINTS)

        def ones_minus(models: Sequence[ReferenceModel], at: Signal) -> Complex:
            responses = [1 - model.frequency_response(at) for model in models]
            return np.stack([np.ones(len(at), complex), *responses], axis=1)

        inner = [model for model, row in zip(inner, Ki_i, strict=True) if np.any(row)]
        self.n_i = np.prod(ones_minus(inner, omega), axis=1)
        self.n_o = self.n_i * np.prod(ones_minus(outer, omega), axis=1)
        tail_i = np.prod(ones_minus(inner, fine), axis=1)
        tail_o = tail_i * np.prod(ones_minus(outer, fine), axis=1)
        last = np.searchsorted(fine, omega[-1])
        self.after = [float(_phase_change(tail[last:])) for tail in (tail_i, tail_o)]

    def encirclements(self, loop: CascadeLoop) -> tuple[int, int]:
        """Encirclements of 0: rate loop, whole cascade."""
        identity = np.eye(loop.L_i.shape[-1])
        counts = []
        for n, L, after in ((self.n_i, loop.L_i, self.after[0]), (self.n_o, loop.L_u, self.after[1])):
            f = n * np.linalg.det(identity + L)
            # Below the band f goes to a positive number; above it I + L goes to I, by the shortest way.
            closing = -float(np.angle(np.linalg.det(identity + L[-1]))) + after
            total = float(np.angle(f[0])) + float(_phase_change(f)) + closing
            counts.append(round(total / np.pi))
        return counts[0], counts[1]


def _phase_change(f: Complex) -> float:
    """Change of phase along a curve, rad."""
    return float(np.sum(np.angle(f[1:] / f[:-1])))
