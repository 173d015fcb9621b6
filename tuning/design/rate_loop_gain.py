"""Limits of the rate loop's gain where the loop must be below 1: above the band, and at the frame's modes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mimopilot.tuning.analysis.beyond_band import MAX_GAIN_ABOVE_BAND, falling_gain
from mimopilot.tuning.design.conic_problem import ConicProblem
from mimopilot.tuning.design.constraints import SHARE
from mimopilot.tuning.design.free_gains import FreeGains
from mimopilot.tuning.design.loop_gradient import LETTERS, LoopGradient
from mimopilot.tuning.law import rate_response
from mimopilot.tuning.plant.frequency_response import COHERENT
from mimopilot.tuning.plant.response_shape import shape_response
from mimopilot.tuning.plant.wide_response import WideResponse
from mimopilot.tuning.small_matrices import singular_values

#: Ratio of the response to that of the fitted rigid body above which a frequency belongs to a mode of the frame; a
#: mode is not below `RIGID`, rad/s (5 Hz), and reaches so far around such a frequency (natural logarithm of the ratio).
RISES, RIGID, AROUND = 1.5, 30.0, 0.2

Complex = NDArray[np.complex128]
Signal = NDArray[np.float64]


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
