"""The vehicle's body: Newton-Euler equations, motors, drag; fixed-step Runge-Kutta, compiled by numba.

Axes: body FRD, earth NED; the quaternion (w, x, y, z) rotates body vectors into earth. The state vector is
position (3, m), velocity (3, m/s), quaternion (4), body rates (3, rad/s), rotor speeds (n, rad/s).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sitl.compiled import compiled
from sitl.errors import SitlError

GRAVITY = 9.80665  # m/s^2, standard gravity
STEP = 1e-3  # s, of the Runge-Kutta scheme

POSITION, QUATERNION, ROTORS = 0, 6, 13


class PlantParameters(NamedTuple):
    """Physical constants of a vehicle, about its true centre of gravity.

    Attributes
    ----------
    mass : float, kg
    inertia, inertia_inverse : (3, 3) arrays, kg m^2 and its inverse
        The tensor: its off-diagonals are minus the products of inertia.
    rotors : (n, 3) array, m
        Position of each rotor relative to the centre of gravity.
    spin : (n,) array
        +1 for a rotor whose reaction turns the nose right (turning counter-clockwise from above), else -1.
    thrust_max : float, N
        Thrust of one motor at command 1.
    thrust_coefficient : float, N s^2
        Thrust is this times the squared rotor speed.
    torque_ratio : float, m
        Reaction torque over thrust.
    motor_time_constant : float, s
        Lag of the rotor speed.
    rate_damping : (3,) array, N m s
        Damping moment for each body rate.
    drag : float, N s/m
        Linear drag against the air.
    wind : (3,) array, m/s
        Velocity of the air, NED.
    """

    mass: float
    inertia: NDArray[np.float64]
    inertia_inverse: NDArray[np.float64]
    rotors: NDArray[np.float64]
    spin: NDArray[np.float64]
    thrust_max: float
    thrust_coefficient: float
    torque_ratio: float
    motor_time_constant: float
    rate_damping: NDArray[np.float64]
    drag: float
    wind: NDArray[np.float64]


@compiled
def angular_acceleration(J, J_inverse, p, q, r, L, M, N):  # type: ignore[no-untyped-def]
    """Euler's equation, J^-1 (moment - rates x J rates)."""
    h0 = J[0, 0] * p + J[0, 1] * q + J[0, 2] * r
    h1 = J[1, 0] * p + J[1, 1] * q + J[1, 2] * r
    h2 = J[2, 0] * p + J[2, 1] * q + J[2, 2] * r
    m0 = L - (q * h2 - r * h1)
    m1 = M - (r * h0 - p * h2)
    m2 = N - (p * h1 - q * h0)
    return (
        J_inverse[0, 0] * m0 + J_inverse[0, 1] * m1 + J_inverse[0, 2] * m2,
        J_inverse[1, 0] * m0 + J_inverse[1, 1] * m1 + J_inverse[1, 2] * m2,
        J_inverse[2, 0] * m0 + J_inverse[2, 1] * m1 + J_inverse[2, 2] * m2,
    )


@compiled
def quaternion_derivative(w, x, y, z, p, q, r):  # type: ignore[no-untyped-def]
    """Half the product of the quaternion and the body rates."""
    return (
        0.5 * (-x * p - y * q - z * r),
        0.5 * (w * p + y * r - z * q),
        0.5 * (w * q + z * p - x * r),
        0.5 * (w * r + x * q - y * p),
    )


@compiled
def _normalise(state, first):  # type: ignore[no-untyped-def]
    """Scale the quaternion at `first` to length one."""
    w, x, y, z = state[first], state[first + 1], state[first + 2], state[first + 3]
    scale = 1.0 / np.sqrt(w * w + x * x + y * y + z * z)
    for i in range(4):
        state[first + i] *= scale


@compiled
def derivative(state, speeds, plant, out):  # type: ignore[no-untyped-def]
    """Time derivative of the state, into `out`; `speeds` are the rotor speed commands, rad/s."""
    vx, vy, vz = state[3], state[4], state[5]
    w, x, y, z = state[6], state[7], state[8], state[9]
    p, q, r = state[10], state[11], state[12]
    thrust = 0.0
    L = -plant.rate_damping[0] * p
    M = -plant.rate_damping[1] * q
    N = -plant.rate_damping[2] * r
    for i in range(plant.rotors.shape[0]):
        speed = state[ROTORS + i]
        force = plant.thrust_coefficient * speed * speed
        thrust += force
        L -= plant.rotors[i, 1] * force
        M += plant.rotors[i, 0] * force
        N += plant.spin[i] * plant.torque_ratio * force
        out[ROTORS + i] = (speeds[i] - speed) / plant.motor_time_constant
    out[0], out[1], out[2] = vx, vy, vz
    lift, drag = thrust / plant.mass, plant.drag / plant.mass
    out[3] = -2.0 * (x * z + w * y) * lift - drag * (vx - plant.wind[0])
    out[4] = -2.0 * (y * z - w * x) * lift - drag * (vy - plant.wind[1])
    out[5] = GRAVITY - (1.0 - 2.0 * (x * x + y * y)) * lift - drag * (vz - plant.wind[2])
    out[6], out[7], out[8], out[9] = quaternion_derivative(w, x, y, z, p, q, r)
    out[10], out[11], out[12] = angular_acceleration(plant.inertia, plant.inertia_inverse, p, q, r, L, M, N)


@compiled
def advance(state, commands, plant, steps, step, work):  # type: ignore[no-untyped-def]
    """Integrate in place over `steps` Runge-Kutta steps with motor commands (thrust fractions 0..1) held.

    `work` is scratch space, (6, len(state)).
    """
    n = state.shape[0]
    k1, k2, k3, k4, at, speeds = work[0], work[1], work[2], work[3], work[4], work[5]
    for i in range(plant.rotors.shape[0]):
        fraction = min(max(float(commands[i]), 0.0), 1.0)
        speeds[i] = np.sqrt(fraction * plant.thrust_max / plant.thrust_coefficient)
    for _ in range(steps):
        derivative(state, speeds, plant, k1)
        for i in range(n):
            at[i] = state[i] + 0.5 * step * k1[i]
        derivative(at, speeds, plant, k2)
        for i in range(n):
            at[i] = state[i] + 0.5 * step * k2[i]
        derivative(at, speeds, plant, k3)
        for i in range(n):
            at[i] = state[i] + step * k3[i]
        derivative(at, speeds, plant, k4)
        for i in range(n):
            state[i] += step / 6.0 * (k1[i] + 2.0 * k2[i] + 2.0 * k3[i] + k4[i])
        _normalise(state, QUATERNION)


@compiled
def _rotate(x, J, J_inverse, L, M, N, out):  # type: ignore[no-untyped-def]
    """Derivative of (quaternion, rates) under a body moment."""
    out[0], out[1], out[2], out[3] = quaternion_derivative(x[0], x[1], x[2], x[3], x[4], x[5], x[6])
    out[4], out[5], out[6] = angular_acceleration(J, J_inverse, x[4], x[5], x[6], L, M, N)


@compiled
def _integrate(J, J_inverse, moments, step, substeps, x, rates, quaternions):  # type: ignore[no-untyped-def]
    k1, k2, k3, k4, at = np.empty(7), np.empty(7), np.empty(7), np.empty(7), np.empty(7)
    for k in range(moments.shape[0]):
        L, M, N = moments[k, 0], moments[k, 1], moments[k, 2]
        for _ in range(substeps):
            _rotate(x, J, J_inverse, L, M, N, k1)
            for i in range(7):
                at[i] = x[i] + 0.5 * step * k1[i]
            _rotate(at, J, J_inverse, L, M, N, k2)
            for i in range(7):
                at[i] = x[i] + 0.5 * step * k2[i]
            _rotate(at, J, J_inverse, L, M, N, k3)
            for i in range(7):
                at[i] = x[i] + step * k3[i]
            _rotate(at, J, J_inverse, L, M, N, k4)
            for i in range(7):
                x[i] += step / 6.0 * (k1[i] + 2.0 * k2[i] + 2.0 * k3[i] + k4[i])
            _normalise(x, 0)
        quaternions[k + 1] = x[:4]
        rates[k + 1] = x[4:]


def integrate_moments(
    inertia: ArrayLike,
    moments: ArrayLike,
    dt: float,
    omega0: ArrayLike,
    substeps: int = 1,
    quaternion0: ArrayLike = (1.0, 0.0, 0.0, 0.0),
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The rigid body alone, under pure body moments: for comparison with closed forms.

    Parameters
    ----------
    inertia : (3, 3) array, kg m^2
        Inertia tensor (off-diagonals are minus the products of inertia).
    moments : (N, 3) array, N m
        Body moments, each held over `dt`.
    dt : float, s
        Interval between rows.
    omega0 : (3,) array, rad/s
        Initial body rates.
    substeps : int
        Runge-Kutta steps in one interval.
    quaternion0 : (4,) array
        Initial attitude, w first, body to earth; normalised here.

    Returns
    -------
    rates : (N + 1, 3) array, rad/s
    quaternions : (N + 1, 4) array
        Both include the initial state.

    Raises
    ------
    SitlError
        When a shape is wrong, a number is not finite, or the tensor is not symmetric and positive definite.
    """
    J = checked_inertia(inertia)
    try:
        M = np.ascontiguousarray(moments, dtype=np.float64)
        q0, w0 = np.array(quaternion0, dtype=np.float64), np.array(omega0, dtype=np.float64)
    except ValueError as error:
        raise SitlError(f"moments, omega0, quaternion0: expected arrays of numbers: {error}") from error
    if M.ndim != 2 or M.shape[1] != 3 or w0.shape != (3,) or q0.shape != (4,):
        raise SitlError(
            f"got moments {M.shape}, omega0 {w0.shape}, quaternion0 {q0.shape}; expected (N, 3), (3,) and (4,)"
        )
    x = np.concatenate([q0, w0])
    length = float(np.linalg.norm(x[:4]))
    if not (np.isfinite(M).all() and np.isfinite(x).all() and length > 0):
        raise SitlError("moments and initial state: expected finite numbers and a quaternion that is not zero")
    if substeps < 1 or not dt > 0:
        raise SitlError(f"got {substeps} substeps of dt {dt} s; expected at least one, and dt above 0")
    x[:4] /= length
    rates, quaternions = np.empty((len(M) + 1, 3)), np.empty((len(M) + 1, 4))
    rates[0], quaternions[0] = x[4:], x[:4]
    _integrate(J, np.linalg.inv(J), M, dt / substeps, substeps, x, rates, quaternions)
    return rates, quaternions


def checked_inertia(inertia: ArrayLike) -> NDArray[np.float64]:
    """The tensor as an array.

    Raises
    ------
    SitlError
        When it is not a symmetric, positive definite 3x3 matrix whose principal moments obey the
        triangle inequality (no body has others).
    """
    J = np.array(inertia, dtype=np.float64)
    if J.shape != (3, 3) or not np.isfinite(J).all() or not np.allclose(J, J.T, rtol=1e-9, atol=0):
        raise SitlError(f"inertia: got {J.tolist()}, expected a symmetric 3x3 tensor, kg m^2")
    principal = np.linalg.eigvalsh(J)
    if principal[0] <= 0 or principal[2] > (principal[0] + principal[1]) * (1 + 1e-9):
        raise SitlError(
            f"inertia: principal moments {', '.join(f'{v:.4g}' for v in principal)} kg m^2 are of no real body: "
            "each must be positive and at most the sum of the other two"
        )
    return J


def hover_state(plant: PlantParameters, altitude: float = 10.0) -> NDArray[np.float64]:
    """State of a level vehicle at rest in the air, every rotor carrying its equal share of the weight.

    Parameters
    ----------
    plant : PlantParameters
        The vehicle.
    altitude : float, m
        Height above the origin.
    """
    n = len(plant.rotors)
    state = np.zeros(ROTORS + n)
    state[POSITION + 2] = -altitude
    state[QUATERNION] = 1.0
    state[ROTORS:] = np.sqrt(plant.mass * GRAVITY / n / plant.thrust_coefficient)
    return state
