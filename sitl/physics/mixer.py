"""Control allocation: motor commands from the torque (normalised) on each axis and the collective.

Commands are thrust fractions 0..1, f = mixer @ (roll, pitch, yaw, collective). When one is out of range, in this order:
the collective is lowered (upper limit) or raised (lower limit, airmode only), then the yaw torque is reduced, then the
roll and pitch torques are scaled together.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mimopilot.sitl.errors import SitlError
from mimopilot.sitl.physics.compiled_step import compiled, inlined

ROUNDING = 1e-9  # thrust fraction; a command out of range by less is clipped and not reported as saturation


class Allocation(NamedTuple):
    """The mixer of a vehicle.

    Attributes
    ----------
    mixer : (n, 4) array
        Thrust fraction of each motor for one unit of roll, pitch and yaw torque (normalised) and of collective.
    airmode : bool
        Whether the collective may be raised so that the torques can be given.
    """

    mixer: NDArray[np.float64]
    airmode: bool


def moment_scale(
    rotors: NDArray[np.float64], spin: NDArray[np.float64], thrust: float, ratio: float
) -> NDArray[np.float64]:
    """Torque that u = 1 stands for: half of the motors at full thrust, the others off (2 b T_max for a quad).

    Parameters
    ----------
    rotors : (n, 3) array, m
        Positions about the vehicle's reference point.
    spin : (n,) array
        +1 or -1, see `sitl.physics.rigid_body.PlantParameters`.
    thrust : float, N
        Largest thrust of a motor.
    ratio : float, m
        Reaction torque over thrust.

    Returns
    -------
    (3,) array, N m
        Roll, pitch, yaw.
    """
    arms = np.array([-rotors[:, 1], rotors[:, 0], spin * ratio])
    scale: NDArray[np.float64] = np.clip(arms, 0, None).sum(axis=1) * thrust
    return scale


def make_allocation(
    rotors: NDArray[np.float64], spin: NDArray[np.float64], thrust: float, ratio: float, airmode: bool
) -> Allocation:
    """Mixer of any rotor geometry: pseudo-inverse of the normalised effectiveness. Arguments as `moment_scale`.

    Raises
    ------
    SitlError
        When the rotors cannot make roll, pitch, yaw and thrust independently, or one would need negative thrust.
    """
    scale = moment_scale(rotors, spin, thrust, ratio)
    if not (np.isfinite(scale).all() and (scale > 0).all()):
        raise SitlError("rotors: these positions and directions make no torque on some axis; move or reverse a rotor")
    moments = np.array([-rotors[:, 1], rotors[:, 0], spin * ratio]) * thrust / scale[:, None]
    effectiveness = np.vstack([moments, np.full(len(rotors), 1 / len(rotors))])
    if np.linalg.matrix_rank(effectiveness) < 4:
        raise SitlError(
            "rotors: these positions and directions cannot make roll, pitch, yaw and thrust independently; move or "
            "reverse a rotor"
        )
    mixer = np.linalg.pinv(effectiveness)
    if (mixer[:, 3] <= 0).any():
        raise SitlError(
            "rotors: the reference point is outside of the rotors, so hovering would need negative thrust; place "
            "rotors around it"
        )
    return Allocation(np.ascontiguousarray(mixer), airmode)


@compiled
def _largest_share(base, part, collective, allocation):  # type: ignore[no-untyped-def]
    """Largest s in 0..1 for which base + s part leaves a collective that keeps every motor within 0..1.

    Motor i needs c >= -(base_i + s part_i)/h_i, motor j needs c <= (1 - base_j - s part_j)/h_j. Without airmode c is
    at most the commanded collective. Each pair is one linear inequality in s. Returns -1 when no s satisfies all.
    """
    n = base.shape[0]
    smallest, largest = 0.0, 1.0
    for i in range(n):
        h_i = allocation.mixer[i, 3]
        for j in range(n + 1):
            if j < n:
                h_j = allocation.mixer[j, 3]
                margin = (1.0 - base[j]) / h_j + base[i] / h_i + ROUNDING
                slope = part[j] / h_j - part[i] / h_i
            elif allocation.airmode:
                continue
            else:
                margin = collective + base[i] / h_i + ROUNDING
                slope = -part[i] / h_i
            if slope > margin:
                if slope <= 0.0:
                    return -1.0  # even the whole part leaves too little margin
                largest = min(largest, margin / slope)
            if margin < 0.0:
                if slope >= 0.0:
                    return -1.0
                smallest = max(smallest, margin / slope)
    return largest if largest >= smallest else -1.0


@compiled
def _shares(moments, collective, allocation):  # type: ignore[no-untyped-def]
    """Largest shares of roll and pitch together, and of yaw, for which a collective exists: yaw is reduced first."""
    n = allocation.mixer.shape[0]
    roll_pitch, yaw = np.empty(n), np.empty(n)
    for i in range(n):
        roll_pitch[i] = allocation.mixer[i, 0] * moments[0] + allocation.mixer[i, 1] * moments[1]
        yaw[i] = allocation.mixer[i, 2] * moments[2]
    yaw_share = _largest_share(roll_pitch, yaw, collective, allocation)
    if yaw_share >= 0.0:
        return 1.0, yaw_share
    return max(_largest_share(np.zeros(n), roll_pitch, collective, allocation), 0.0), 0.0


@inlined
def _combine(moments, share, yaw_share, collective, allocation, commands):  # type: ignore[no-untyped-def]
    """Fill `commands` for shares of the torques, with the nearest collective that keeps each within 0..1.

    Returns False when no collective does, because the shares are too large.
    """
    low, high = -np.inf, np.inf
    if not allocation.airmode:
        high = collective
    for i in range(allocation.mixer.shape[0]):
        roll_pitch = allocation.mixer[i, 0] * moments[0] + allocation.mixer[i, 1] * moments[1]
        command = share * roll_pitch + yaw_share * (allocation.mixer[i, 2] * moments[2])
        low = max(low, -command / allocation.mixer[i, 3])
        high = min(high, (1.0 - command) / allocation.mixer[i, 3])
        commands[i] = command
    given = min(max(collective, low), high)
    for i in range(allocation.mixer.shape[0]):
        commands[i] = min(max(commands[i] + given * allocation.mixer[i, 3], 0.0), 1.0)
    return low <= high


@compiled
def allocate(moments, collective, allocation, commands, unallocated):  # type: ignore[no-untyped-def]
    """Fill the motor `commands` (n,) for torques (3,) (normalised) and a collective.

    `unallocated` (3,) gets the sign of the torque on each axis that is saturated, else 0.
    """
    share, yaw_share = 1.0, 1.0
    if not _combine(moments, share, yaw_share, collective, allocation, commands):
        share, yaw_share = _shares(moments, collective, allocation)
        _combine(moments, share, yaw_share, collective, allocation, commands)
    for axis in range(3):
        missing = share < 1.0 if axis < 2 else yaw_share < 1.0
        unallocated[axis] = np.sign(moments[axis]) if missing else 0.0
