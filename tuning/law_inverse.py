"""The inverse of the rate controller: the rate setpoint that a recorded torque came from."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.linalg import block_diag, schur

from mimopilot.tuning.errors import NotMinimumPhaseError
from mimopilot.tuning.first_order_filter import Signal
from mimopilot.tuning.law import SINGULAR, Matrices, rate_matrices, regressors
from mimopilot.tuning.law_filters import Filters
from mimopilot.tuning.law_terms import ERROR, LOOP_TERMS, RATE

#: Remaining share of the unknown initial state at which the inverse counts as settled.
SETTLED = 0.01
#: Rounding of an eigenvalue of exactly 1.
ROUNDING = 1e-12


@dataclass(frozen=True, eq=False)
class InverseLaw:
    """The inverse from u to e, in the coordinates of the terms' parts of u.

    Attributes
    ----------
    A, B : (m, m) and (m, n) arrays
        Of its states.
    direct : (n, n) array
        Its direct gain.
    eigenvalues : (m,) array
        Its poles; with an integral alone those of I - Ts Ki (Kp + Ts Ki + Kff)^-1.
    """

    A: Signal
    B: Signal
    direct: Signal
    eigenvalues: Any


def inverse_law(matrices: Mapping[str, Signal], filters: Filters) -> InverseLaw:
    """The inverse rate controller.

    Parameters
    ----------
    matrices : mapping
        Letter -> (n, n) matrix.
    filters : Filters

    Raises
    ------
    NotMinimumPhaseError
        When the controller has no inverse, or is a stock one.
    """
    if filters.stock is not None:
        raise NotMinimumPhaseError(f"the rate controller of {filters.stock.controller} is not inverted")
    direct: Any = 0.0
    poles, pushes = [], []
    for letter, term in LOOP_TERMS.items():
        if letter in matrices and term.signal != RATE:
            chain, matrix = term.filter(filters), matrices[letter]
            direct = direct + (chain[0].direct * matrix if chain else matrix)
            for shape in chain:
                poles.append(shape.pole * np.eye(len(matrix)))
                pushes.append(shape.memory * matrix)
    if np.linalg.cond(direct) > SINGULAR:
        raise NotMinimumPhaseError(
            f"the rate controller has no inverse: its direct gain from the setpoint, {direct.tolist()}, is singular"
        )
    inverse = np.linalg.inv(direct)
    n = len(direct)
    B = np.vstack([np.zeros((0, n)), *(push @ inverse for push in pushes)])
    A = block_diag(*poles) - np.hstack([B] * len(poles)) if poles else np.zeros((0, 0))
    return InverseLaw(A, B, inverse, np.linalg.eigvals(A))


def rebuild_rate_setpoint(gains: Matrices, u: Signal, rates: Signal) -> tuple[Signal, int]:
    """Rate setpoint with which the rate controller gives `u`: C_i^-1 u, (3.32)-(3.34) of the thesis.

    The inverse is solved by the Schur form of its state matrix, one first-order filter for each state.

    Parameters
    ----------
    gains : Gains
        Only the rate controller is used.
    u : (N, 2) array
        Torque (normalised) applied to the plant, excitation included: the output of the virtual controller.
    rates : (N, 2) array, rad/s
        Measured body rates.

    Returns
    -------
    r_i : (N, 2) array, rad/s
        The setpoint; its first samples contain the transient of the unknown initial integrator.
    settling : int, samples
        Time until that transient is below `SETTLED`.

    Raises
    ------
    NotMinimumPhaseError
        When the inverse is unstable or does not exist.
    """
    from scipy.signal import lfilter  # takes a second to import, which most commands do not need

    matrices, filters = rate_matrices(gains), gains.filters
    inverted = inverse_law(matrices, filters)
    A, B, inverse, eigenvalues = inverted.A, inverted.B, inverted.direct, inverted.eigenvalues
    # The state of an unused integrator (a zero row of Ki) is constant: an eigenvalue of exactly 1.
    at_rest = np.isclose(eigenvalues, 1.0, rtol=0, atol=ROUNDING)
    unstable = np.abs(eigenvalues[~at_rest]) >= 1
    if np.any(unstable) or (at_rest.any() and np.linalg.matrix_rank(B) + at_rest.sum() > len(A)):
        raise NotMinimumPhaseError(
            "the rate controller cannot be inverted, it is not minimum phase: eigenvalues of the inverse "
            f"{', '.join(f'{v:.6g}' for v in eigenvalues)}, expected inside the unit circle; "
            f"Ki_i = {matrices['I'].round(6).tolist()} should be positive definite"
        )
    known = u
    for letter, term in LOOP_TERMS.items():  # remove the part of u that the measured rates alone give
        if term.signal != ERROR:
            known = known - regressors(letter, rates, rates, rates, filters) @ matrices[letter].T
    n = u.shape[1]
    triangle, basis = schur(A, output="complex")
    drive = (known @ B.T) @ basis.conj()
    states = np.zeros_like(drive)
    for i in reversed(range(len(A))):  # upper triangular: the last state depends only on itself
        coupled = drive[:, i].copy()
        for j in range(i + 1, len(A)):
            coupled[1:] += triangle[i, j] * states[:-1, j]
        states[:, i] = lfilter([1], [1, -triangle[i, i]], coupled)
    parts = (states @ basis.T).real.reshape(len(u), -1, n).sum(axis=1)
    previous = np.vstack([np.zeros((1, n)), parts[:-1]])
    error = (known - previous) @ inverse.T
    moving = np.abs(eigenvalues[~at_rest])
    slowest = float(moving.max()) if len(moving) else 0.0
    settling = int(np.ceil(np.log(SETTLED) / np.log(slowest))) if 0 < slowest < 1 else 0
    return error + rates, settling
