"""The motors behind a moment, from a log: how the allocator moves them, where they end, how their speed lags."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from mimopilot.tuning.statespace import StateSpace
from numpy.typing import NDArray

#: Share of the moment's variance that the mixer must give back: else the commands are not those of this moment.
EXPLAINED = 0.95
#: Break frequencies that rotors have, rad/s.
ROTORS = (5.0, 100.0)
MIN_SAMPLES = 50
#: A command this near to 0 or 1 is at its end: half of the step of a 10 bit output.
END = 5e-4
#: Share of the samples with a motor at an end that is told; and that the amplitude that is advised keeps within.
SATURATED, NEARLY_ALL = 0.01, 0.999

Signal = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Motors:
    """How an allocator moves n motors whose commands are thrust fractions.

    Attributes
    ----------
    mixer : (n, 2) array
        Change of each command for a unit of the roll and of the pitch moment.
    hover : (n,) array
        Commands that hold the vehicle level.
    """

    mixer: Signal
    hover: Signal


def fit_motors(u: Signal, commands: Signal) -> Motors | None:
    """The allocator by least squares: each command is a constant and a multiple of either moment.

    Parameters
    ----------
    u : (N, 2) array
        Moments in flight.
    commands : (N, n) array
        Motor commands made from them, 0..1.

    Returns
    -------
    Motors or None
        None when the moments do not explain the commands.
    """
    inside = ((commands > 0) & (commands < 1)).all(axis=1) & np.isfinite(u).all(axis=1)
    if np.count_nonzero(inside) < MIN_SAMPLES:
        return None
    u, commands = u[inside], commands[inside]
    middle = np.median(u, axis=0)
    known = np.column_stack([u - middle, np.ones(len(u))])
    solution, _, rank, _ = np.linalg.lstsq(known, commands, rcond=None)
    mixer, hover = np.ascontiguousarray(solution[:2].T), solution[2]
    if rank < 3 or np.linalg.matrix_rank(mixer) < 2:
        return None
    given = (commands - hover) @ np.linalg.pinv(mixer).T
    missing = np.mean((given - (u - middle)) ** 2, axis=0)
    return Motors(mixer, hover) if np.all(missing < (1 - EXPLAINED) * np.var(u, axis=0)) else None


def saturation_warnings(u: Signal, commands: Signal, motors: Motors | None, amplitude: float) -> list[str]:
    """What is to be said of motors at an end of their range: share of the samples, and the amplitude that avoids it.

    Parameters
    ----------
    u : (N, 2) array
        Torques in flight.
    commands : (N, n) array
        Motor commands made from them, 0 to 1.
    motors : Motors or None
        The allocator.
    amplitude : float
        Of the injected torque; 0: none was injected.
    """
    share = float(np.mean(((commands <= END) | (commands >= 1 - END)).any(axis=1))) if len(commands) else 0.0
    if share <= SATURATED:
        return []
    text = f"a motor is at an end of its range in {share:.0%} of the samples"
    if motors is None or amplitude == 0:
        return [f"{text}; fly gentler"]
    moved = (u - np.median(u, axis=0)) @ motors.mixer.T
    up, down = np.quantile(moved, [NEARLY_ALL, 1 - NEARLY_ALL], axis=0)
    room = np.concatenate([(1 - motors.hover) / np.maximum(up, 1e-9), motors.hover / np.maximum(-down, 1e-9)])
    fitting = amplitude * float(np.clip(room.min(), 0.0, 1.0))
    return [f"{text}; inject a torque of {fitting:.2g} in place of {amplitude:.2g}"]


def rotor_lag(plant: StateSpace) -> float:
    """Time constant (s) of the rotors' speed in a plant from moments to body rates; 0 where it shows none.

    Around hover a rotor is one real pole an axis. The slowest poles are the body's; a filter's are faster or complex.
    """
    poles = np.log(plant.poles[len(plant.C) :].astype(complex)) / plant.Ts
    speeds = -poles.real[np.abs(poles.imag) < -poles.real]
    speeds = np.sort(speeds[(speeds >= ROTORS[0]) & (speeds <= ROTORS[1])])[: len(plant.C)]
    return float(1 / np.mean(speeds)) if len(speeds) else 0.0
