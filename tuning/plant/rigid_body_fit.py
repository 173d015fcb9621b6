"""The rigid body in a measured response: how fast a unit of torque accelerates roll and pitch."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from mimopilot.tuning.errors import TuningError
from mimopilot.tuning.plant.frequency_response import PlantResponse
from mimopilot.tuning.plant.response_shape import fit_shape
from numpy.typing import NDArray

#: Above this a frame bends and filters act, rad/s: it is not the body that is measured.
UPPER = 60.0
#: Known frequencies that the fit needs: as many as a log of some five seconds has.
MIN_FREQUENCIES = 4
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

    def least(self, gain: Signal) -> Signal:
        """The least that a term of the rate controller does in any direction: smallest eigenvalue of the symmetric part
        of B times its gain.

        Parameters
        ----------
        gain : (..., 2, 2) array
            Such as Kp_i or Ki_i.

        Returns
        -------
        (...) array, rad/s^2 per unit of the error, or of its integral
        """
        action = self.B @ gain
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
    _, B, power, misfit = fit_shape(plant.omega, plant.G_i, weight)
    scale = max(1.0, misfit / (4 * len(plant.omega)))
    return RigidBody(B, np.sqrt(scale / power))
