"""The motors identified from a log: how the allocator drives them, and their saturation."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

#: Smallest share of the torque's variance that the mixer explains; with less the commands belong to another torque.
EXPLAINED = 0.95
#: Fewest samples without a saturated motor for a fit.
MIN_SAMPLES = 50
#: A command this close to 0 or 1 is saturated: half a step of a 10 bit output.
END = 5e-4
#: Share of the samples with a saturated motor above which there is a warning.
SATURATED = 0.01
#: Share of the samples that the proposed amplitude keeps from saturation.
NEARLY_ALL = 0.999
#: Smallest deflection that limits the amplitude: avoids a division by 0.
SMALLEST = 1e-9

Signal = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Motors:
    """How an allocator drives n motors whose commands are thrust fractions.

    Attributes
    ----------
    mixer : (n, 2) array
        Change of each command for u = 1 on roll and on pitch.
    hover : (n,) array
        Commands that hold the vehicle level, 0 to 1.
    """

    mixer: Signal
    hover: Signal


def fit_motors(u: Signal, commands: Signal) -> Motors | None:
    """Fit the allocator by least squares: each command is a constant plus a linear function of both torques.

    Parameters
    ----------
    u : (N, 2) array
        Torques (normalised) in flight.
    commands : (N, n) array
        Motor commands, 0 to 1.

    Returns
    -------
    Motors or None
        None when the torques do not explain the commands.
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
    """Warning about saturated motors: share of the samples, and the amplitude that avoids saturation.

    Parameters
    ----------
    u : (N, 2) array
        Torques (normalised) in flight.
    commands : (N, n) array
        Motor commands, 0 to 1.
    motors : Motors or None
        The allocator.
    amplitude : float
        Of the injected torque; 0: none was injected.
    """
    share = float(np.mean(((commands <= END) | (commands >= 1 - END)).any(axis=1))) if len(commands) else 0.0
    if share <= SATURATED:
        return []
    text = f"a motor is saturated in {share:.0%} of the samples"
    if motors is None or amplitude == 0:
        return [f"{text}; fly gentler manoeuvres"]
    moved = (u - np.median(u, axis=0)) @ motors.mixer.T
    up, down = np.quantile(moved, [NEARLY_ALL, 1 - NEARLY_ALL], axis=0)
    factors = np.concatenate(
        [(1 - motors.hover) / np.maximum(up, SMALLEST), motors.hover / np.maximum(-down, SMALLEST)]
    )
    fitting = amplitude * float(np.clip(factors.min(), 0.0, 1.0))
    return [f"{text}; inject a torque of {fitting:.2g} instead of {amplitude:.2g}"]
