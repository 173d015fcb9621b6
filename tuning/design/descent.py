"""Gains of least cost within constraints: a sequence of convex problems.

Each step minimises the Gauss-Newton model of the cost within the convex constraints around the present gains. It is
taken if the cost plus the weighted violation falls, else the next is shorter. The convex constraints are inner
approximations: from gains that keep their margins, a step keeps them.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from mimopilot.tuning.analysis.closed_loop import slow_growth
from mimopilot.tuning.analysis.manoeuvres import Manoeuvres
from mimopilot.tuning.design.conic_problem import ConicProblem
from mimopilot.tuning.design.constraints import Constraint
from mimopilot.tuning.design.free_gains import FreeGains
from mimopilot.tuning.design.loop_gradient import LoopGradient
from mimopilot.tuning.plant.wide_response import WideResponse
from mimopilot.tuning.statespace import StateSpace

#: Weight of the relative violations in the merit: above the constraints' multipliers, which are about the cost, 0.01.
PENALTY = 1.0
#: Radius of the first step and the largest, and the factors after a good and after a bad step. The unit of the vector
#: is a typical gain.
FIRST_RADIUS, LARGEST_RADIUS, GROWTH, CUT = 0.5, 1.0, 1.5, 0.3
#: The descent ends with a step that lowers the merit by less than this share of the cost, at a radius below the second,
#: or after so many steps.
ENOUGH, SHORTEST, MAX_STEPS = 1e-3, 1e-3, 60
#: A larger relative violation is infeasible.
INFEASIBLE = 5e-3
#: Weight of the other axis' error over that of the own one: decoupling costs little tracking accuracy.
OTHER_AXIS = 2.0
#: Weight of the coupling that gains add through the rigid body, over that of a relative error of following: two
#: integral gains of opposite sign that cancel in every manoeuvre would otherwise be left to noise.
COUPLING = 0.1

Complex = NDArray[np.complex128]
Signal = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class PlantTask:
    """What is asked of the loop around one plant."""

    plant: WideResponse
    manoeuvres: Manoeuvres
    constraints: Sequence[Constraint]

    @cached_property
    def rigid(self) -> StateSpace:
        """The fitted rigid body, from torque to body rates."""
        return self.plant.body.model(self.plant.Ts)


@dataclass(frozen=True, eq=False)
class DesignTask:
    """Cost and constraints: the cost is the mean over the plants, the constraints hold for each.

    Attributes
    ----------
    free : FreeGains
    plants : sequence of PlantTask
    """

    free: FreeGains
    plants: Sequence[PlantTask]

    def loops(self, vector: Signal) -> list[LoopGradient]:
        """The loop around each plant."""
        return [LoopGradient(task.plant, self.free, vector) for task in self.plants]

    def cost(self, vector: Signal) -> float:
        """Mean relative energy of the errors."""
        return self._cost(self.loops(vector))

    def violation(self, vector: Signal) -> float:
        """Sum of the relative violations of all constraints; 0: none."""
        return self._violation(self.loops(vector))

    def merit(self, vector: Signal) -> float:
        """Cost plus weighted violation; infinite if a loop grows slowly below the band, where no constraint sees it."""
        gains = self.free.gains(vector)
        for task in self.plants:
            begin = float(task.plant.omega[task.plant.band.start])
            if slow_growth(gains, task.rigid, begin) is not None:
                return np.inf
        loops = self.loops(vector)
        found = self._cost(loops) + PENALTY * self._violation(loops)
        return found if np.isfinite(found) else np.inf

    def active(self, vector: Signal, within: float) -> list[str]:
        """Names of the constraints whose margin is below `within`, the tightest first."""
        margins = [
            (constraint.margin(loop), constraint.name)
            for loop, task in zip(self.loops(vector), self.plants, strict=True)
            for constraint in task.constraints
        ]
        return list(dict.fromkeys(name for margin, name in sorted(margins) if margin < within))

    def step(self, vector: Signal, radius: float) -> Signal:
        """The best step within the convex constraints, none of its elements above `radius`."""
        problem = ConicProblem(len(vector))
        gradient, curvature = np.zeros(len(vector)), np.zeros((len(vector), len(vector)))
        for loop, task in zip(self.loops(vector), self.plants, strict=True):
            rows = COUPLING * self.free.coupling(loop.plant.body.B)
            gradient += 2 * rows.T @ rows @ vector / len(self.plants)
            curvature += 2 * rows.T @ rows / len(self.plants)
            for errors, slopes in _errors(loop, task.manoeuvres, derivative=True):
                gradient += 2 * np.real(slopes.conj() @ errors) / len(self.plants)
                curvature += 2 * np.real(slopes.conj() @ slopes.T) / len(self.plants)
            for constraint in task.constraints:
                constraint.add(problem, loop)
        return problem.solve(gradient, curvature, PENALTY, radius)

    def _cost(self, loops: Sequence[LoopGradient]) -> float:
        energies = [
            float(np.sum(np.abs(errors) ** 2))
            for loop, task in zip(loops, self.plants, strict=True)
            for errors in (
                *(errors for errors, _ in _errors(loop, task.manoeuvres)),
                COUPLING * self.free.coupling(loop.plant.body.B) @ loop.vector,
            )
        ]
        return sum(energies) / len(self.plants)

    def _violation(self, loops: Sequence[LoopGradient]) -> float:
        return sum(
            max(0.0, -constraint.margin(loop))
            for loop, task in zip(loops, self.plants, strict=True)
            for constraint in task.constraints
        )


def _errors(loop: LoopGradient, task: Manoeuvres, derivative: bool = False) -> Iterator[tuple[Complex, Complex]]:
    """Weighted errors whose squared sum is the cost, (m,), and their derivatives (n, m).

    Of following, after the step of torque, and after the offset of an angle.
    """
    eye = np.eye(loop.plant.axes)
    own_and_other = np.where(eye, 1.0, OTHER_AXIS)
    following = np.sqrt(task.following)[:, None, None] * own_and_other
    disturbance = np.sqrt(task.disturbance)[:, None, :]
    none, count = np.empty((0, 0), complex), len(loop.vector)
    error = loop.T - task.target[:, None, None] * eye
    yield (following * error).ravel(), (following * loop.dT.whole()).reshape(count, -1) if derivative else none
    yield (disturbance * loop.D).ravel(), (disturbance * loop.dD.whole()).reshape(count, -1) if derivative else none
    if task.offset.any():
        left = np.sqrt(task.returning)[:, None, None]
        yield (left * (eye - loop.T_y)).ravel(), -(left * loop.dT_y.whole()).reshape(count, -1) if derivative else none


def descend(task: DesignTask, vector: Signal, enough: float = ENOUGH) -> Signal:
    """Gains of a local minimum near `vector`, which need not keep the constraints.

    Parameters
    ----------
    task : DesignTask
    vector : (n,) array
    enough : float
        The descent ends with a step that lowers the merit by less than this share of it.
    """
    radius, merit = FIRST_RADIUS, task.merit(vector)
    for _ in range(MAX_STEPS):
        move = task.step(vector, radius)
        after = task.merit(vector + move)
        if after < merit:
            gained = merit - after
            vector, merit, radius = vector + move, after, min(GROWTH * radius, LARGEST_RADIUS)
            if gained < enough * merit:
                break
        else:
            radius = CUT * min(radius, float(np.abs(move).max()))
            if radius < SHORTEST:
                break
    return vector
