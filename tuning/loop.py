"""One loop: a controller that is linear in its gains, around a plant, in time and in frequency."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from mimopilot.tuning.errors import TuningError
from mimopilot.tuning.estimation.vrft import TERMS
from mimopilot.tuning.gains import derivative_pole
from mimopilot.tuning.statespace import Response, Signal, StateSpace


@dataclass(frozen=True, eq=False)
class LoopController:
    """u = Kp e + I - Kd d + Kff r: the flown difference equation of one loop, without its limits.

    Attributes
    ----------
    gains : mapping
        Term (``P``, ``I``, ``D``, ``F``) -> (n_u, n_y) array; a term that is not there is not in the structure.
    Ts : float, s
        Sampling period.
    derivative_cutoff_hz : float, Hz
        Of the filter in d; 0: none.

    Raises
    ------
    TuningError
        When there is no term, an unknown one, or the matrices differ in shape.
    """

    gains: Mapping[str, Signal]
    Ts: float
    derivative_cutoff_hz: float = 0.0

    def __post_init__(self) -> None:
        shapes = {np.shape(matrix) for matrix in self.gains.values()}
        if not self.gains or set(self.gains) - set(TERMS) or len(shapes) != 1 or len(shapes.pop()) != 2:
            raise TuningError(
                f"controller: got terms {sorted(self.gains)}, expected letters of {TERMS}, one shape for all"
            )

    @classmethod
    def from_polynomial(cls, B0: object, B1: object, Ts: float) -> LoopController:
        """The PI (B0 z + B1)/(z - 1), the thesis' form: Kp = -B1, Ki = (B0 + B1)/Ts."""
        first, second = np.asarray(B0, float), np.asarray(B1, float)
        return cls({"P": -second, "I": (first + second) / Ts}, Ts)

    def polynomial(self) -> tuple[Signal, Signal]:
        """B0 and B1 of a PI; see `from_polynomial`."""
        Kp, Ki = self.gain("P"), self.gain("I")
        return Kp + self.Ts * Ki, -Kp

    @property
    def terms(self) -> str:
        """The structure: letters of ``PIDF`` in that order."""
        return "".join(term for term in TERMS if term in self.gains)

    def gain(self, term: str) -> Signal:
        """Matrix of a term; zeros when the structure does not have it."""
        first = next(iter(self.gains.values()))
        return np.asarray(self.gains.get(term, np.zeros_like(first)), float)

    @property
    def matrix(self) -> Signal:
        """B of u = B x: the terms' matrices side by side, (n_u, n_y len(terms))."""
        return np.hstack([self.gain(term) for term in self.terms])

    def with_matrix(self, B: Signal) -> LoopController:
        """The same structure with other gains; inverse of `matrix`."""
        parts = np.split(B, len(self.terms), axis=1)
        return LoopController(dict(zip(self.terms, parts, strict=True)), self.Ts, self.derivative_cutoff_hz)

    def shapes(self, omega: Signal) -> tuple[Response, Response]:
        """How each term sees the reference and the output: x = Phi_r r - Phi_y y.

        Parameters
        ----------
        omega : (F,) array, rad/s

        Returns
        -------
        Phi_r, Phi_y : (F, n_y len(terms), n_y) arrays
        """
        z = np.exp(1j * np.asarray(omega) * self.Ts)
        a = derivative_pole(self.derivative_cutoff_hz, self.Ts)
        one, none = np.ones_like(z), np.zeros_like(z)
        integral = self.Ts * z / (z - 1)
        derivative = (1 - a) * (z - 1) / (self.Ts * (z - a))
        of_r = {"P": one, "I": integral, "D": none, "F": one}
        of_y = {"P": one, "I": integral, "D": derivative, "F": none}
        eye = np.eye(self.gain("P").shape[1])

        def stacked(of: dict[str, Response]) -> Response:
            columns = np.stack([of[term] for term in self.terms], axis=1)
            blocks: Response = np.einsum("ft,ij->ftij", columns, eye).reshape(len(z), -1, len(eye))
            return blocks

        return stacked(of_r), stacked(of_y)


def complementary_sensitivity(plant: Response, controller: LoopController, omega: Signal) -> Response:
    """T from r to y, (I + G B Phi_y)^-1 G B Phi_r; for a PI (I + G C)^-1 G C.

    Parameters
    ----------
    plant : (F, n_y, n_u) array
        Frequency response G at `omega`.
    controller : LoopController
    omega : (F,) array, rad/s

    Returns
    -------
    (F, n_y, n_y) array
    """
    of_r, of_y = controller.shapes(omega)
    open_loop = plant @ controller.matrix
    closed = np.linalg.solve(np.eye(plant.shape[1]) + open_loop @ of_y, open_loop @ of_r)
    return np.asarray(closed, dtype=np.complex128)


def closed_loop(plant: StateSpace, controller: LoopController) -> StateSpace:
    """The loop in state space: inputs [r, u_bar, v], outputs [u, y].

    u_bar is added at the plant's input, v to the measured output. A plant with D makes an algebraic loop,
    which is solved.

    Parameters
    ----------
    plant : StateSpace
        n_u inputs, n_y outputs.
    controller : LoopController

    Returns
    -------
    StateSpace
        Inputs r (n_y), u_bar (n_u), v (n_y); outputs u (n_u), y (n_y), the output as measured.

    Raises
    ------
    TuningError
        When the algebraic loop has no solution.
    """
    n, n_u, n_y = len(plant.A), plant.B.shape[1], len(plant.C)
    Ts, a = controller.Ts, derivative_pole(controller.derivative_cutoff_hz, controller.Ts)
    Kp, Ki, Kd, Kff = (controller.gain(term) for term in TERMS)
    slope = (1 - a) / Ts
    # Controller states: s, the sum of past errors, and w, the memory of the derivative, d = slope y + w.
    direct_r = Kp + Ts * Ki + Kff
    direct_y = Kp + Ts * Ki + slope * Kd
    loop = np.eye(n_u) + direct_y @ plant.D
    if np.linalg.cond(loop) > 1e12:
        raise TuningError("the algebraic loop of plant and controller has no solution: I + K D is singular")
    X = np.linalg.inv(loop)
    u_x = X @ np.hstack([-direct_y @ plant.C, Ki, -Kd])
    u_w = X @ np.hstack([direct_r, np.eye(n_u), -direct_y])
    y_x = np.hstack([plant.C, np.zeros((n_y, 2 * n_y))]) + plant.D @ u_x
    y_w = np.hstack([np.zeros((n_y, n_y + n_u)), np.eye(n_y)]) + plant.D @ u_w
    zero, eye = np.zeros((n_y, n)), np.eye(n_y)
    r_w = np.hstack([eye, np.zeros((n_y, n_u + n_y))])
    A = np.vstack(
        [
            np.hstack([plant.A, np.zeros((n, 2 * n_y))]) + plant.B @ u_x,
            np.hstack([zero, eye, 0 * eye]) - Ts * y_x,
            np.hstack([zero, 0 * eye, a * eye]) + slope * (a - 1) * y_x,
        ]
    )
    B = np.vstack([plant.B @ u_w, Ts * (r_w - y_w), slope * (a - 1) * y_w])
    if "D" not in controller.gains:
        A, B, u_x, y_x = A[:-n_y, :-n_y], B[:-n_y], u_x[:, :-n_y], y_x[:, :-n_y]
    if "I" not in controller.gains:
        keep = np.r_[0:n, n + n_y : len(A)]
        A, B, u_x, y_x = A[np.ix_(keep, keep)], B[keep], u_x[:, keep], y_x[:, keep]
    return StateSpace(A, B, np.vstack([u_x, y_x]), np.vstack([u_w, y_w]), Ts)
