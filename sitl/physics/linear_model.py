"""The exact linear model of an airframe about hover: from torque commands to measured rates and angles.

Rigid body and rotors are sampled with a zero-order hold; computing delay, frame mode and gyro filter are those of the
simulation. Near hover the thrust of a rotor follows its command with the lag of the speed, because the steady thrust is
proportional to the command. Yaw and the position are left out.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm

from mimopilot.sitl.physics.airframe import Airframe, Frame
from mimopilot.sitl.physics.state_estimate import frame_mode, low_pass
from mimopilot.tuning.statespace import StateSpace

Signal = NDArray[np.float64]


def linear_model(airframe: Airframe, Ts: float) -> StateSpace:
    """State space from the torques u (normalised) to the measured rates and angles.

    Parameters
    ----------
    airframe : Airframe
    Ts : float, s
        Control period.

    Returns
    -------
    StateSpace
        Two inputs: roll, pitch. Four outputs: rates (rad/s), then angles (rad).
    """
    model = linear_model_with_noise(airframe, Ts)
    return StateSpace(model.A, model.B[:, :2], model.C, model.D[:, :2], Ts)


def linear_model_with_noise(airframe: Airframe, Ts: float) -> StateSpace:
    """The same with four more inputs: white noise of variance 1 that makes the noise of the rates and of the angles."""
    signals = _series(_delay(airframe.computing_delay, Ts), _body(airframe, Ts))
    if airframe.frame is not None:
        signals = _series(signals, _on_both_axes(_frame(airframe.frame, Ts)))
    noise = np.diag(np.repeat([airframe.noise.rate, airframe.noise.angle], 2))
    noisy = StateSpace(
        signals.A,
        np.hstack([signals.B, np.zeros((len(signals.A), 4))]),
        signals.C,
        np.hstack([signals.D, noise]),
        Ts,
    )
    return _series(noisy, _on_both_axes(_gyro(airframe.gyro_cutoff_hz, Ts)))


def _on_both_axes(system: StateSpace) -> StateSpace:
    """A system of one axis on roll and on pitch: each signal is a pair."""

    def both(matrix: Signal) -> Signal:
        return np.asarray(np.kron(matrix, np.eye(2)), np.float64)

    return StateSpace(both(system.A), both(system.B), both(system.C), both(system.D), system.Ts)


def control_effectiveness(airframe: Airframe) -> Signal:
    """Angular acceleration about roll and pitch per unit of torque, (2, 2), rad/s^2."""
    return np.asarray(airframe.plant().inertia_inverse[:2, :2] * np.array(airframe.moment_scale()[:2]), np.float64)


def _body(airframe: Airframe, Ts: float) -> StateSpace:
    """From torque commands to rates and angles, (4 outputs); the states are these and the torques."""
    plant = airframe.plant()
    A = np.zeros((8, 8))
    A[:2, :2] = -plant.inertia_inverse[:2, :2] * plant.rate_damping[:2]
    A[:2, 4:6] = control_effectiveness(airframe)
    A[2:4, :2] = np.eye(2)
    A[4:6, 4:6], A[4:6, 6:] = -np.eye(2) / plant.motor_time_constant, np.eye(2) / plant.motor_time_constant
    sampled = expm(A * Ts)
    return StateSpace(sampled[:6, :6], sampled[:6, 6:], np.eye(4, 6), np.zeros((4, 2)), Ts)


def _delay(samples: int, Ts: float) -> StateSpace:
    """Pure delay of two signals."""
    n = 2 * samples
    A, B, C = np.eye(n, k=-2), np.eye(n, 2), np.eye(2, n, k=n - 2) if n else np.zeros((2, 0))
    return StateSpace(A, B, C, np.zeros((2, 2)) if n else np.eye(2), Ts)


def _frame(frame: Frame, Ts: float) -> StateSpace:
    """Frame mode of one axis, from the body's rate and angle to those at the sensors, see `frame_mode`.

    The states are the last bend, its rate, and the last body rate.
    """
    found = frame_mode(frame.frequency_hz, frame.damping, frame.gain, Ts)
    F, g = found[:4].reshape(2, 2), found[4:, None] / Ts
    A = np.vstack([np.hstack([F, -g]), np.zeros((1, 3))])
    B = np.array([[g[0, 0], 0.0], [g[1, 0], 0.0], [1.0, 0.0]])
    return StateSpace(A, B, A[[1, 0]], np.array([[1 + g[1, 0], 0.0], [g[0, 0], 1.0]]), Ts)


def _gyro(cutoff_hz: float, Ts: float) -> StateSpace:
    """Gyro filter of one axis, from rate and angle to the same; the angle passes."""
    b0, b1, b2, a1, a2 = low_pass(cutoff_hz, Ts)
    return StateSpace(
        np.array([[-a1, 1.0], [-a2, 0.0]]),
        np.array([[b1 - a1 * b0, 0.0], [b2 - a2 * b0, 0.0]]),
        np.array([[1.0, 0.0], [0.0, 0.0]]),
        np.array([[b0, 0.0], [0.0, 1.0]]),
        Ts,
    )


def _series(first: StateSpace, second: StateSpace) -> StateSpace:
    """`second` after `first`."""
    return StateSpace(
        np.block([[first.A, np.zeros((len(first.A), len(second.A)))], [second.B @ first.C, second.A]]),
        np.vstack([first.B, second.B @ first.D]),
        np.hstack([second.D @ first.C, second.C]),
        second.D @ first.D,
        first.Ts,
    )
