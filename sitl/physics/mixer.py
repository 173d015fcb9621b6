"""From moments and collective to motor commands: the autopilot host's control allocation.

Commands are thrust fractions 0..1, f = mixer @ (roll, pitch, yaw, collective). Out of range, in this order:
at the upper limit the collective is lowered, at the lower limit raised (airmode only), then yaw gives way,
then roll and pitch are scaled together.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from mimopilot.sitl.errors import SitlError
from mimopilot.sitl.physics.compiled import compiled, inlined
from numpy.typing import NDArray

ROUNDING = 1e-9  # of the thrust: a command this far out of range is clipped, not a lack of authority


class Allocation(NamedTuple):
    """Mixer of a vehicle.

    Attributes
    ----------
    mixer : (n, 4) array
        Thrust fraction of each motor for a unit of roll, pitch and yaw moment and of collective.
    airmode : bool
        Raise the collective to make room for moments.
    """

    mixer: NDArray[np.float64]
    airmode: bool


def moment_scale(
    rotors: NDArray[np.float64], spin: NDArray[np.float64], thrust: float, ratio: float
) -> NDArray[np.float64]:
    """Moment that u = 1 stands for: half of the motors at full thrust, the others off (M_max = 2 b T_max for a quad).

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
    """Mixer for any rotor geometry: pseudo-inverse of the normalised effectiveness. Arguments as `moment_scale`.

    Raises
    ------
    SitlError
        When the rotors cannot make roll, pitch, yaw and thrust independently, or one would have to pull down.
    """
    scale = moment_scale(rotors, spin, thrust, ratio)
    if not (np.isfinite(scale).all() and (scale > 0).all()):
        raise SitlError("rotors: these positions and directions make no moment on some axis")
    moments = np.array([-rotors[:, 1], rotors[:, 0], spin * ratio]) * thrust / scale[:, None]
    effectiveness = np.vstack([moments, np.full(len(rotors), 1 / len(rotors))])
    if np.linalg.matrix_rank(effectiveness) < 4:
        raise SitlError("rotors: these positions and directions cannot make roll, pitch, yaw and thrust independently")
    mixer = np.linalg.pinv(effectiveness)
    if (mixer[:, 3] <= 0).any():
        raise SitlError("rotors: the centre is outside of the rotors, hovering would need negative thrust")
    return Allocation(np.ascontiguousarray(mixer), airmode)


@compiled
def _largest_share(base, part, collective, allocation):  # type: ignore[no-untyped-def]
    """Largest s in 0..1 for which base + s part leaves a collective that keeps every motor within 0..1.

    Motor i asks for c >= -(base_i + s part_i)/h_i, motor j for c <= (1 - base_j - s part_j)/h_j and, without
    airmode, for c <= the commanded one: each pair is one linear inequality in s. -1 when no s will do.
    """
    n = base.shape[0]
    smallest, largest = 0.0, 1.0
    for i in range(n):
        h_i = allocation.mixer[i, 3]
        for j in range(n + 1):
            if j < n:
                h_j = allocation.mixer[j, 3]
                room = (1.0 - base[j]) / h_j + base[i] / h_i + ROUNDING
                slope = part[j] / h_j - part[i] / h_i
            elif allocation.airmode:
                continue
            else:
                room = collective + base[i] / h_i + ROUNDING
                slope = -part[i] / h_i
            if slope > room:
                if slope <= 0.0:
                    return -1.0  # even the whole part leaves too little room
                largest = min(largest, room / slope)
            if room < 0.0:
                if slope >= 0.0:
                    return -1.0
                smallest = max(smallest, room / slope)
    return largest if largest >= smallest else -1.0


@compiled
def _shares(moments, collective, allocation):  # type: ignore[no-untyped-def]
    """Largest shares of roll with pitch, and of yaw, that leave a collective: yaw gives way first."""
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
    """Commands for shares of the moments, with the nearest collective that keeps each within 0..1.

    False when there is none: the shares are too large.
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
    """Motor commands for the moments (3,) and collective; fills `commands` (n,) and `unallocated` (3,), the sign of
    the moment on each axis that could not be given.
    """
    share, yaw_share = 1.0, 1.0
    if not _combine(moments, share, yaw_share, collective, allocation, commands):
        share, yaw_share = _shares(moments, collective, allocation)
        _combine(moments, share, yaw_share, collective, allocation, commands)
    for axis in range(3):
        missing = share < 1.0 if axis < 2 else yaw_share < 1.0
        unallocated[axis] = np.sign(moments[axis]) if missing else 0.0
