"""The linear part of the flown control law: its responses, from its table of terms.

    r = Kp_o (r_o - y_o)                                attitude controller: rate setpoint
    u = Kp e + Ki I(e) - Kd D(y) + Kff r + u_bar        rate controller, e = r - y

With model following, roll and pitch follow an attitude model with angle th, rate w and acceleration al; see
`tuning.reference_model.followed_model`:

    r = Kp_o (th - y_o) + Kff_o w
    u = Kp e + Ki I(e) - Kd D(y) + Kff r + Kaff al + u_bar

Each term is a gain matrix, the signal that it acts on and its filters; `tuning.law_terms` has those of this law,
`tuning.stock_laws` those of the stock ones. All of tuning derives the law from the table of the set's
`tuning.control_laws.control_law`: VRFT's regressors, the inverse (`tuning.law_inverse`), the frequency response, the
state space (`tuning.law_state_space`) and the predicted doublets. The generated C++ and its reference,
`tuning.controller`, are written by hand. Tests compare the response of the compiled C++ with `response`, for every
parameter.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from mimopilot.tuning.control_laws import control_law
from mimopilot.tuning.first_order_filter import Chain, Response, Signal
from mimopilot.tuning.law_filters import Filters
from mimopilot.tuning.law_terms import (
    ATTITUDE,
    ATTITUDE_FEEDFORWARD,
    ERROR,
    LOOP_TERMS,
    RATE,
    SETPOINT,
    TERMS,
)

#: Condition number above which a matrix counts as singular in double precision.
SINGULAR = 1e12


class Matrices(Protocol):
    """A gain set, or several stacked: matrices (..., 2, 2) by the names of `TERMS`, and the filters."""

    @property
    def filters(self) -> Filters:
        """Period and filters."""


def rate_matrices(gains: Matrices) -> dict[str, Signal]:
    """Letter of the law's terms -> matrix of the rate controller."""
    tuned = {letter: getattr(gains, term.matrix) for letter, term in LOOP_TERMS.items()}
    return tuned | fixed_matrices(gains.filters, np.shape(tuned["P"])[-1])


def fixed_matrices(filters: Filters, n: int) -> dict[str, Signal]:
    """Letter -> (n, n) matrix of the law's terms with a gain that is not tuned; most have none."""
    fixed = {letter: term for letter, term in control_law(filters).terms.items() if letter not in LOOP_TERMS}
    return {letter: np.diag(getattr(filters.stock, term.matrix)[:n]) for letter, term in fixed.items()}


def _run(chain: Chain, signal: Signal) -> Signal:
    for one in chain:
        signal = one.run(signal)
    return signal


def _times(matrix: Signal | Response, chain: Chain, z: Response) -> Any:
    """``matrix`` times the filters of its columns."""
    for one in chain:
        matrix = one.times(matrix, z)
    return matrix


def regressors(letters: str, error: Signal, rate: Signal, setpoint: Signal, filters: Filters) -> Signal:
    """Regressor x(k) of u(k) = B x(k), term by term.

    Parameters
    ----------
    letters : str
        Letters of `LOOP_TERMS`, in that order.
    error, rate, setpoint : (N, n) arrays
        Of the first n axes of the filters, see `Filters.on`; the error is that of the setpoint as given.
    filters : Filters

    Returns
    -------
    (N, n len(letters)) array
    """
    filters = filters.on(slice(0, error.shape[1]))
    reached = _run(control_law(filters).setpoint(filters), setpoint)
    if reached is not setpoint:
        error = error + (reached - setpoint)
    signals = {ERROR: error, RATE: rate, SETPOINT: reached}
    columns = []
    for letter in letters:
        term = control_law(filters).terms[letter]
        filtered = _run(term.filter(filters), signals[term.signal])
        columns.append(filtered if term.sign > 0 else -filtered)
    return np.hstack(columns)


def rate_response(matrices: Mapping[str, Signal], filters: Filters, omega: Signal) -> tuple[Response, Response]:
    """Frequency response of the rate controller: u = C_r r - C_y y.

    Parameters
    ----------
    matrices : mapping
        Letter of the law's terms -> (..., n_u, n_y) matrix.
    filters : Filters
        Their first n_y axes are those of the columns, see `Filters.on`.
    omega : (K,) array, rad/s

    Returns
    -------
    C_r, C_y : (..., K, n_u, n_y) arrays
    """
    z = np.exp(1j * np.asarray(omega) * filters.Ts)[:, None, None]
    of_r: Any = np.zeros_like(z)
    of_y: Any = np.zeros_like(z)
    filters = filters.on(slice(0, np.shape(next(iter(matrices.values()), of_r))[-1]))
    for letter, term in control_law(filters).terms.items():
        if letter in matrices:
            part = _times(term.sign * matrices[letter], term.filter(filters), z)
            of_r = of_r + part if term.signal in (ERROR, SETPOINT) else of_r
            of_y = of_y + part if term.signal == ERROR else of_y - part if term.signal == RATE else of_y
    return _times(of_r, control_law(filters).setpoint(filters), z), of_y


def attitude_matrix(gains: Matrices) -> Signal:
    """Matrix of the attitude controller."""
    matrix: Signal = getattr(gains, ATTITUDE.matrix)
    return matrix


def attitude_response(filters: Filters, omega: Signal) -> Response:
    """Delay of a rate setpoint from the attitude controller to the rate controller, (K, 1, 1)."""
    delay: Response = np.exp(-1j * np.asarray(omega) * filters.Ts * control_law(filters).delay)[:, None, None]
    return delay


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


def setpoint_rate_response(filters: Filters, n: int, omega: Signal) -> Response:
    """Fixed feed-forward from ArduPilot's logged attitude setpoint to the rate setpoint, (K, n, n), 1/s.

    ArduPilot's shaping gives the rate by which the setpoint moves until the next period, and that acts a period later:
    the setpoint's difference. With model following, that of roll and pitch is the model's.
    """
    z = np.exp(1j * np.asarray(omega) * filters.Ts)[:, None, None]
    of_model = 0 if filters.followed is None else 2
    on = np.diag([float(T > 0 and axis >= of_model) for axis, T in enumerate(filters.shaping[:n])])
    return np.asarray((1 - 1 / z) / filters.Ts * on, np.complex128)


def shaping_response(filters: Filters, omega: Signal) -> NDArray[np.complex128]:
    """Response (K,) of the autopilot's shaping, from the given attitude setpoint to the logged one, of its first axis.

    Without its limits of acceleration and jerk.
    """
    return np.asarray((1 + 1j * omega * filters.shaping[0]) ** -2, np.complex128)


def cascade_response(gains: Matrices, omega: Signal) -> tuple[Response, Response, Response]:
    """Frequency response of both controllers: u = C_ref r_o - C_o y_o - C_y y_i.

    Parameters
    ----------
    gains : Gains
    omega : (K,) array, rad/s

    Returns
    -------
    C_ref, C_o, C_y : (..., K, 2, 2) arrays
        Without model following C_ref is C_o, but for ArduPilot's feed-forward of the setpoint's rate.
    """
    of_r, of_y = rate_response(rate_matrices(gains), gains.filters, omega)
    of_angle = of_r @ attitude_matrix(gains) * attitude_response(gains.filters, omega)
    if gains.filters.followed is None:
        fixed = setpoint_rate_response(gains.filters, np.shape(of_r)[-1], omega)
        return of_angle + of_r @ fixed, of_angle, of_y
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
    matrices = {letter: whole(term.matrix) for letter, term in LOOP_TERMS.items()} | fixed_matrices(gains.filters, 3)
    found = np.zeros((len(omega), 6, 12), np.complex128)
    found[:, :3] = np.hstack([none, -attitude, none, none])
    found[:, :3, :3] = attitude @ (angle + yaw) + whole(ATTITUDE_FEEDFORWARD.matrix) @ rate
    fixed = setpoint_rate_response(gains.filters, 3, omega)
    of_r, of_y = rate_response(matrices, gains.filters, omega)
    found[:, 3:] = of_r @ found[:, :3] * attitude_response(gains.filters, omega)
    found[:, 3:, :3] += of_r @ fixed
    # The rate setpoint of this period acts in the next one.
    found[:, :3, :3] += fixed / attitude_response(gains.filters, omega)
    found[:, 3:, :3] += whole(TERMS["A"].matrix) @ acceleration
    found[:, 3:, 6:9] -= of_y
    found[:, 3:, 9:] = eye
    return found
