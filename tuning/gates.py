"""Quality gates: logs whose gains would be nonsense are refused with the reason, doubtful ones warned about.

The limits come from real logs: an instrument that explains less than 0.3 of a regressor, or a controller that
explains less than half of the moment, caught every log that gave nonsense; above 0.5 and 0.84 all were good.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tuning.errors import TuningError
from tuning.experiment import Experiment
from tuning.vrft import LoopEstimate

AXES = ("roll", "pitch")
WEAK, DOUBTFUL = 0.3, 0.5
POOR_FIT, MODEST_FIT = 0.5, 0.84
SATURATED, OFTEN_SATURATED = 0.02, 0.2
#: Least squares and instruments may differ by this share of the gain's size.
DIFFERENCE = 0.5


def examine(experiment: Experiment, estimates: Sequence[tuple[slice, LoopEstimate]]) -> list[str]:
    """Warnings about a rate loop's tuning.

    Parameters
    ----------
    experiment : Experiment
        The flight.
    estimates : sequence of (axes, LoopEstimate)
        The rate loop's estimates and the axes that each is about.

    Returns
    -------
    list of str
        What to be careful about; empty for a good log.

    Raises
    ------
    TuningError
        When the gains would be nonsense: the reason and what to do about it.
    """
    warnings: list[str] = []
    where = experiment.source
    for axes, estimate in estimates:
        names = AXES[axes]
        strength = estimate.solution.strength.reshape(-1, len(names)).min(axis=0)
        for name, value in zip(names, strength, strict=True):
            text = f"the excitation explains {value:.0%} of what the {name} gains are found from"
            if value < WEAK:
                raise TuningError(f"{where}: {text}; inject a stronger or longer moment on {name}")
            if value < DOUBTFUL:
                warnings.append(text)
        for name, value in zip(names, estimate.solution.r_squared, strict=True):
            text = f"the {name} controller explains {value:.0%} of the moment that flew"
            if value < POOR_FIT:
                raise TuningError(
                    f"{where}: {text}; the wanted rate loop is out of reach: ask for a slower one or for more delay, "
                    "or check that torque and rates are of the same vehicle and unit"
                )
            if value < MODEST_FIT:
                warnings.append(text)
        proportional, plain = estimate.gain("P"), estimate.solution.least_squares[:, : len(names)]
        apart = np.linalg.norm(proportional - plain) / np.linalg.norm(proportional)
        if apart > DIFFERENCE:
            warnings.append(f"with and without instruments the proportional gains differ by {apart:.0%}: a noisy log")
    if experiment.flown is not None:
        limit = np.array(experiment.flown.limits.moment_max[:2])
        used = np.vstack([experiment.u[start:stop] for start, stop in experiment.segments])
        for name, share in zip(AXES, (np.abs(used) >= 0.999 * limit).mean(axis=0), strict=True):
            text = f"the {name} moment is at its limit for {share:.0%} of the flight"
            if share > OFTEN_SATURATED:
                raise TuningError(f"{where}: saturated: {text}; inject a smaller moment or fly gentler manoeuvres")
            if share > SATURATED:
                warnings.append(text)
    return warnings
