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

from mimopilot.tuning.analysis.beyond_band import MAX_GAIN_ABOVE_BAND, falling_gain
from mimopilot.tuning.design.conic_problem import ConicProblem
from mimopilot.tuning.design.free_gains import FreeGains
from mimopilot.tuning.design.loop_gradient import LETTERS, LoopGradient, ProductGradient
from mimopilot.tuning.law import rate_response
from mimopilot.tuning.plant.frequency_response import COHERENT
from mimopilot.tuning.plant.response_shape import shape_response
from mimopilot.tuning.plant.wide_response import WideResponse
from mimopilot.tuning.small_matrices import inverse, singular_values

#: Distance to its limit above which a frequency is left out of the next step: the step hardly reaches so far, and the
#: one after sees it.
NEAR = 0.2
#: Share of the certificate's limits that a design uses; the rest is for interpolation.
SHARE = 0.96
#: Ratio of the response to that of the fitted rigid body above which a frequency belongs to a mode of the frame; a
#: mode is not below `RIGID`, rad/s (5 Hz), and reaches so far around such a frequency (natural logarithm of the ratio).
RISES, RIGID, AROUND = 1.5, 30.0, 0.2

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
class GainLimit:
    """The rate loop's gain stays below a limit at frequencies where the plant's response counts as given.

    Attributes
    ----------
    name : str
    omega : (K,) array, rad/s
    G : (K, n, n) array
        Response from torque to rates.
    deviation : (K, n, n) array
        Standard deviation of its elements.
    limit : float
        Twice the deviation included.
    """

    name: str
    omega: Signal
    G: Complex
    deviation: Signal
    limit: float

    def _gain(self, loop: LoopGradient) -> tuple[Complex, Signal]:
        """C_y G, and the limit left after the error."""
        C_y = sum(shape * loop.matrices[name] for name, shape in self._shapes(loop.free).items())
        controller = np.asarray(C_y, complex)
        error = np.sqrt(np.sum(np.abs(controller) ** 2 @ self.deviation**2, axis=(1, 2)))
        return controller @ self.G, self.limit - error

    def _shapes(self, free: FreeGains) -> dict[str, Complex]:
        one, shape = np.ones((1, self.G.shape[-1])), (len(self.omega), 1, self.G.shape[-1])
        return {
            name: np.broadcast_to(rate_response({LETTERS[name]: one}, free.base.filters, self.omega)[1], shape)
            for name in free.units
            if name in LETTERS
        }

    def margin(self, loop: LoopGradient) -> float:
        """See `Constraint`."""
        product, left = self._gain(loop)
        return float(np.min(left - singular_values(product)[0], initial=self.limit) / self.limit)

    def add(self, problem: ConicProblem, loop: LoopGradient) -> None:
        """See `Constraint`."""
        if not len(self.omega):
            return
        product, left = self._gain(loop)
        shapes = self._shapes(loop.free)
        U, sizes, V = np.linalg.svd(product)
        for part in range(loop.plant.axes):
            slope = np.zeros((len(product), problem.size))
            right = (self.G @ V[:, part].conj()[:, :, None])[:, :, 0]
            for place, (name, row, column) in enumerate(loop.free.places()):
                if name in shapes:
                    slope[:, place] = np.real(U[:, row, part].conj() * shapes[name][:, 0, column] * right[:, column])
            problem.above(-slope * loop.free.size / self.limit, (left - sizes[:, part]) / self.limit)


def gain_above_band(plant: WideResponse) -> GainLimit:
    """Limit of the rate loop above the band, see `tuning.analysis.beyond_band.loop_gain_above`."""
    known = plant.response.at(plant.response.known_run())
    omega = plant.omega[plant.band.stop - 1 :]
    G = (falling_gain(known)[-1] / omega)[:, None, None] * np.eye(plant.axes, dtype=complex)
    return GainLimit("gain above the band", omega, G, np.zeros(G.shape), SHARE * MAX_GAIN_ABOVE_BAND)


def structural_modes(plant: WideResponse, others: NDArray[np.bool_] | None = None) -> GainLimit:
    """Limit of the rate loop at the measured frequencies around which the vehicle responds more than a rigid body.

    Parameters
    ----------
    plant : WideResponse
    others : (K,) bool array, optional
        Further frequencies of `plant.response`.
    """
    response = plant.response
    rigid = float(np.linalg.norm(plant.body.B, ord=2)) * np.abs(shape_response(response.omega, plant.shape))
    gain, deviation = singular_values(response.G_i)[0], response.deviation()
    seen = response.known() | np.any(response.coherence > COHERENT, axis=1)
    rises = np.flatnonzero(seen & (gain - np.linalg.norm(deviation, axis=(1, 2)) > RISES * rigid))
    rises = rises[response.omega[rises] > RIGID]
    near = np.abs(np.log(response.omega[:, None] / response.omega[rises])).min(axis=1, initial=np.inf) < AROUND
    which = seen & near if others is None else seen & near | others
    hertz = response.omega[rises[np.argmax(gain[rises])]] / (2 * np.pi) if len(rises) else 0.0
    return GainLimit(
        f"a mode of the frame at {hertz:.0f} Hz: set a notch there (PX4: IMU_GYRO_NF0_FRQ, ArduPilot: INS_HNTCH_FREQ)"
        if len(rises)
        else "the error of the response above the crossover",
        response.omega[which],
        response.G_i[which],
        deviation[which],
        SHARE * MAX_GAIN_ABOVE_BAND,
    )


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
