"""The rigid body: Newton-Euler equations, motor lag and drag, integrated by a fixed-step Runge-Kutta scheme.

Axes: body FRD, earth NED. The quaternion (w, x, y, z) rotates body vectors into earth axes. The state vector is
position (3, m), velocity (3, m/s), quaternion (4), body rates (3, rad/s), rotor speeds (n, rad/s).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mimopilot.sitl.errors import SitlError
from mimopilot.sitl.physics.compiled_step import compiled, inlined

GRAVITY = 9.80665  # m/s^2, standard gravity
RUNGE_KUTTA_STEP = 1e-3  # s; chosen: a step of 0.1 ms moves half a second of flight by less than 1e-6 (m, m/s, rad/s)
COMMAND_HISTORY = 512  # control periods of motor commands that are kept: 1 s at 500 Hz; faults may delay by half
MAX_ROTORS = 16  # HIL_ACTUATOR_CONTROLS carries 16 controls

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
    effectiveness : (n,) array
        Share of its thrust that each motor still gives; 1 when healthy.
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
    effectiveness: NDArray[np.float64]


# The integrator keeps a tuple in registers: velocity (3), quaternion (4), angular momentum in body axes (3).
# With momentum instead of rates, Euler's equation needs one matrix product less. The scheme is the same, because the
# two are related linearly. The rotor lag is linear too and is solved exactly.


@inlined
def _product(matrix, x, y, z):  # type: ignore[no-untyped-def]
    """A (3, 3) matrix times a vector."""
    return (
        matrix[0, 0] * x + matrix[0, 1] * y + matrix[0, 2] * z,
        matrix[1, 0] * x + matrix[1, 1] * y + matrix[1, 2] * z,
        matrix[2, 0] * x + matrix[2, 1] * y + matrix[2, 2] * z,
    )


@inlined
def _derivative(body, wrench, plant):  # type: ignore[no-untyped-def]
    """Newton's and Euler's equations; the wrench is thrust (N), then the moment (3, N m)."""
    vx, vy, vz, w, x, y, z, hx, hy, hz = body
    thrust, L, M, N = wrench
    p, q, r = _product(plant.inertia_inverse, hx, hy, hz)
    twice_thrust, drag = 2.0 * thrust * (1.0 / plant.mass), plant.drag / plant.mass
    return (
        -(x * z + w * y) * twice_thrust - drag * (vx - plant.wind[0]),
        -(y * z - w * x) * twice_thrust - drag * (vy - plant.wind[1]),
        GRAVITY - (0.5 - x * x - y * y) * twice_thrust - drag * (vz - plant.wind[2]),
        0.5 * (-x * p - y * q - z * r),
        0.5 * (w * p + y * r - z * q),
        0.5 * (w * q + z * p - x * r),
        0.5 * (w * r + x * q - y * p),
        L - plant.rate_damping[0] * p - (q * hz - r * hy),
        M - plant.rate_damping[1] * q - (r * hx - p * hz),
        N - plant.rate_damping[2] * r - (p * hy - q * hx),
    )


@inlined
def _add_scaled(a, h, k):  # type: ignore[no-untyped-def]
    """Return a + h k, written out: tuples stay in registers, arrays do not."""
    return (
        a[0] + h * k[0],
        a[1] + h * k[1],
        a[2] + h * k[2],
        a[3] + h * k[3],
        a[4] + h * k[4],
        a[5] + h * k[5],
        a[6] + h * k[6],
        a[7] + h * k[7],
        a[8] + h * k[8],
        a[9] + h * k[9],
    )


@inlined
def _runge_kutta(body, step, before, middle, after, plant):  # type: ignore[no-untyped-def]
    """One step of the classical scheme, with the wrench at its beginning, middle and end.

    Returns the body and its displacement (3, m).
    """
    k1 = _derivative(body, before, plant)
    second = _add_scaled(body, 0.5 * step, k1)
    k2 = _derivative(second, middle, plant)
    third = _add_scaled(body, 0.5 * step, k2)
    k3 = _derivative(third, middle, plant)
    fourth = _add_scaled(body, step, k3)
    k4 = _derivative(fourth, after, plant)
    end = _add_scaled(body, step / 6.0, _add_scaled(_add_scaled(k1, 1.0, k4), 2.0, _add_scaled(k2, 1.0, k3)))
    vx, vy, vz, w, x, y, z, hx, hy, hz = end
    scale = 1.5 - 0.5 * (w * w + x * x + y * y + z * z)  # one Newton step that restores unit length
    sixth, third_part = step / 6.0, step / 3.0
    displacement = (
        sixth * (body[0] + fourth[0]) + third_part * (second[0] + third[0]),
        sixth * (body[1] + fourth[1]) + third_part * (second[1] + third[1]),
        sixth * (body[2] + fourth[2]) + third_part * (second[2] + third[2]),
    )
    return (vx, vy, vz, w * scale, x * scale, y * scale, z * scale, hx, hy, hz), displacement


@inlined
def _read_body(state, plant):  # type: ignore[no-untyped-def]
    """Read the body from the state vector."""
    hx, hy, hz = _product(plant.inertia, state[10], state[11], state[12])
    return (state[3], state[4], state[5], state[6], state[7], state[8], state[9], hx, hy, hz)


@inlined
def _write_body(body, state, plant):  # type: ignore[no-untyped-def]
    """Write the body into the state vector."""
    state[3], state[4], state[5], state[6], state[7], state[8], state[9], hx, hy, hz = body
    state[10], state[11], state[12] = _product(plant.inertia_inverse, hx, hy, hz)


@inlined
def _steady_rotor_speed(command, i, plant):  # type: ignore[no-untyped-def]
    """Steady-state speed of rotor `i` (rad/s) under a thrust fraction."""
    fraction = min(max(float(command), 0.0), 1.0) * plant.effectiveness[i]
    return np.sqrt(fraction * plant.thrust_max / plant.thrust_coefficient)


@inlined
def _advance_rotors(state, commands, plant, e_end):  # type: ignore[no-untyped-def]
    """Advance the rotors until e = exp(-t / motor_time_constant) is `e_end`, with the commands held.

    The speed of a rotor is settled + gap e; its thrust is proportional to the square. Returns the wrench in between, as
    coefficients of 1, e and e^2.
    """
    constant, linear, square = (0.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.0)
    for i in range(plant.rotors.shape[0]):
        settled = _steady_rotor_speed(commands[i], i, plant)
        gap = state[ROTORS + i] - settled
        state[ROTORS + i] = settled + gap * e_end
        c = plant.thrust_coefficient * settled * settled
        b = plant.thrust_coefficient * 2.0 * settled * gap
        a = plant.thrust_coefficient * gap * gap
        L, M, N = -plant.rotors[i, 1], plant.rotors[i, 0], plant.spin[i] * plant.torque_ratio
        constant = (constant[0] + c, constant[1] + L * c, constant[2] + M * c, constant[3] + N * c)
        linear = (linear[0] + b, linear[1] + L * b, linear[2] + M * b, linear[3] + N * b)
        square = (square[0] + a, square[1] + L * a, square[2] + M * a, square[3] + N * a)
    return constant, linear, square


@inlined
def _wrench(polynomial, e):  # type: ignore[no-untyped-def]
    """Evaluate the polynomial of `_advance_rotors`: thrust (N) and moment (3, N m)."""
    constant, linear, square = polynomial
    return (
        constant[0] + e * (linear[0] + e * square[0]),
        constant[1] + e * (linear[1] + e * square[1]),
        constant[2] + e * (linear[2] + e * square[2]),
        constant[3] + e * (linear[3] + e * square[3]),
    )


@compiled
def advance(state, commands, plant, steps, step):  # type: ignore[no-untyped-def]
    """Integrate in place over `steps` Runge-Kutta steps with motor commands (thrust fractions 0..1) held."""
    decay, e_end = np.exp(-0.5 * step / plant.motor_time_constant), 1.0
    for _ in range(steps):
        e_end *= decay * decay
    polynomial = _advance_rotors(state, commands, plant, e_end)
    body, e, after = _read_body(state, plant), 1.0, _wrench(polynomial, 1.0)
    x, y, z = state[0], state[1], state[2]
    for _ in range(steps):
        before, middle = after, _wrench(polynomial, e * decay)
        e *= decay * decay
        after = _wrench(polynomial, e)
        body, moved = _runge_kutta(body, step, before, middle, after, plant)
        x, y, z = x + moved[0], y + moved[1], z + moved[2]
    state[0], state[1], state[2] = x, y, z
    _write_body(body, state, plant)


@compiled
def _integrate(plant, moments, step, substeps, state, rates, quaternions):  # type: ignore[no-untyped-def]
    body = _read_body(state, plant)
    for k in range(moments.shape[0]):
        wrench = (0.0, moments[k, 0], moments[k, 1], moments[k, 2])
        for _ in range(substeps):
            body, _ = _runge_kutta(body, step, wrench, wrench, wrench, plant)
        _write_body(body, state, plant)
        quaternions[k + 1] = state[6:10]
        rates[k + 1] = state[10:13]


def integrate_moments(
    inertia: ArrayLike,
    moments: ArrayLike,
    dt: float,
    omega0: ArrayLike,
    substeps: int = 1,
    quaternion0: ArrayLike = (1.0, 0.0, 0.0, 0.0),
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Integrate pure body moments with the integrator of the simulation, for comparison with closed forms.

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
    if not (np.isfinite(M).all() and np.isfinite(w0).all() and np.isfinite(q0).all() and q0.any()):
        raise SitlError("moments and initial state: expected finite numbers and a quaternion that is not zero")
    if substeps < 1 or not dt > 0:
        raise SitlError(f"got {substeps} substeps of dt {dt} s; expected at least one, and dt above 0")
    state = np.concatenate([np.zeros(6), q0 / np.linalg.norm(q0), w0])
    rates, quaternions = np.empty((len(M) + 1, 3)), np.empty((len(M) + 1, 4))
    rates[0], quaternions[0] = state[10:], state[6:10]
    nothing, inverse = np.zeros(3), np.linalg.inv(J).astype(np.float64)
    body = PlantParameters(
        1.0, J, inverse, np.zeros((0, 3)), np.zeros(0), 1.0, 1.0, 1.0, 1.0, nothing, 0.0, nothing, np.ones(0)
    )
    _integrate(body, M, dt / substeps, substeps, state, rates, quaternions)
    return rates, quaternions


def checked_inertia(inertia: ArrayLike) -> NDArray[np.float64]:
    """Check an inertia tensor and return it as a (3, 3) array, kg m^2.

    Raises
    ------
    SitlError
        When it is not a symmetric, positive definite 3x3 matrix whose principal moments obey the triangle inequality,
        as those of every body do.
    """
    J = np.array(inertia, dtype=np.float64)
    if J.shape != (3, 3) or not np.isfinite(J).all() or not np.allclose(J, J.T, rtol=1e-9, atol=0):
        raise SitlError(f"inertia: got {J.tolist()}, expected a symmetric 3x3 tensor, kg m^2")
    if not is_physical_inertia(J):
        principal = np.linalg.eigvalsh(J)
        raise SitlError(
            f"inertia: principal moments {', '.join(f'{v:.4g}' for v in principal)} kg m^2 are of no real body: "
            "each must be positive and at most the sum of the other two; correct the tensor"
        )
    return J


def is_physical_inertia(inertia: NDArray[np.float64]) -> bool:
    """Whether a symmetric (3, 3) tensor has positive principal moments that obey the triangle inequality."""
    smallest, middle, largest = np.linalg.eigvalsh(inertia)
    return bool(smallest > 0 and largest <= (smallest + middle) * (1 + 1e-9))


def hover_state(plant: PlantParameters, altitude: float = 10.0) -> NDArray[np.float64]:
    """State of a level vehicle at rest in the air; each rotor carries an equal share of the weight.

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
