"""The linear part of the flown control law, as one table.

    r = Kp_o (r_o - y_o)                                attitude controller: rate setpoint
    u = Kp e + Ki I(e) - Kd D(y) + Kff r + u_bar        rate controller, e = r - y

Each term is a gain matrix, the signal that it acts on and a first-order filter. All of tuning derives the law from
`TERMS`: VRFT's regressors, the inverse (`tuning.law_inverse`), the frequency response, the state space and the
predicted doublets. The generated C++ and its reference, `tuning.controller`, are written by hand. Tests compare the
response of the compiled C++ with `response`, for every parameter.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from mimopilot.tuning.parameter_row import pole_of

Signal = NDArray[np.float64]
Response = NDArray[np.complex128]

#: Signals of the rate controller that a term can act on.
ERROR, RATE, SETPOINT = "error", "rate", "setpoint"
#: Condition number above which a matrix counts as singular in double precision.
SINGULAR = 1e12


@dataclass(frozen=True)
class Filters:
    """Period and filters of the law.

    Attributes
    ----------
    Ts : float, s
        Control period.
    derivative_cutoff_hz : float, Hz
        Cut-off f_d of the derivative's first-order filter; 0 means no filter.
    """

    Ts: float
    derivative_cutoff_hz: float = 0.0

    @property
    def derivative_pole(self) -> float:
        """Pole a = exp(-2 pi f_d Ts) of the derivative filter; 0 when f_d = 0."""
        return pole_of(self.derivative_cutoff_hz, self.Ts)


@dataclass(frozen=True)
class Filter:
    """H(z) = gain (z - zero) / (divisor (z - pole)), zero = 1 for a difference and 0 otherwise.

    With a state x: y(k) = h s(k) + x(k), x(k+1) = pole x(k) + h (pole - zero) s(k), h = gain / divisor.
    """

    gain: float
    pole: float
    difference: bool = False
    divisor: float = 1.0

    @property
    def zero(self) -> float:
        """Zero of H."""
        return float(self.difference)

    @property
    def direct(self) -> float:
        """H at infinity: direct gain from input to output."""
        return self.gain / self.divisor

    @property
    def memory(self) -> float:
        """Gain from input to state."""
        return self.direct * (self.pole - self.zero)

    def run(self, signal: Signal) -> Signal:
        """Filter every column of `signal` (N, n), from rest; a difference begins with 0."""
        moved = np.diff(signal, axis=0, prepend=signal[:1]) if self.difference else signal
        moved = moved / self.divisor
        if self.pole == 1:
            return np.asarray(self.gain * np.cumsum(moved, axis=0), dtype=np.float64)
        from scipy.signal import lfilter  # takes a second to import, which most commands do not need

        return np.asarray(lfilter([self.gain], [1, -self.pole], moved, axis=0), dtype=np.float64)

    def times(self, matrix: Signal, z: Response) -> Response:
        """``matrix`` H(z)."""
        product: Response = matrix * self.gain * (z - self.zero) / (self.divisor * (z - self.pole))
        return product


@dataclass(frozen=True)
class Term:
    """One term of the rate controller.

    Attributes
    ----------
    matrix : str
        Name of its gain matrix in `tuning.gains.Gains`.
    signal : str
        Signal that it acts on: `ERROR`, `RATE` or `SETPOINT`.
    sign : int
        Sign with which it is added to u.
    filter : callable
        `Filters` -> its `Filter`; None: no filter.
    """

    matrix: str
    signal: str
    sign: int = 1
    filter: Callable[[Filters], Filter | None] = lambda filters: None


def _integral(filters: Filters) -> Filter:
    return Filter(gain=filters.Ts, pole=1.0)


def _derivative(filters: Filters) -> Filter:
    a = filters.derivative_pole
    return Filter(gain=1 - a, pole=a, difference=True, divisor=filters.Ts)


#: Letter -> term of the rate controller, in the order of its regressors and its sums.
TERMS = {
    "P": Term("Kp_i", ERROR),
    "I": Term("Ki_i", ERROR, filter=_integral),
    "D": Term("Kd_i", RATE, -1, _derivative),
    "F": Term("Kff_i", SETPOINT),
}


#: The attitude controller, which makes the rate setpoint; its error is that of the angles.
ATTITUDE = Term("Kp_o", ERROR)


class Matrices(Protocol):
    """A gain set, or several stacked: matrices (..., 2, 2) by the names of `TERMS`, and the filters."""

    @property
    def filters(self) -> Filters:
        """Period and filters."""


def rate_matrices(gains: Matrices) -> dict[str, Signal]:
    """Letter -> matrix of the rate controller."""
    return {letter: getattr(gains, term.matrix) for letter, term in TERMS.items()}


def regressors(letters: str, error: Signal, rate: Signal, setpoint: Signal, filters: Filters) -> Signal:
    """Regressor x(k) of u(k) = B x(k), term by term.

    Parameters
    ----------
    letters : str
        Letters of `TERMS`, in that order.
    error, rate, setpoint : (N, n) arrays
    filters : Filters

    Returns
    -------
    (N, n len(letters)) array
    """
    signals = {ERROR: error, RATE: rate, SETPOINT: setpoint}
    columns = []
    for letter in letters:
        term = TERMS[letter]
        shape = term.filter(filters)
        filtered = signals[term.signal] if shape is None else shape.run(signals[term.signal])
        columns.append(filtered if term.sign > 0 else -filtered)
    return np.hstack(columns)


def rate_response(matrices: Mapping[str, Signal], filters: Filters, omega: Signal) -> tuple[Response, Response]:
    """Frequency response of the rate controller: u = C_r r - C_y y.

    Parameters
    ----------
    matrices : mapping
        Letter -> (..., n_u, n_y) matrix.
    filters : Filters
    omega : (K,) array, rad/s

    Returns
    -------
    C_r, C_y : (..., K, n_u, n_y) arrays
    """
    z = np.exp(1j * np.asarray(omega) * filters.Ts)[:, None, None]
    of_r: Any = np.zeros_like(z)
    of_y: Any = np.zeros_like(z)
    for letter, term in TERMS.items():
        if letter in matrices:
            shape, matrix = term.filter(filters), term.sign * matrices[letter]
            part = matrix if shape is None else shape.times(matrix, z)
            of_r = of_r + part if term.signal in (ERROR, SETPOINT) else of_r
            of_y = of_y + part if term.signal == ERROR else of_y - part if term.signal == RATE else of_y
    return of_r, of_y


@dataclass(frozen=True, eq=False)
class StateSpaceLaw:
    """The rate controller as w(k+1) = A w + B_e e + B_y y + B_r r, u = C w + D_e e + D_y y + D_r r.

    Each filtered term has a state for each of its n inputs.

    Attributes
    ----------
    A, C : (m, m) and (n_u, m) arrays
    B, D : dict
        Signal -> (m, n) and (n_u, n) arrays.
    """

    A: Signal
    B: dict[str, Signal]
    C: Signal
    D: dict[str, Signal]


def state_space(matrices: Mapping[str, Signal], filters: Filters) -> StateSpaceLaw:
    """The rate controller in state space.

    Parameters
    ----------
    matrices : mapping
        Letter -> (n_u, n) matrix.
    filters : Filters
    """
    n_u, n = np.shape(next(iter(matrices.values())))
    D = {signal: np.zeros((n_u, n)) for signal in (ERROR, RATE, SETPOINT)}
    poles: list[float] = []
    inputs: list[tuple[str, Signal]] = []
    outputs: list[Signal] = []
    for letter, term in TERMS.items():
        if letter not in matrices:
            continue
        shape, matrix = term.filter(filters), term.sign * np.asarray(matrices[letter], float)
        D[term.signal] = D[term.signal] + (matrix if shape is None else shape.direct * matrix)
        if shape is not None:
            poles.append(shape.pole)
            inputs.append((term.signal, shape.memory * np.eye(n)))
            outputs.append(matrix)
    none = np.zeros((n, n))
    B = {signal: np.vstack([np.zeros((0, n)), *(b if s == signal else none for s, b in inputs)]) for signal in D}
    A = np.diag(np.repeat(poles, n))
    return StateSpaceLaw(A, B, np.hstack([np.zeros((n_u, 0)), *outputs]), D)


def attitude_matrix(gains: Matrices) -> Signal:
    """Matrix of the attitude controller."""
    matrix: Signal = getattr(gains, ATTITUDE.matrix)
    return matrix


def cascade_response(gains: Matrices, omega: Signal) -> tuple[Response, Response]:
    """Frequency response of both controllers: u = C_o (r_o - y_o) - C_y y_i.

    Parameters
    ----------
    gains : Gains or GainStack
    omega : (K,) array, rad/s

    Returns
    -------
    C_o, C_y : (..., K, 2, 2) arrays
    """
    of_r, of_y = rate_response(rate_matrices(gains), gains.filters, omega)
    return of_r @ attitude_matrix(gains), of_y


class AllAxes(Matrices, Protocol):
    """A gain set with the scalars of the yaw axis, by the names of `TERMS`."""

    @property
    def yaw(self) -> Any:
        """The scalars."""


def response(gains: AllAxes, omega: Signal) -> Response:
    """Frequency response of the whole law for small signals, without its limits.

    Parameters
    ----------
    gains : Gains
    omega : (K,) array, rad/s

    Returns
    -------
    (K, 6, 12) array
        From attitude setpoint (rad), attitude (rad), body rates (rad/s) and excitation, three axes each, to rate
        setpoint (rad/s) and torque (normalised).
    """

    def whole(name: str) -> Signal:
        matrix = np.zeros((3, 3))
        matrix[:2, :2], matrix[2, 2] = getattr(gains, name), getattr(gains.yaw, name)
        return matrix

    attitude, eye, none = whole(ATTITUDE.matrix), np.eye(3), np.zeros((3, 3))
    matrices = {letter: whole(term.matrix) for letter, term in TERMS.items()}
    found = np.zeros((len(omega), 6, 12), np.complex128)
    found[:, :3] = np.hstack([attitude, -attitude, none, none])
    of_r, of_y = rate_response(matrices, gains.filters, omega)
    found[:, 3:] = of_r @ found[:, :3]
    found[:, 3:, 6:9] -= of_y
    found[:, 3:, 9:] = eye
    return found
