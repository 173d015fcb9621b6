"""Exact figures of linear controllers around the linear model of an airframe: poles, margin, noise, doublets."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mimopilot.tuning.gains import Gains
from mimopilot.tuning.law import rate_matrices
from mimopilot.tuning.law_state_space import state_space
from mimopilot.tuning.law_terms import ERROR, RATE, SETPOINT
from mimopilot.tuning.reference_model import ReferenceModel
from mimopilot.tuning.small_matrices import singular_values
from mimopilot.tuning.statespace import Response, StateSpace

#: Poles slower than this are dominant, rad/s: three times the usual attitude model. Faster ones are those of rotors,
#: filters and delays, which damp out within a fraction of a manoeuvre.
DOMINANT = 30.0
#: Inputs of a controller, two each: setpoint of the angles, measured rates, measured angles.
REFERENCE, MEASURED = slice(0, 2), slice(2, 6)

Signal = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class LinearController:
    """A controller without its limits.

    Attributes
    ----------
    model : StateSpace
        From angle setpoints (rad), measured rates (rad/s) and angles (rad), two each, to the torques (normalised).
    loop : StateSpace
        The same without the states that measurements do not reach, such as an attitude model: what stability, margin
        and noise depend on.
    """

    model: StateSpace
    loop: StateSpace


def controller_of(gains: Gains) -> LinearController:
    """The law of a gain set."""
    without = replace(gains, filters=replace(gains.filters, model_omega=0.0))
    return LinearController(_law(gains), _law(without))


def _law(gains: Gains) -> StateSpace:
    """The law as one state space; the states are those of the attitude model (angles, rates), then the terms'."""
    law, Ts, none, eye = state_space(rate_matrices(gains), gains.filters), gains.Ts, np.zeros((2, 2)), np.eye(2)
    # Angle, rate and acceleration of the attitude model: of its states and of the inputs.
    wide = 0 if gains.filters.followed is None else 4
    angle, rate, acceleration = (np.zeros((2, wide + 6)) for _ in range(3))
    angle[:, wide : wide + 2] = eye
    if wide:
        omega, damping = gains.filters.model_omega, gains.filters.model_damping
        acceleration = np.hstack([-(omega**2) * eye, -2 * damping * omega * eye, omega**2 * eye, none, none])
        rate = np.hstack([none, eye, none, none, none]) + Ts * acceleration
        angle = np.hstack([eye, none, none, none, none]) + Ts * rate
    measured_rate, measured_angle = np.zeros((2, wide + 6)), np.zeros((2, wide + 6))
    measured_rate[:, wide + 2 : wide + 4], measured_angle[:, wide + 4 :] = eye, eye
    setpoint = gains.Kp_o @ (angle - measured_angle) + gains.Kff_o @ rate
    signals = {ERROR: setpoint - measured_rate, RATE: measured_rate, SETPOINT: setpoint}
    into: Any = sum(law.B[name] @ signal for name, signal in signals.items())
    through: Any = gains.Kaff_i @ acceleration + sum(law.D[name] @ signal for name, signal in signals.items())
    follower = np.vstack([angle, rate])[:wide]
    A = np.block([[follower[:, :wide], np.zeros((wide, len(law.A)))], [into[:, :wide], law.A]])
    C = np.hstack([through[:, :wide], law.C])
    return StateSpace(A, np.vstack([follower[:, wide:], into[:, wide:]]), C, through[:, wide:], Ts)


@dataclass(frozen=True, eq=False)
class LinearLoop:
    """A controller around a plant.

    Attributes
    ----------
    plant : StateSpace
        From torques and white noise to measurements, see `sitl.physics.linear_model.linear_model_with_noise`.
    controller : LinearController
    """

    plant: StateSpace
    controller: LinearController

    @cached_property
    def whole(self) -> StateSpace:
        """From angle setpoints (2) and noise (4) to angles without their noise (2) and torques (2)."""
        return closed_loop(self.plant, self.controller.model)

    @cached_property
    def feedback(self) -> StateSpace:
        """The same without the states that the loop does not need, see `LinearController.loop`."""
        return closed_loop(self.plant, self.controller.loop)

    @property
    def spectral_radius(self) -> float:
        """Largest modulus of the poles; the loop is stable below 1."""
        return float(np.abs(np.linalg.eigvals(self.feedback.A)).max())

    @property
    def damping(self) -> float:
        """Smallest damping ratio of the poles that are slower than `DOMINANT`; NaN without such poles."""
        poles = np.linalg.eigvals(self.feedback.A).astype(np.complex128)
        continuous = np.log(poles[np.abs(poles) > 0]) / self.plant.Ts
        dominant = continuous[(np.abs(continuous) < DOMINANT) & (np.abs(continuous) > 0)]
        return float((-dominant.real / np.abs(dominant)).min()) if len(dominant) else float("nan")

    def sensitivity_peak(self, omega: Signal, G: Response) -> float:
        """Ms: largest singular value of the sensitivity, cut at the torques.

        Parameters
        ----------
        omega : (K,) array, rad/s
        G : (K, 4, 2) array
            The plant's response from the torques there: the same for many controllers.
        """
        K = self.controller.loop.frequency_response(omega)[:, :, MEASURED]
        return float(1 / singular_values(np.eye(2) - K @ G)[1].min())

    @property
    def noise(self) -> Signal:
        """RMS of the torques (normalised) at hover that noise causes, (2,). Infinite when the loop is not stable."""
        from scipy.linalg import solve_discrete_lyapunov

        if self.spectral_radius >= 1:
            return np.full(2, np.inf)
        loop = self.feedback
        B, C, D = loop.B[:, 2:], loop.C[2:], loop.D[2:, 2:]
        states = solve_discrete_lyapunov(loop.A, B @ B.T)
        rms: Signal = np.sqrt(np.diag(C @ states @ C.T + D @ D.T))
        return rms

    def doublet(self, axis: int, period: float, tail: float) -> tuple[Signal, Signal, Signal]:
        """Setpoint (N,), angles (N, 2) and torques (N, 2) of a doublet of amplitude 1 rad, from its start.

        Parameters
        ----------
        axis : int
            0 roll, 1 pitch.
        period, tail : float, s
            Length of the whole doublet, and level flight after it.
        """
        half = round(period / 2 / self.plant.Ts)
        inputs = np.zeros((2 * half + round(tail / self.plant.Ts), 6))
        inputs[:half, axis], inputs[half : 2 * half, axis] = 1.0, -1.0
        outputs = self.whole.simulate(inputs)
        return inputs[:, axis], outputs[:, :2], outputs[:, 2:]

    def J_M(self, model: ReferenceModel, period: float, tail: float) -> list[float]:  # noqa: N802
        """Mean squared error of the angle to a model over a doublet of 1 rad and its tail, for each axis."""
        found = []
        for axis in range(2):
            setpoint, angles, _ = self.doublet(axis, period, tail)
            found.append(float(np.mean((angles[:, axis] - model.response(setpoint)) ** 2)))
        return found


def closed_loop(plant: StateSpace, controller: StateSpace) -> StateSpace:
    """See `LinearLoop.whole`; the plant has no direct path from torques to measurements."""
    A, B, G, C, H = plant.A, plant.B[:, :2], plant.B[:, 2:], plant.C, plant.D[:, 2:]
    from_r, from_y = controller.B[:, REFERENCE], controller.B[:, MEASURED]
    D_r, D_y = controller.D[:, REFERENCE], controller.D[:, MEASURED]
    outputs = np.block([[C[2:], np.zeros((2, len(controller.A)))], [D_y @ C, controller.C]])
    return StateSpace(
        np.block([[A + B @ D_y @ C, B @ controller.C], [from_y @ C, controller.A]]),
        np.block([[B @ D_r, G + B @ D_y @ H], [from_r, from_y @ H]]),
        outputs,
        np.block([[np.zeros((2, 6))], [D_r, D_y @ H]]),
        plant.Ts,
    )
