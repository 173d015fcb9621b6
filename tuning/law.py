"""The linear part of the flown control law, as one table.

    r = Kp_o (r_o - y_o)                                attitude controller: rate setpoint
    u = Kp e + Ki I(e) - Kd D(y) + Kff r + u_bar        rate controller, e = r - y

With model following, roll and pitch follow an attitude model with angle th, rate w and acceleration al; see
`tuning.reference_model.followed_model`:

    r = Kp_o (th - y_o) + Kff_o w
    u = Kp e + Ki I(e) - Kd D(y) + Kff r + Kaff al + u_bar

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
from mimopilot.tuning.parameters import YAW_WEIGHT
from mimopilot.tuning.reference_model import ReferenceModel, followed_model

Signal = NDArray[np.float64]
Response = NDArray[np.complex128]

#: Signals of the rate controller that a term can act on.
ERROR, RATE, SETPOINT = "error", "rate", "setpoint"
#: Signals of the attitude model that a term can act on: outside of the loop.
MODEL_RATE, MODEL_ACCELERATION = "model rate", "model acceleration"
#: Condition number above which a matrix counts as singular in double precision.
SINGULAR = 1e12


@dataclass(frozen=True)
class Filters:
    """Period, filters and attitude model of the law.

    Attributes
    ----------
    Ts : float, s
        Control period.
    derivative_cutoff_hz : float, Hz
        Cut-off f_d of the derivative's first-order filter; 0 means no filter.
    model_omega : float, rad/s
        Natural frequency of the attitude model; 0 means no model following.
    model_damping : float
        Damping ratio of the attitude model.
    yaw_weight : float
        Weight of the yaw error in the attitude error, above 0 and at most 1.
    setpoint_slew : float, rad/s
        Slew limit of the attitude setpoint; 0 means none.
    """

    Ts: float
    derivative_cutoff_hz: float = 0.0
    model_omega: float = 0.0
    model_damping: float = 0.7
    yaw_weight: float = YAW_WEIGHT
    setpoint_slew: float = 0.0

    @property
    def derivative_pole(self) -> float:
        """Pole a = exp(-2 pi f_d Ts) of the derivative filter; 0 when f_d = 0."""
        return pole_of(self.derivative_cutoff_hz, self.Ts)

    @property
    def followed(self) -> ReferenceModel | None:
        """Attitude model of roll and of pitch; None: no model following."""
        return followed_model(self.model_omega, self.model_damping, self.Ts) if self.model_omega else None


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
        Signal that it acts on: `ERROR`, `RATE`, `SETPOINT`, `MODEL_RATE` or `MODEL_ACCELERATION`.
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
    "A": Term("Kaff_i", MODEL_ACCELERATION),
}
#: Those on signals of the rate loop. Tuning estimates them; the others do not change its stability.
LOOP_TERMS = {letter: term for letter, term in TERMS.items() if term.signal in (ERROR, RATE, SETPOINT)}


#: The attitude controller, which makes the rate setpoint; its error is that of the angles.
ATTITUDE = Term("Kp_o", ERROR)
#: Its feed-forward from the attitude model.
ATTITUDE_FEEDFORWARD = Term("Kff_o", MODEL_RATE)


class Matrices(Protocol):
    """A gain set, or several stacked: matrices (..., 2, 2) by the names of `TERMS`, and the filters."""

    @property
    def filters(self) -> Filters:
        """Period and filters."""


def rate_matrices(gains: Matrices) -> dict[str, Signal]:
    """Letter of `LOOP_TERMS` -> matrix of the rate controller."""
    return {letter: getattr(gains, term.matrix) for letter, term in LOOP_TERMS.items()}


def regressors(letters: str, error: Signal, rate: Signal, setpoint: Signal, filters: Filters) -> Signal:
    """Regressor x(k) of u(k) = B x(k), term by term.

    Parameters
    ----------
    letters : str
        Letters of `LOOP_TERMS`, in that order.
    error, rate, setpoint : (N, n) arrays
    filters : Filters

    Returns
    -------
    (N, n len(letters)) array
    """
    signals = {ERROR: error, RATE: rate, SETPOINT: setpoint}
    columns = []
    for letter in letters:
        term = LOOP_TERMS[letter]
        shape = term.filter(filters)
        filtered = signals[term.signal] if shape is None else shape.run(signals[term.signal])
        columns.append(filtered if term.sign > 0 else -filtered)
    return np.hstack(columns)


def rate_response(matrices: Mapping[str, Signal], filters: Filters, omega: Signal) -> tuple[Response, Response]:
    """Frequency response of the rate controller: u = C_r r - C_y y.

    Parameters
    ----------
    matrices : mapping
        Letter of `LOOP_TERMS` -> (..., n_u, n_y) matrix.
    filters : Filters
    omega : (K,) array, rad/s

    Returns
    -------
    C_r, C_y : (..., K, n_u, n_y) arrays
    """
    z = np.exp(1j * np.asarray(omega) * filters.Ts)[:, None, None]
    of_r: Any = np.zeros_like(z)
    of_y: Any = np.zeros_like(z)
    for letter, term in LOOP_TERMS.items():
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
        Letter of `LOOP_TERMS` -> (n_u, n) matrix.
    filters : Filters
    """
    n_u, n = np.shape(next(iter(matrices.values())))
    D = {signal: np.zeros((n_u, n)) for signal in (ERROR, RATE, SETPOINT)}
    poles: list[float] = []
    inputs: list[tuple[str, Signal]] = []
    outputs: list[Signal] = []
    for letter, term in LOOP_TERMS.items():
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


def model_response(filters: Filters, omega: Signal) -> tuple[Response, Response, Response]:
    """Frequency response of the attitude model, from attitude setpoint to its angle, rate and acceleration.

    Parameters
    ----------
    filters : Filters
        With a model; without one 1, 0 and 0: the setpoint itself, without feed-forward.
    omega : (K,) array, rad/s

    Returns
    -------
    angle, rate, acceleration : (K, 1, 1) arrays, 1, 1/s, 1/s^2
    """
    model, z = filters.followed, np.exp(1j * np.asarray(omega) * filters.Ts)[:, None, None]
    if model is None:
        return np.ones_like(z), np.zeros_like(z), np.zeros_like(z)
    angle = model.frequency_response(omega)[:, None, None]
    difference = (1 - 1 / z) / filters.Ts
    return angle, difference * angle, difference**2 * angle


def cascade_response(gains: Matrices, omega: Signal) -> tuple[Response, Response, Response]:
    """Frequency response of both controllers: u = C_ref r_o - C_o y_o - C_y y_i.

    Parameters
    ----------
    gains : Gains
    omega : (K,) array, rad/s

    Returns
    -------
    C_ref, C_o, C_y : (..., K, 2, 2) arrays
        Without model following C_ref is C_o.
    """
    of_r, of_y = rate_response(rate_matrices(gains), gains.filters, omega)
    of_angle = of_r @ attitude_matrix(gains)
    if gains.filters.followed is None:
        return of_angle, of_angle, of_y
    angle, rate, acceleration = model_response(gains.filters, omega)
    feedforward = of_r @ getattr(gains, ATTITUDE_FEEDFORWARD.matrix) * rate
    return of_angle * angle + feedforward + getattr(gains, TERMS["A"].matrix) * acceleration, of_angle, of_y


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
        matrix[:2, :2], matrix[2, 2] = getattr(gains, name), getattr(gains.yaw, name, 0.0)
        return matrix

    eye, none = np.eye(3), np.zeros((3, 3))
    roll_pitch, yaw = np.diag([1.0, 1.0, 0.0]), np.diag([0.0, 0.0, 1.0])
    angle, rate, acceleration = (roll_pitch * part for part in model_response(gains.filters, omega))
    attitude = whole(ATTITUDE.matrix)
    matrices = {letter: whole(term.matrix) for letter, term in LOOP_TERMS.items()}
    found = np.zeros((len(omega), 6, 12), np.complex128)
    found[:, :3] = np.hstack([none, -attitude, none, none])
    found[:, :3, :3] = attitude @ (angle + yaw) + whole(ATTITUDE_FEEDFORWARD.matrix) @ rate
    of_r, of_y = rate_response(matrices, gains.filters, omega)
    found[:, 3:] = of_r @ found[:, :3]
    found[:, 3:, :3] += whole(TERMS["A"].matrix) @ acceleration
    found[:, 3:, 6:9] -= of_y
    found[:, 3:, 9:] = eye
    return found
