"""The limit on what a step of torque does to the angles, relative to the flown gains."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mimopilot.tuning.design.conic_problem import ConicProblem
from mimopilot.tuning.design.constraints import Constraint
from mimopilot.tuning.design.loop_gradient import LoopGradient

#: Room above what the step of torque does under the flown gains. Chosen: less than a pilot feels.
ROOM = 1.1
#: Flown gains that violate a constraint by more than this do not limit a design. Chosen: as much as the room.
NEARLY_KEPT = -0.1

Signal = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class DisturbanceLimit:
    """The angles after a step of torque on each axis stay below a limit.

    Attributes
    ----------
    step : (K, n) array, s
        Weights of the step, see `tuning.analysis.manoeuvres.Manoeuvres`.
    limit : (n,) array, rad sqrt(s)
        Root of the energy of the angles.
    """

    step: Signal
    limit: Signal
    name: str = "angles after a step of torque"

    def margin(self, loop: LoopGradient) -> float:
        """See `Constraint`."""
        return float(1 - np.max(after_step(loop, self.step) / self.limit))

    def add(self, problem: ConicProblem, loop: LoopGradient) -> None:
        """See `Constraint`."""
        d = loop.dD
        for axis, limit in enumerate(self.limit):
            weight = np.sqrt(self.step[:, axis, None]) / limit
            value = (weight * loop.D[:, :, axis]).ravel()
            slopes = (weight[:, None] * d.left * d.right[:, :, axis, None]).transpose(1, 0, 2)
            problem.below_one(slopes.reshape(problem.size, -1), value)


def after_step(loop: LoopGradient, step: Signal) -> Signal:
    """Root of the energy of the angles after the step of torque on each axis, (n,), rad sqrt(s)."""
    energy: Signal = np.einsum("ki,kji->i", step, np.abs(loop.D) ** 2)
    return np.sqrt(energy)


def no_softer_than(flown: LoopGradient, step: Signal, kept: Sequence[Constraint]) -> list[DisturbanceLimit]:
    """The limit that flown gains set, if they nearly keep all other constraints; else none."""
    if min(one.margin(flown) for one in kept) < NEARLY_KEPT:
        return []
    return [DisturbanceLimit(step, ROOM * after_step(flown, step))]
