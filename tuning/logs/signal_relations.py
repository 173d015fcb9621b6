"""Relations between the logged signals, each measured as a 2x2 matrix, and which signals a broken one points to."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mimopilot.tuning.experiment import Experiment

#: s. Angles are compared with rates integrated over this time: long enough to divide down the noise of the angles.
INTEGRATION = 0.1
#: s. Each window of a flight has the same weight, so that a tumble does not outweigh the rest.
WINDOW = 1.0
#: rad, RMS over `INTEGRATION`. An axis that moves less is not judged.
STILL = 2e-3
#: An angle counts as moving without its rate from this many times `STILL` on: its noise is below that.
NOISE = 5.0
#: Samples by which the logged injection may lead or lag the logged torque.
MAX_LAG = 3

Matrix = NDArray[np.float64]
Signal = NDArray[np.float64]


@dataclass(frozen=True)
class SignalRelation:
    """How one pair of signals follows another: whether roll and pitch are exchanged, and the sign of each axis."""

    exchanged: bool = False
    reversed: tuple[bool, bool] = (False, False)


@dataclass(frozen=True, eq=False)
class Kinematics:
    """Angles from integrated rates.

    Attributes
    ----------
    matrix : (2, 2) array
        From integrated rates to changes of the angles: the identity in a correct log.
    explained : (2,) array
        Fraction of the movement of each angle that the rates explain.
    moves : (2,) array
        Whether each axis moves enough to be judged.
    """

    matrix: Matrix
    explained: Signal
    moves: NDArray[np.bool_]


def measure_kinematics(experiment: Experiment) -> Kinematics:
    """Least squares of the changes of the angles over `INTEGRATION` on the integrals of the rates, where they move."""
    step, window = max(1, round(INTEGRATION / experiment.Ts)), max(1, round(WINDOW / experiment.Ts))
    outer, inner, moved = np.zeros((2, 2)), np.zeros((2, 2)), np.zeros(2)
    energy = []
    for start, stop in experiment.segments:
        rates = experiment.y_i[start:stop]
        turned = np.cumsum((rates[1:] + rates[:-1]) / 2 * experiment.Ts, axis=0)
        angles = np.unwrap(experiment.y_o[start:stop], axis=0)[1:]
        for begin in range(0, len(turned) - step, window):
            part = slice(begin, begin + window)
            x = turned[step:][part] - turned[:-step][part]
            y = angles[step:][part] - angles[:-step][part]
            x, y = x - x.mean(axis=0), y - y.mean(axis=0)
            size, response = float(np.sum(x**2)), float(np.sum(y**2))
            if size <= 0 or response <= 0:
                continue
            moves = np.maximum(np.mean(x**2, axis=0), np.mean(y**2, axis=0) / NOISE**2)
            if np.sqrt(moves.max()) <= STILL:
                continue  # the noise of a calm hover, as in the pauses of an experiment and while yaw is excited
            # Normalise each window by its own movement.
            scale = math.sqrt(size * response)
            outer += y.T @ x / scale
            inner += x.T @ x / scale
            moved += np.sum(y**2, axis=0) / scale
            energy.append(moves)
    if not energy:
        return Kinematics(np.eye(2), np.ones(2), np.zeros(2, bool))
    moving = np.sqrt(np.median(energy, axis=0)) > STILL
    if not moving.all():
        return Kinematics(np.eye(2), np.ones(2), moving)
    matrix = outer @ np.linalg.pinv(inner)
    explained = np.einsum("ij,ij->i", matrix, outer) / np.maximum(moved, 1e-300)
    return Kinematics(matrix, explained, moving)


def injected_in(total: Signal, injected: Signal, segments: tuple[tuple[int, int], ...]) -> Matrix:
    """Gain from steps of what is injected to steps of the whole, (n, n): the identity in a correct log.

    Parameters
    ----------
    total, injected : (N, n) arrays
        Torque and the injected torque, or the same of the rate setpoint.
    segments : tuple of (start, stop)
        Stretches without a gap.
    """
    found = []
    for lag in range(-MAX_LAG, MAX_LAG + 1):
        outer, inner = np.zeros((2, total.shape[1], total.shape[1]))
        for start, stop in segments:
            u, w = np.diff(total[start:stop], axis=0), np.diff(injected[start:stop], axis=0)
            u, w = (u[lag:], w[: len(w) - lag]) if lag >= 0 else (u[:lag], w[-lag:])
            outer += u.T @ w
            inner += w.T @ w
        found.append(outer @ np.linalg.pinv(inner))
    return max(found, key=lambda matrix: float(np.linalg.norm(matrix)))


def classify(matrix: Matrix) -> SignalRelation:
    """What is wrong with a matrix whose diagonal should be positive and dominant."""
    own, other = matrix[0, 0] * matrix[1, 1], matrix[0, 1] * matrix[1, 0]
    exchanged = abs(other) > abs(own)
    diagonal = (matrix[0, 1], matrix[1, 0]) if exchanged else (matrix[0, 0], matrix[1, 1])
    return SignalRelation(exchanged, (bool(diagonal[0] < 0), bool(diagonal[1] < 0)))


def faulty_signals(
    injected: bool, torque: bool, angles: bool, injection: bool
) -> tuple[tuple[str, ...], tuple[str, ...]] | None:
    """The fewest signals that explain which relations are broken.

    Parameters
    ----------
    injected, torque, angles : bool
        Whether the relation is broken: injected torque in torque, torque to acceleration, rates to angles.
    injection : bool
        Whether a torque was injected.

    Returns
    -------
    (faulty, alternative) or None
        The signals, and others that would explain the same. None: no relation is broken.
    """
    with_injection = ("u", "u_bar") if injection else ("u",)
    table: dict[tuple[bool, bool, bool], tuple[tuple[str, ...], tuple[str, ...]]] = {
        (False, False, True): (("y_o",), ()),
        (False, True, True): (("y_i",), ()),
        (False, True, False): (with_injection, ("y_i", "y_o")),
        (True, True, False): (("u",), ()),
        (True, False, False): (("u_bar",), ()),
        (True, False, True): (("u_bar", "y_o"), ()),
        (True, True, True): (("u", "y_o"), ("u_bar", "y_i")),
    }
    return table.get((injected, torque, angles))
