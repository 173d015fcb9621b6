"""Linear systems in discrete state space: identified plants and benchmarks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mimopilot.tuning.errors import TuningError

Signal = NDArray[np.float64]
Response = NDArray[np.complex128]


@dataclass(frozen=True, eq=False)
class StateSpace:
    """x(k+1) = A x(k) + B u(k), y(k) = C x(k) + D u(k).

    Attributes
    ----------
    A, B, C, D : (n, n), (n, n_u), (n_y, n), (n_y, n_u) arrays
        The state has no unit; B, C and D have those of u and y.
    Ts : float, s
        Sampling period.

    Raises
    ------
    TuningError
        When the shapes do not match.
    """

    A: Signal
    B: Signal
    C: Signal
    D: Signal
    Ts: float

    def __post_init__(self) -> None:
        n, n_u, n_y = len(self.A), self.B.shape[1], len(self.C)
        got = tuple(matrix.shape for matrix in (self.A, self.B, self.C, self.D))
        if got != ((n, n), (n, n_u), (n_y, n), (n_y, n_u)):
            raise TuningError(
                f"state space: got A, B, C, D of shapes {got}, expected (n, n), (n, n_u), (n_y, n), (n_y, n_u)"
            )

    @property
    def poles(self) -> Response:
        """Eigenvalues of A, largest modulus first."""
        values = np.linalg.eigvals(self.A).astype(np.complex128)
        # Rounded keys: the moduli of conjugates differ in the last digit, and the order must not depend on it.
        order = np.lexsort((values.imag.round(12), -np.abs(values).round(12)))
        sorted_values: Response = values[order]
        return sorted_values

    @property
    def stable(self) -> bool:
        """Whether every pole is inside the unit circle."""
        return bool(np.all(np.abs(np.linalg.eigvals(self.A)) < 1))

    def frequency_response(self, omega: Signal) -> Response:
        """C (z I - A)^-1 B + D at z = exp(j omega Ts).

        Parameters
        ----------
        omega : (F,) array, rad/s

        Returns
        -------
        (F, n_y, n_u) array
        """
        z = np.exp(1j * np.asarray(omega) * self.Ts)
        pencil = z[:, None, None] * np.eye(len(self.A)) - self.A
        states = np.linalg.solve(pencil, np.broadcast_to(self.B, (len(z), *self.B.shape)))
        return np.asarray(self.C @ states + self.D, dtype=np.complex128)

    def simulate(self, u: Signal) -> Signal:
        """Output from rest.

        Parameters
        ----------
        u : (N, ..., n_u) array
            Input, time first; further axes are independent runs.

        Returns
        -------
        (N, ..., n_y) array
        """
        drive = u @ self.B.T
        states = np.empty((*u.shape[:-1], len(self.A)))
        state = np.zeros(states.shape[1:])
        transition = np.ascontiguousarray(self.A.T)
        for k in range(len(u)):
            states[k] = state
            state = state @ transition + drive[k]
        return np.asarray(states @ self.C.T + u @ self.D.T, dtype=np.float64)
