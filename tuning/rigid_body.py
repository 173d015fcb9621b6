"""The rigid body in a measured response: how fast a unit of torque accelerates roll and pitch."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tuning.errors import TuningError
from tuning.plant_response import PlantResponse

#: Above this a frame bends and filters act, rad/s: it is not the body that is measured.
UPPER = 60.0
#: Known frequencies that the fit needs: as many as a log of some five seconds has.
MIN_FREQUENCIES = 4
#: What lies between torque and rate besides the body: delays (s), rotor lags (s) and damping (1/s) that are tried.
DELAYS = (0.0, 0.005, 0.01, 0.015, 0.02, 0.03, 0.04, 0.06)
LAGS = (0.0, 0.015, 0.025, 0.035, 0.05, 0.07, 0.1)
DAMPINGS = (0.0, 0.5, 1.0, 2.0, 4.0, 8.0)
#: Relative error that every frequency has besides its noise: no body is exactly of these shapes.
SHAPE = 0.03

Signal = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class RigidBody:
    """Torque to angular acceleration about roll and pitch.

    Attributes
    ----------
    B : (2, 2) array, rad/s^2
        For a unit of torque; torque scale times the inverse of the inertia.
    deviation : (2, 2) array, rad/s^2
        Standard deviation of each element.
    """

    B: Signal
    deviation: Signal

    def determinant(self) -> tuple[float, float]:
        """Determinant of B and its standard deviation, rad^2/s^4."""
        (a, b), (c, d) = self.B
        gradient = np.array([[d, -c], [-b, a]])
        return float(a * d - b * c), float(np.linalg.norm(gradient * self.deviation))

    def integral_action(self, Ki_i: Signal) -> Signal:
        """The least that an integral term does in any direction: smallest eigenvalue of the symmetric part of B Ki.

        Parameters
        ----------
        Ki_i : (..., 2, 2) array

        Returns
        -------
        (...) array, rad/s^2 per rad
        """
        action = self.B @ Ki_i
        return np.asarray(np.linalg.eigvalsh((action + np.swapaxes(action, -1, -2)) / 2)[..., 0])


def rigid_body(plant: PlantResponse) -> RigidBody:
    """Fit of G_i = B exp(-j w delay) / ((1 + j w lag) (j w + damping)) with a real B to the known frequencies.

    The shape is common to all elements, so nothing but B can turn a sign: no delay or lag within its range looks like
    one over a decade of frequency.

    Raises
    ------
    TuningError
        When too few frequencies are known.
    """
    use = plant.known() & (plant.omega <= UPPER)
    if np.count_nonzero(use) < MIN_FREQUENCIES:
        raise TuningError(
            f"not excited: the response from torque to rates is known at {np.count_nonzero(use)} frequencies up to "
            f"{UPPER:g} rad/s, {MIN_FREQUENCIES} are needed; inject a stronger or longer torque"
        )
    plant = plant.at(use)
    size = np.linalg.norm(plant.G_i, axis=(1, 2))[:, None, None]
    weight = 1 / (plant.deviation() ** 2 + (SHAPE * size) ** 2)
    s = 1j * plant.omega
    shapes = np.array(
        [
            np.exp(-s * delay) / ((1 + s * lag) * (s + damping))
            for delay, lag, damping in itertools.product(DELAYS, LAGS, DAMPINGS)
        ]
    )
    # One least squares for each shape and element.
    power = np.einsum("nk,kij->nij", np.abs(shapes) ** 2, weight)
    B = np.einsum("nk,kij->nij", shapes.conj(), weight * plant.G_i).real / power
    misfit = np.sum(weight * np.abs(plant.G_i) ** 2) - np.sum(power * B**2, axis=(1, 2))
    best = int(np.argmin(misfit))
    scale = max(1.0, float(misfit[best]) / (4 * len(plant.omega)))
    return RigidBody(B[best], np.sqrt(scale / power[best]))
