"""Several gain sets of one vehicle in arrays, to evaluate hundreds at once."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mimopilot.tuning.gains import Gains
from mimopilot.tuning.law import ATTITUDE, LOOP_TERMS, Filters
from mimopilot.tuning.parameters import MATRICES

Signal = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class GainStack:
    """Matrices of K gain sets, shaped to broadcast against frequencies.

    Attributes
    ----------
    Kp_o, Kp_i, Ki_i, Kd_i, Kff_i, Kff_o, Kaff_i : (K, 1, 2, 2) arrays
        As in `tuning.gains.Gains`.
    limits : (3, 2) array
        Of rates (rad/s), torque and integral, the same for all.
    filters : Filters
        Period and filters, the same for all.
    """

    Kp_o: Signal
    Kp_i: Signal
    Ki_i: Signal
    Kd_i: Signal
    Kff_i: Signal
    Kff_o: Signal
    Kaff_i: Signal
    limits: Signal
    filters: Filters

    @property
    def Ts(self) -> float:  # noqa: N802
        """Control period, s."""
        return self.filters.Ts

    @classmethod
    def of(cls, gains: Gains) -> GainStack:
        """A stack of one set."""
        limits = np.array([gains.limits.rate_max[:2], gains.limits.moment_max[:2], gains.limits.integral_max[:2]])
        matrices = {name: getattr(gains, name)[None, None] for name in MATRICES}
        return cls(**matrices, limits=limits, filters=gains.filters)

    def varied(self, matrices: Mapping[str, Signal]) -> GainStack:
        """K copies of the first set with some of its matrices replaced, (K, 2, 2) each."""
        count = len(next(iter(matrices.values())))
        every = {name: np.broadcast_to(getattr(self, name)[:1], (count, 1, 2, 2)) for name in MATRICES}
        every |= {name: matrix[:, None] for name, matrix in matrices.items()}
        return GainStack(**every, limits=self.limits, filters=self.filters)

    def stacked(self) -> Signal:
        """The attitude controller's matrix and those of `tuning.law.LOOP_TERMS` in one array, (K, 5, 2, 2)."""
        names = (ATTITUDE.matrix, *(term.matrix for term in LOOP_TERMS.values()))
        return np.concatenate([getattr(self, name) for name in names], axis=1)
