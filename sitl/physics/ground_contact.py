"""Ground contact: a plane at altitude zero; one foot below each rotor, level with the centre of gravity.

The plant flies one control period without ground. Then `apply_ground_contact` applies the impulses of the ground. Feet
do not bounce, and friction holds them. There is no ground effect.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mimopilot.sitl.physics.compiled_step import compiled, inlined
from mimopilot.sitl.physics.rigid_body import QUATERNION, ROTORS, PlantParameters

FRICTION = 0.7  # Coulomb coefficient of a foot; chosen: rubber on dry concrete
SWEEPS = 10  # over all feet (Gauss-Seidel); chosen: a vehicle at rest then moves by less than 1e-7 m/s
CONTACT_TOLERANCE = 1e-4  # m; chosen: a foot this near the ground counts as standing on it


def ground_state(plant: PlantParameters) -> NDArray[np.float64]:
    """State (13 + n,) of a vehicle on the ground at the origin, heading north, its rotors stopped."""
    state = np.zeros(ROTORS + len(plant.rotors))
    state[QUATERNION] = 1.0
    return state


@compiled
def _rotation(q, R):  # type: ignore[no-untyped-def]
    """Fill `R` (3, 3) with the rotation from body to earth axes."""
    w, x, y, z = q[0], q[1], q[2], q[3]
    R[0, 0], R[0, 1], R[0, 2] = 1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)
    R[1, 0], R[1, 1], R[1, 2] = 2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)
    R[2, 0], R[2, 1], R[2, 2] = 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)


@compiled
def _rotate(state, a, b, c):  # type: ignore[no-untyped-def]
    """Rotate the attitude by a small angle (rad) about the body axes."""
    w, x, y, z = state[6], state[7], state[8], state[9]
    a, b, c = 0.5 * a, 0.5 * b, 0.5 * c
    state[6], state[7] = w - x * a - y * b - z * c, x + w * a + y * c - z * b
    state[8], state[9] = y + w * b + z * a - x * c, z + w * c + x * b - y * a
    scale = 1.0 / np.sqrt(state[6] ** 2 + state[7] ** 2 + state[8] ** 2 + state[9] ** 2)
    for i in range(6, 10):
        state[i] *= scale


@inlined
def _lever(foot, axis, R, plant):  # type: ignore[no-untyped-def]
    """Moment (body axes, N m per N) about the centre of gravity of a force at a foot along an earth axis."""
    x, y = plant.rotors[foot, 0], plant.rotors[foot, 1]
    return y * R[axis, 2], -x * R[axis, 2], x * R[axis, 1] - y * R[axis, 0]


@inlined
def _depth(state, foot, R, plant):  # type: ignore[no-untyped-def]
    """Depth of a foot below the ground, m."""
    return state[2] + R[2, 0] * plant.rotors[foot, 0] + R[2, 1] * plant.rotors[foot, 1]


@compiled
def _stop_foot(state, foot, axis, R, plant, given, least, most):  # type: ignore[no-untyped-def]
    """Stop a foot along one earth axis by an impulse (N s) that adds to the one already `given`.

    Returns the sum, which stays within `least` and `most`.
    """
    mx, my, mz = _lever(foot, axis, R, plant)
    J = plant.inertia_inverse
    ax = J[0, 0] * mx + J[0, 1] * my + J[0, 2] * mz
    ay = J[1, 0] * mx + J[1, 1] * my + J[1, 2] * mz
    az = J[2, 0] * mx + J[2, 1] * my + J[2, 2] * mz
    speed = state[3 + axis] + state[10] * mx + state[11] * my + state[12] * mz
    total = min(max(given - speed / (1.0 / plant.mass + ax * mx + ay * my + az * mz), least), most)
    change = total - given
    state[3 + axis] += change / plant.mass
    state[10] += change * ax
    state[11] += change * ay
    state[12] += change * az
    return total


@compiled
def _level(state):  # type: ignore[no-untyped-def]
    """Level a vehicle that stands on all feet; otherwise it would rock on three of them."""
    scale = 1.0 / np.sqrt(state[6] * state[6] + state[9] * state[9])
    state[6], state[7], state[8], state[9] = state[6] * scale, 0.0, 0.0, state[9] * scale
    state[2] = 0.0


@compiled
def apply_ground_contact(state, plant, Ts):  # type: ignore[no-untyped-def]
    """Apply the impulses of the ground in place, at the end of a period of `Ts` s.

    Returns the largest touchdown speed of a foot (m/s), or -1 when no foot touches the ground.
    """
    n = plant.rotors.shape[0]
    reach = 0.0
    for i in range(n):
        reach = max(reach, abs(plant.rotors[i, 0]) + abs(plant.rotors[i, 1]))
    if state[2] < -reach:
        return -1.0
    R = np.empty((3, 3))
    _rotation(state[6:10], R)
    before = state.copy()
    closing = -1.0
    for i in range(n):
        if _depth(before, i, R, plant) > 0.0:
            mx, my, mz = _lever(i, 2, R, plant)
            closing = max(closing, before[5] + before[10] * mx + before[11] * my + before[12] * mz, 0.0)
    if closing < 0.0:
        return closing
    impulses = np.zeros((n, 3))
    for _ in range(SWEEPS):
        for i in range(n):
            if _depth(before, i, R, plant) > 0.0:
                impulses[i, 2] = _stop_foot(state, i, 2, R, plant, impulses[i, 2], -np.inf, 0.0)
                friction = -FRICTION * impulses[i, 2]
                for axis in range(2):
                    impulses[i, axis] = _stop_foot(state, i, axis, R, plant, impulses[i, axis], -friction, friction)
    # The ground acted throughout the period, so half of the change of speed counts for the displacement.
    half = 0.5 * Ts
    for axis in range(3):
        state[axis] += half * (state[3 + axis] - before[3 + axis])
    _rotate(state, half * (state[10] - before[10]), half * (state[11] - before[11]), half * (state[12] - before[12]))
    _rotation(state[6:10], R)
    deepest, shallowest = 0.0, np.inf
    for i in range(n):
        depth = _depth(state, i, R, plant)
        deepest, shallowest = max(deepest, depth), min(shallowest, depth)
    state[2] -= deepest
    if R[2, 2] > 0.0 and shallowest - deepest > -CONTACT_TOLERANCE:
        _level(state)
    return closing
