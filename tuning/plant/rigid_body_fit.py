"""Rigid-body fit of a measured response: angular acceleration of its n axes per unit of torque."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm

from mimopilot.tuning.errors import TuningError
from mimopilot.tuning.plant.frequency_response import PlantResponse
from mimopilot.tuning.plant.response_shape import SHAPE_ERROR, ResponseShape, fit_shape, shape_response
from mimopilot.tuning.statespace import StateSpace

#: rad/s. Above it frame modes and filters shape the response.
UPPER = 60.0
#: Known frequencies that the fit needs: as many as a log of about five seconds has.
MIN_FREQUENCIES = 4
#: rad/s. Below it a vehicle that holds its attitude does not move.
LOWEST = 0.1
#: Largest relative step between neighbouring frequencies below the band.
STEP = 0.15
#: Least damping of the continued body, 1/s: every rotor damps, and without damping the count of encirclements would
#: need one more integrator.
LEAST_DAMPING = 0.3
#: Relative error of the response above which the fitted body is the better estimate where the band begins: its own is
#: 1 to 20 %, from the choice of lag and damping (20 random vehicles).
DEVIATION = 0.1

Signal = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class RigidBody:
    """Angular acceleration about n axes per unit of torque (control effectiveness).

    Attributes
    ----------
    B : (n, n) array, rad/s^2
        Torque scale times the inverse of the inertia.
    deviation : (n, n) array, rad/s^2
        Standard deviation of each element.
    shape : ResponseShape
        Delay (s), rotor lag (s) and damping (1/s).
    """

    B: Signal
    deviation: Signal
    shape: ResponseShape = (0.0, 0.0, 0.0)

    def determinant(self) -> tuple[float, float]:
        """Determinant of B of roll and pitch and its standard deviation, rad^2/s^4."""
        (a, b), (c, d) = self.B
        gradient = np.array([[d, -c], [-b, a]])
        return float(a * d - b * c), float(np.linalg.norm(gradient * self.deviation))

    def least(self, gain: Signal) -> Signal:
        """Smallest action of a rate controller term over all directions.

        This is the smallest eigenvalue of the symmetric part of B times the gain.

        Parameters
        ----------
        gain : (..., n, n) array
            Such as Kp_i or Ki_i.

        Returns
        -------
        (...) array, rad/s^2 per unit of the error, or of its integral
        """
        action = self.B @ gain
        return np.asarray(np.linalg.eigvalsh((action + np.swapaxes(action, -1, -2)) / 2)[..., 0])

    def model(self, Ts: float) -> StateSpace:
        """From torque to body rates: rotors and body held over each period (zero-order hold), after whole periods.

        The hold itself delays by half a period.
        """
        delay, lag, damping = self.shape
        axes = len(self.B)
        rate, one, none = -damping * np.eye(axes), np.eye(axes), np.zeros((axes, axes))
        if lag > 0:
            A, B, C = (
                np.block([[rate, self.B], [none, -one / lag]]),
                np.vstack([none, one / lag]),
                np.hstack([one, none]),
            )
        else:
            A, B, C = rate, self.B, one
        n, late = len(A), max(0, round(delay / Ts - 0.5))
        held = expm(np.block([[A, B], [np.zeros((axes, n + axes))]]) * Ts)
        A, B = held[:n, :n], held[:n, n:]
        # Every period of delay is a state that holds the torque.
        chain = np.eye(axes * late, k=axes)
        chain[-axes:] = 0.0
        held_back = axes * late
        whole = np.block([[A, B, np.zeros((n, held_back - axes))], [np.zeros((held_back, n)), chain]]) if late else A
        drive = np.vstack([np.zeros((len(whole) - axes, axes)), one]) if late else B
        return StateSpace(whole, drive, np.hstack([C, np.zeros((axes, held_back))]), none, Ts)


def rigid_body(plant: PlantResponse) -> RigidBody:
    """Fit of G_i = B exp(-j w delay) / ((1 + j w lag) (j w + damping)) with a real B to the known frequencies.

    All elements share the shape, so only B sets the signs: over a decade of frequency no delay or lag in the grid
    looks like a change of sign.

    Raises
    ------
    TuningError
        When too few frequencies are known.
    """
    use = plant.known() & (plant.omega <= UPPER)
    if np.count_nonzero(use) < MIN_FREQUENCIES:
        raise TuningError(
            f"not excited: the response from torque to rates is known at {np.count_nonzero(use)} frequencies up to "
            f"{UPPER:g} rad/s, expected {MIN_FREQUENCIES} or more; inject a stronger or longer torque"
        )
    plant = plant.at(use)
    size = np.linalg.norm(plant.G_i, axis=(1, 2))[:, None, None]
    weight = 1 / (plant.deviation() ** 2 + (SHAPE_ERROR * size) ** 2)
    shape, B, power, misfit = fit_shape(plant.omega, plant.G_i, weight)
    scale = max(1.0, misfit / (plant.axes**2 * len(plant.omega)))
    return RigidBody(B, np.sqrt(scale / power), shape)


def continued_below(plant: PlantResponse, body: RigidBody) -> PlantResponse:
    """The response continued below its band as the fitted rigid body, down to `LOWEST`.

    Where the band begins with errors above `DEVIATION` the body is the better estimate and replaces the response.

    Parameters
    ----------
    plant : PlantResponse
    body : RigidBody
        Fit of the same response.
    """
    sure = np.flatnonzero(plant.rate_error() < DEVIATION)
    plant = plant.at(np.arange(sure[0] if len(sure) else 0, len(plant.omega)))
    first = float(plant.omega[0])
    if first <= LOWEST:
        return plant
    omega = np.geomspace(LOWEST, first, int(np.ceil(np.log(first / LOWEST) / np.log1p(STEP))) + 1)[:-1]
    delay, lag, damping = body.shape
    G = body.B * shape_response(omega, (delay, lag, max(damping, LEAST_DAMPING)))[:, None, None]
    s = 1j * omega[:, None, None]
    # Its error is real, a few percent of B, where the loop's gain is large: no phase is drawn for it.
    n = plant.axes
    root = np.zeros((len(omega), 3 * n, 3 * n), complex)
    return PlantResponse(
        omega=np.concatenate([omega, plant.omega]),
        G_i=np.concatenate([G, plant.G_i]),
        G_o=np.concatenate([G / s, plant.G_o]),
        root=np.concatenate([root, plant.root]),
        reach=np.concatenate([np.broadcast_to(np.eye(n, dtype=complex), (len(omega), n, n)), plant.reach]),
        coherence=np.concatenate([np.ones((len(omega), n)), plant.coherence]),
        Ts=plant.Ts,
    )
