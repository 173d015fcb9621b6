"""What a design must not violate, as margins of a loop and as convex constraints on the next step.

A margin is relative: 0 at the limit, negative when violated. The distance of I + L from 0 is bounded by a convex inner
approximation (A. Karimi, G. Galdos, "Fixed-order H-infinity controller design for nonparametric models by convex
optimization", Automatica 46, 2010): P^H P >= P^H P_c + P_c^H P - P_c^H P_c, with P_c the present I + L. The right side
is linear in the gains. A 2x2 Hermitian matrix [[a, b], [b*, c]] is positive semidefinite where (a + c, a - c, 2 Re b,
2 Im b) is in a second-order cone.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from mimopilot.tuning.design.conic_problem import ConicProblem
from mimopilot.tuning.design.loop_gradient import LoopGradient, ProductGradient
from mimopilot.tuning.small_matrices import inverse, singular_values

#: Distance to its limit above which a frequency is left out of the next step: the step hardly reaches so far, and the
#: one after sees it.
NEAR = 0.2
#: Share of the certificate's limits that a design uses; the rest is for interpolation.
SHARE = 0.96

Complex = NDArray[np.complex128]
Signal = NDArray[np.float64]


class Constraint(Protocol):
    """One requirement on the loop."""

    @property
    def name(self) -> str:
        """What the requirement limits, for messages."""

    def margin(self, loop: LoopGradient) -> float:
        """Least relative margin; negative when violated."""

    def add(self, problem: ConicProblem, loop: LoopGradient) -> None:
        """Add it to the problem of the next step."""


class Cut(Enum):
    """Where a loop is cut."""

    TORQUE = "the whole loop, cut at the torques"
    RATE_LOOP = "the rate loop alone, cut at the torques"
    ATTITUDE = "the attitude loop, cut at the angles"


@dataclass(frozen=True)
class Distance:
    """I + L keeps a distance from 0: the largest singular value of the sensitivity is at most 1 / `floor`.

    Attributes
    ----------
    cut : Cut
    where : slice
        Frequencies.
    floor : float
        Least singular value of I + L, twice the standard error of the response included.
    """

    cut: Cut
    where: slice
    floor: float

    @property
    def name(self) -> str:
        """See `Constraint`."""
        return f"sensitivity of {self.cut.value}"

    def _loop(self, loop: LoopGradient) -> tuple[Complex, ProductGradient, Signal]:
        """I + L, its derivative, and the least distance at each frequency."""
        where, eye = self.where, np.eye(loop.plant.axes)
        if self.cut is Cut.ATTITUDE:
            S = eye - loop.T_y[where]
            P = inverse(S)
            return (
                P,
                ProductGradient(loop.dT_y.left[where] @ P.transpose(0, 2, 1), loop.dT_y.right[where] @ P),
                np.full(len(P), self.floor),
            )
        whole = self.cut is Cut.TORQUE
        L, dL = (loop.L_u, loop.dL_u) if whole else (loop.L_i, loop.dL_i)
        least = self.floor + loop.loop_error(whole)[where]
        return eye + L[where], ProductGradient(dL.left[where], dL.right[where]), least

    def margin(self, loop: LoopGradient) -> float:
        """See `Constraint`."""
        eye = np.eye(loop.plant.axes)
        if self.cut is Cut.ATTITUDE:
            return float(np.min(1 / singular_values(eye - loop.T_y[self.where])[0]) / self.floor - 1)
        whole = self.cut is Cut.TORQUE
        L = loop.L_u if whole else loop.L_i
        distance = singular_values(eye + L[self.where])[1] - loop.loop_error(whole)[self.where]
        return float(np.min(distance) / self.floor - 1)

    def add(self, problem: ConicProblem, loop: LoopGradient) -> None:
        """See `Constraint`."""
        P, dP, least = self._loop(loop)
        near = singular_values(P)[1] < least + NEAR
        P, least = P[near], least[near]
        Q = P.conj().transpose(0, 2, 1) @ P
        # d(P^H P_c + P_c^H P) = w r' + (w r')^H, with w = P_c^H left and r the row.
        w, r = dP.left[near] @ P.conj(), dP.right[near]
        scale = 1 / np.maximum(np.abs(Q).max(axis=(1, 2)), 1.0)
        if len(loop.plant.body.B) == 1:
            problem.above(2 * np.real(w[:, :, 0] * r[:, :, 0]) * scale[:, None], (Q[:, 0, 0].real - least**2) * scale)
            return
        d11, d22 = (2 * np.real(w[:, :, i] * r[:, :, i]) for i in range(2))
        d12 = w[:, :, 0] * r[:, :, 1] + np.conj(w[:, :, 1] * r[:, :, 0])
        slope = np.stack([d11 + d22, d11 - d22, 2 * d12.real, 2 * d12.imag], axis=1)
        a, b, c = Q[:, 0, 0].real, Q[:, 0, 1], Q[:, 1, 1].real
        value = np.stack([a + c - 2 * least**2, a - c, 2 * b.real, 2 * b.imag], axis=1)
        problem.cone(slope * scale[:, None, None], value * scale[:, None])


@dataclass(frozen=True, eq=False)
class NoiseLimit:
    """The torque that noise causes at hover stays below a limit on each axis.

    Attributes
    ----------
    limit : (n,) array
        RMS (normalised).
    above : float, rad/s
        Only the noise at higher frequencies counts.
    """

    limit: Signal
    above: float = 0.0
    name: str = "noise of the torque"

    def margin(self, loop: LoopGradient) -> float:
        """See `Constraint`."""
        return float(1 - np.max(loop.noise_rms(self.above) / self.limit))

    def add(self, problem: ConicProblem, loop: LoopGradient) -> None:
        """See `Constraint`."""
        weight = np.sqrt(np.where(loop.plant.omega > self.above, loop.plant.noise_weight, 0.0))[:, None]
        d = loop.dnoise
        for axis, limit in enumerate(self.limit):
            value = (weight * loop.noise[:, axis]).ravel() / limit
            slopes = (weight[:, None] * d.left[:, :, axis, None] * d.right).transpose(1, 0, 2) / limit
            problem.below_one(slopes.reshape(problem.size, -1), value)


@dataclass(frozen=True, eq=False)
class Definite:
    """The symmetric part of B times a gain matrix is at least `floor` in every direction.

    Attributes
    ----------
    matrix : str
    B : (n, n) array
    floor : float
        In the unit of B times the matrix.
    limits : str
        What it limits besides its sign, for messages; empty: nothing.
    """

    matrix: str
    B: Signal
    floor: float
    limits: str = ""

    @property
    def name(self) -> str:
        """See `Constraint`."""
        return self.limits or f"{self.matrix} not negative"

    def _scale(self, loop: LoopGradient) -> float:
        return float(np.abs(self.B).max()) * loop.free.units[self.matrix]

    def margin(self, loop: LoopGradient) -> float:
        """See `Constraint`."""
        product = self.B @ loop.matrices[self.matrix]
        return float(np.linalg.eigvalsh((product + product.T) / 2)[0] - self.floor) / self._scale(loop)

    def add(self, problem: ConicProblem, loop: LoopGradient) -> None:
        """See `Constraint`."""
        scale, n = self._scale(loop), len(self.B)
        slope = np.zeros((1 if n == 1 else 3, problem.size))

        def parts(product: Signal) -> Signal:
            if n == 1:
                return np.array([2 * product[0, 0]])
            (a, b), (c, d) = product
            return np.array([a + d, a - d, b + c])

        for place, (name, row, column) in enumerate(loop.free.places()):
            if name == self.matrix:
                product = np.zeros((n, n))
                product[:, column] = self.B[:, row] * loop.free.units[name] / scale
                slope[:, place] = parts(product)
        value = parts(self.B @ loop.matrices[self.matrix] / scale)
        value[0] -= 2 * self.floor / scale
        if n == 1:
            problem.above(slope, value)
        else:
            problem.cone(slope[None], value[None])


@dataclass(frozen=True, eq=False)
class ParameterRange:
    """The diagonal of a gain matrix stays within the range of the autopilot's parameters.

    Attributes
    ----------
    matrix : str
    largest : (n,) array
        In the unit of the matrix.
    """

    matrix: str
    largest: Signal

    @property
    def name(self) -> str:
        """See `Constraint`."""
        return f"the autopilot's range of {self.matrix}"

    def margin(self, loop: LoopGradient) -> float:
        """See `Constraint`."""
        return float(np.min(1 - np.diag(loop.matrices[self.matrix]) / self.largest))

    def add(self, problem: ConicProblem, loop: LoopGradient) -> None:
        """See `Constraint`."""
        slope = np.zeros((len(self.largest), problem.size))
        for place, (name, row, column) in enumerate(loop.free.places()):
            if name == self.matrix and row == column:
                slope[row, place] = -loop.free.units[name] / self.largest[row]
        problem.above(slope, 1 - np.diag(loop.matrices[self.matrix]) / self.largest)


@dataclass(frozen=True, eq=False)
class MotorLimit:
    """No motor reaches its limit in the doublets of the flown size.

    Attributes
    ----------
    torque : (T, K) array
        Weights that give the torque at T times of a doublet of that size from its response U, real part.
    mixer : (m, n) array
        Change of each motor's command for u = 1 on each axis.
    room : (m, 2) array
        How far each command may fall and rise from hover.
    """

    torque: Complex
    mixer: Signal
    room: Signal
    name: str = "range of the motors"

    def _used(self, responses: Complex) -> Signal:
        """Used share of each command's range, (..., T, axes, m), from U or its derivatives (..., K, n, n)."""
        n = responses.shape[-1]
        flat = responses.reshape(*responses.shape[:-2], n * n)
        torque = np.real(self.torque @ flat).reshape(*responses.shape[:-3], len(self.torque), n, n)
        return np.swapaxes(torque, -1, -2) @ self.mixer.T

    def margin(self, loop: LoopGradient) -> float:
        """See `Constraint`."""
        change = self._used(loop.U)
        return float(1 - max((change / self.room[:, 1]).max(), (-change / self.room[:, 0]).max()))

    def add(self, problem: ConicProblem, loop: LoopGradient) -> None:
        """See `Constraint`."""
        change, slopes = self._used(loop.U), self._used(loop.dU.whole())
        for sign, room in ((1.0, self.room[:, 1]), (-1.0, self.room[:, 0])):
            used = sign * change / room
            near = used > 1 - NEAR
            problem.above(-(sign * slopes / room)[:, near].T, 1 - used[near])
