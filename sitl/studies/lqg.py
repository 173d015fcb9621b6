"""A model-based LQG servo on the true plant: what a controller that knows the vehicle exactly can do.

The vehicle's linear model, the noise of its measurements and a constant disturbance of the torque, modelled as a random
walk, are known. A Kalman filter estimates the states and the disturbance, which is cancelled: the integral action. The
state feedback and the feed-forward from the attitude model minimise

    sum |y_o - y_M|^2 + weight |u + d|^2

for setpoints that stay as they are (B. D. O. Anderson, J. B. Moore, Optimal Control: Linear Quadratic Methods, 1989).
It has as many states as the vehicle, so it is no set of 2x2 gains, and it knows no limits: its figures are linear.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_discrete_are

from mimopilot.sitl.physics.airframe import Airframe
from mimopilot.sitl.physics.linear_model import control_effectiveness, linear_model_with_noise
from mimopilot.sitl.studies.linear_loop import LinearController, LinearLoop
from mimopilot.tuning.analysis.manoeuvres import ROLL_PITCH_FAMILY
from mimopilot.tuning.reference_model import ReferenceModel
from mimopilot.tuning.statespace import StateSpace

#: Least noise of each measurement over its deviation: a gyro filter lets none pass at the Nyquist frequency, and the
#: Riccati equation has no solution without.
FLOOR = 0.01
#: Range of the weight, rad^2, and the relative accuracy of the noise that it is chosen for.
WEIGHTS, ACCURACY = (1e-9, 1e3), 1e-4

Signal = NDArray[np.float64]


def lqg_with_noise(airframe: Airframe, model: ReferenceModel, noise: Signal) -> LinearController:
    """The servo whose weight makes the noise of its torque as large as allowed.

    Parameters
    ----------
    airframe : Airframe
    model : ReferenceModel
        Of the attitude, for both axes.
    noise : (2,) array
        Largest RMS of each torque (normalised) at hover; one of them is reached.
    """
    plant = linear_model_with_noise(airframe, model.Ts)
    # A random walk that in the mean doublet of the design's cost reaches its step of torque.
    step = ROLL_PITCH_FAMILY.acceleration / np.abs(np.diag(control_effectiveness(airframe)))
    drift = step * np.sqrt(model.Ts / ROLL_PITCH_FAMILY.seconds)
    low, high = np.log(WEIGHTS)
    while high - low > ACCURACY:
        middle = (low + high) / 2
        found = LinearLoop(plant, lqg(plant, model, drift, np.exp(middle)))
        low, high = (middle, high) if np.any(found.noise > noise) else (low, middle)
    return lqg(plant, model, drift, np.exp(high))


def lqg(plant: StateSpace, model: ReferenceModel, drift: Signal, weight: float) -> LinearController:
    """The servo for a weight.

    Parameters
    ----------
    plant : StateSpace
        See `sitl.physics.linear_model.linear_model_with_noise`.
    model : ReferenceModel
        Of the attitude.
    drift : (2,) array
        Standard deviation of what each disturbance (normalised torque) gains in a period.
    weight : float, rad^2
        Of the squared torque.
    """
    A, B, angle = plant.A, plant.B[:, :2], plant.C[2:]
    n, eye = len(A), np.eye(2)
    P = solve_discrete_are(A, B, angle.T @ angle, weight * eye)
    inverse = np.linalg.inv(weight * eye + B.T @ P @ B)
    K = inverse @ B.T @ P @ A
    # The attitude model on both axes, with the setpoint as its last two states.
    A_M, B_M, C_M, D_M = (np.kron(matrix, eye) for matrix in _companion(model))
    m = len(A_M)
    world = np.block([[A_M, B_M], [np.zeros((2, m)), eye]])
    cross = _stein(A - B @ K, world, -angle.T @ np.hstack([C_M, D_M]))
    forward = inverse @ B.T @ cross @ world

    filter_gain, predictor_gain = _kalman(plant, drift)
    A_e = np.block([[A, B], [np.zeros((2, n)), eye]])
    B_e, C_e = np.vstack([B, np.zeros((2, 2))]), np.hstack([plant.C, np.zeros((4, 2))])
    feedback = -np.hstack([K, eye])
    of_states, of_y = feedback @ (np.eye(n + 2) - filter_gain @ C_e), feedback @ filter_gain
    loop = StateSpace(
        A_e - predictor_gain @ C_e + B_e @ of_states,
        np.hstack([np.zeros((n + 2, 2)), predictor_gain + B_e @ of_y]),
        of_states,
        np.hstack([np.zeros((2, 2)), of_y]),
        plant.Ts,
    )
    of_model, of_r = -forward[:, :m], -forward[:, m:]
    whole = StateSpace(
        np.block([[loop.A, B_e @ of_model], [np.zeros((m, n + 2)), A_M]]),
        np.block([[B_e @ of_r, loop.B[:, 2:]], [B_M, np.zeros((m, 4))]]),
        np.hstack([of_states, of_model]),
        np.hstack([of_r, of_y]),
        plant.Ts,
    )
    return LinearController(whole, loop)


def _companion(model: ReferenceModel) -> tuple[Signal, Signal, Signal, Signal]:
    """The model in state space, its delay included."""
    order = len(model.den) - 1 + model.delay
    den, num = np.zeros(order), np.zeros(order + 1)
    den[: len(model.den) - 1] = model.den[1:]
    num[: len(model.taps)] = model.taps
    A = np.eye(order, k=-1)
    A[0] = -den
    return A, np.eye(order, 1), (num[1:] - num[0] * den)[None], num[:1, None]


def _stein(left: Signal, right: Signal, constant: Signal) -> Signal:
    """X with X = constant + left' X right."""
    pencil = np.eye(constant.size) - np.kron(right.T, left.T)
    stacked = np.asarray(np.linalg.solve(pencil, constant.ravel(order="F")), np.float64)
    return stacked.reshape(constant.shape, order="F")


def _kalman(plant: StateSpace, drift: Signal) -> tuple[Signal, Signal]:
    """Gains of the Kalman filter for the states and the disturbances: of the estimate, and of the prediction.

    The noise of the rates passes the gyro filter, so it drives states as well as measurements.
    """
    A, B, G, H, n = plant.A, plant.B[:, :2], plant.B[:, 2:], plant.D[:, 2:], len(plant.A)
    A_e = np.block([[A, B], [np.zeros((2, n)), np.eye(2)]])
    C_e = np.hstack([plant.C, np.zeros((4, 2))])
    driven = np.vstack([G, np.zeros((2, 4))])
    # Below any gyro filter's cutoff the noise passes.
    passed = np.abs(plant.frequency_response(np.array([1.0]))[0, :, 2:])
    Q, both, R = driven @ driven.T, driven @ H.T, H @ H.T + (FLOOR * passed) ** 2
    Q[n:, n:] = np.diag(drift**2)
    P = solve_discrete_are(A_e.T, C_e.T, Q, R, s=both)
    inverse = np.linalg.inv(C_e @ P @ C_e.T + R)
    return P @ C_e.T @ inverse, (A_e @ P @ C_e.T + both) @ inverse
