"""One loop: a controller that is linear in its gains, and its closed loop around a plant."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from mimopilot.tuning import law
from mimopilot.tuning.errors import TuningError
from mimopilot.tuning.law_filters import Filters
from mimopilot.tuning.law_state_space import state_space
from mimopilot.tuning.law_terms import ERROR, LOOP_TERMS, RATE, SETPOINT
from mimopilot.tuning.statespace import Response, Signal, StateSpace


@dataclass(frozen=True, eq=False)
class LoopController:
    """u = B x: the flown law of one loop, without its limits; see `tuning.law`.

    Attributes
    ----------
    gains : mapping
        Term (``P``, ``I``, ``D``, ``F``) -> (n_u, n_y) array; the structure has no other terms.
    filters : Filters
        Sampling period and filters.

    Raises
    ------
    TuningError
        When there is no term, a term is unknown, or the matrices differ in shape.
    """

    gains: Mapping[str, Signal]
    filters: Filters

    def __post_init__(self) -> None:
        shapes = {np.shape(matrix) for matrix in self.gains.values()}
        if not self.gains or set(self.gains) - set(LOOP_TERMS) or len(shapes) != 1 or len(shapes.pop()) != 2:
            raise TuningError(
                f"controller: got terms {sorted(self.gains)}, expected letters of {''.join(LOOP_TERMS)}, "
                "one shape for all"
            )

    @classmethod
    def from_polynomial(cls, B0: object, B1: object, Ts: float) -> LoopController:
        """A PI from the thesis' form (B0 z + B1)/(z - 1): Kp = -B1, Ki = (B0 + B1)/Ts."""
        first, second = np.asarray(B0, float), np.asarray(B1, float)
        return cls({"P": -second, "I": (first + second) / Ts}, Filters(Ts))

    def polynomial(self) -> tuple[Signal, Signal]:
        """B0 and B1 of a PI; see `from_polynomial`."""
        Kp, Ki = self.gain("P"), self.gain("I")
        return Kp + self.filters.Ts * Ki, -Kp

    @property
    def terms(self) -> str:
        """Structure: letters of ``PIDF`` in that order."""
        return "".join(term for term in LOOP_TERMS if term in self.gains)

    def gain(self, term: str) -> Signal:
        """Matrix of a term; zeros if the structure lacks it."""
        first = next(iter(self.gains.values()))
        return np.asarray(self.gains.get(term, np.zeros_like(first)), float)

    @property
    def matrix(self) -> Signal:
        """B of u = B x: the terms' matrices side by side, (n_u, n_y len(terms))."""
        return np.hstack([self.gain(term) for term in self.terms])

    def with_matrix(self, B: Signal) -> LoopController:
        """The same structure with other gains; inverse of `matrix`."""
        parts = np.split(B, len(self.terms), axis=1)
        return LoopController(dict(zip(self.terms, parts, strict=True)), self.filters)

    def shapes(self, omega: Signal) -> tuple[Response, Response]:
        """Response of the regressors to the reference and the output: x = Phi_r r - Phi_y y.

        Parameters
        ----------
        omega : (F,) array, rad/s

        Returns
        -------
        Phi_r, Phi_y : (F, n_y len(terms), n_y) arrays
        """
        eye = np.eye(self.gain("P").shape[1])
        responses = [law.rate_response({term: eye}, self.filters, omega) for term in self.terms]
        of_r, of_y = (np.concatenate(parts, axis=1) for parts in zip(*responses, strict=True))
        return of_r, of_y


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

    u_bar is added at the plant's input, v to the measured output. The algebraic loop of a plant with D is solved.

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
    flown = state_space(controller.gains, controller.filters)
    # u = C w + direct_r r - direct_y y, e = r - y
    direct_r = flown.D[ERROR] + flown.D[SETPOINT]
    direct_y = flown.D[ERROR] - flown.D[RATE]
    loop = np.eye(n_u) + direct_y @ plant.D
    if np.linalg.cond(loop) > law.SINGULAR:
        raise TuningError("the algebraic loop of plant and controller has no solution: I + K D is singular")
    X = np.linalg.inv(loop)
    m = len(flown.A)
    u_x = X @ np.hstack([-direct_y @ plant.C, flown.C])
    u_w = X @ np.hstack([direct_r, np.eye(n_u), -direct_y])
    y_x = np.hstack([plant.C, np.zeros((n_y, m))]) + plant.D @ u_x
    y_w = np.hstack([np.zeros((n_y, n_y + n_u)), np.eye(n_y)]) + plant.D @ u_w
    r_w = np.hstack([np.eye(n_y), np.zeros((n_y, n_u + n_y))])
    of_x = {ERROR: -y_x, RATE: y_x, SETPOINT: np.zeros_like(y_x)}
    of_w = {ERROR: r_w - y_w, RATE: y_w, SETPOINT: r_w}
    A = np.vstack(
        [
            np.hstack([plant.A, np.zeros((n, m))]) + plant.B @ u_x,
            np.hstack([np.zeros((m, n)), flown.A]) + sum(flown.B[signal] @ of_x[signal] for signal in of_x),
        ]
    )
    B = np.vstack([plant.B @ u_w, sum(flown.B[signal] @ of_w[signal] for signal in of_w)])
    return StateSpace(A, B, np.vstack([u_x, y_x]), np.vstack([u_w, y_w]), controller.filters.Ts)
