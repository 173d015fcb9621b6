"""Quality gates: logs whose gains would be nonsense are refused with the reason, doubtful ones warned about.

The limits come from real logs: an instrument that explains less than 0.3 of a regressor, or a controller that
explains less than half of the moment, caught every log that gave nonsense; above 0.5 and 0.84 all were good. The
problem's condition number was 15 to 30 on good logs.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from mimopilot.tuning.errors import TuningError
from mimopilot.tuning.estimation.instrumental_variables import AXES, Stretches
from mimopilot.tuning.estimation.regression import Solution
from mimopilot.tuning.estimation.vrft import LoopEstimate
from mimopilot.tuning.experiment import Experiment
from mimopilot.tuning.plant.frequency_response import PlantResponse

WEAK, DOUBTFUL = 0.3, 0.5
POOR_FIT, MODEST_FIT = 0.5, 0.84
SATURATED, OFTEN_SATURATED = 0.02, 0.2
#: What is above is no motion that a controller answers, Hz: motors turn at 50 Hz and more.
VIBRATION = 40.0
#: Least squares and instruments may differ by this share of the gain's size.
DIFFERENCE = 0.5
ILL_CONDITIONED, BADLY_CONDITIONED = 1e4, 1e3


def examine_estimates(source: str, stretches: Stretches, loops: Sequence[LoopEstimate], Ts: float) -> list[str]:
    """Warnings about a rate loop's estimates; empty for a good log.

    Parameters
    ----------
    source : str
        Name of the log.
    stretches : list of (axes, segments)
        The axes that each estimate is about.
    loops : sequence of LoopEstimate
    Ts : float, s
        Sampling period of the log.

    Raises
    ------
    TuningError
        When the gains would be nonsense: the reason and what to do about it.
    """
    warnings: list[str] = []
    for (axes, _), estimate in zip(stretches, loops, strict=True):
        names, solution = AXES[axes], estimate.solution
        strength = solution.strength.reshape(-1, len(names)).min(axis=0)
        for name, value in zip(names, strength, strict=True):
            text = f"the excitation explains {value:.0%} of what the {name} gains are found from"
            if value < WEAK:
                raise TuningError(f"{source}: {text}; inject a stronger or longer moment on {name}")
            if value < DOUBTFUL:
                warnings.append(text)
        text = f"the {' and '.join(names)} gains can hardly be told apart (condition number {solution.condition:.0f})"
        if solution.condition > ILL_CONDITIONED:
            raise TuningError(f"{source}: {text}; inject more frequencies, or ask for a simpler structure")
        if solution.condition > BADLY_CONDITIONED:
            warnings.append(text)
        for i, (name, value) in enumerate(zip(names, solution.r_squared, strict=True)):
            text = f"the {name} controller explains {value:.0%} of the moment that flew"
            calm = _explained_below(solution, Ts, i) if value < POOR_FIT else value
            if value < POOR_FIT <= calm:
                warnings.append(
                    f"{text}, and {calm:.0%} of what is below {VIBRATION:g} Hz: a vibration; find its source, or "
                    "filter it on the vehicle (notch or low-pass)"
                )
            elif value < POOR_FIT:
                raise TuningError(
                    f"{source}: {text}; the wanted rate loop is out of reach: ask for a slower one or for more delay, "
                    "or check that torque and rates are of the same vehicle and unit"
                )
            elif value < MODEST_FIT:
                warnings.append(text)
        proportional, plain = estimate.gain("P"), solution.least_squares[:, : len(names)]
        apart = np.linalg.norm(proportional - plain) / np.linalg.norm(proportional)
        if apart > DIFFERENCE:
            warnings.append(f"with and without instruments the proportional gains differ by {apart:.0%}: a noisy log")
    return warnings


def _explained_below(solution: Solution, Ts: float, row: int) -> float:
    """Share of a moment's power below `VIBRATION` that the controller explains."""
    from scipy.signal import butter, sosfiltfilt

    if 2 * VIBRATION * Ts >= 1:
        return float(solution.r_squared[row])
    low_pass = butter(4, 2 * VIBRATION * Ts, output="sos")
    power = left = 0.0
    for u, x in zip(solution.problem.u, solution.problem.x, strict=True):
        moment, rest = (sosfiltfilt(low_pass, part) for part in (u[:, row], u[:, row] - x @ solution.B[row]))
        power, left = power + float(moment @ moment), left + float(rest @ rest)
    return 1 - left / power


def examine_band(source: str, plant: PlantResponse, bandwidths: Sequence[float]) -> list[str]:
    """Warnings about where in frequency the axes were excited.

    Parameters
    ----------
    source : str
        Name of the log.
    plant : PlantResponse
        Measured on it.
    bandwidths : sequence of 2 float, rad/s
        What is asked of the rate loop, roll and pitch.

    Raises
    ------
    TuningError
        When an axis was excited at no frequency.
    """
    warnings = []
    for axis, (name, wanted) in enumerate(zip(AXES, bandwidths, strict=True)):
        band = plant.band(axis)
        if band is None:
            raise TuningError(
                f"{source}: not excited on {name}: the excitation explains its rate at no frequency; inject a stronger "
                "moment on that axis"
            )
        if band[1] < wanted:
            warnings.append(
                f"{name} is excited from {band[0]:.1f} to {band[1]:.0f} rad/s only, the rate loop is asked for "
                f"{wanted:g} rad/s: hold the injected moment for fewer samples"
            )
    return warnings


def examine_saturation(experiment: Experiment) -> list[str]:
    """Warnings about a moment at its limit, where the log says what the limit is.

    Raises
    ------
    TuningError
        When it is there for much of the flight.
    """
    if experiment.flown is None:
        return []
    warnings = []
    limit = np.array(experiment.flown.limits.moment_max[:2])
    used = np.vstack([experiment.u[start:stop] for start, stop in experiment.segments])
    for name, share in zip(AXES, (np.abs(used) >= 0.999 * limit).mean(axis=0), strict=True):
        text = f"the {name} moment is at its limit for {share:.0%} of the flight"
        if share > OFTEN_SATURATED:
            raise TuningError(
                f"{experiment.source}: saturated: {text}; inject a smaller moment or fly gentler manoeuvres"
            )
        if share > SATURATED:
            warnings.append(text)
    return warnings
