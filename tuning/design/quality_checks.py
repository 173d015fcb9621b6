"""Quality checks of a tuning: a log that gives unusable gains is refused with the reason, a doubtful one warned about.

The limits come from real logs. Every log with unusable gains had an instrument that explained less than 0.3 of a
regressor, or a controller that explained less than half of the torque. Above 0.5 and 0.84 all logs were good. The
problem's condition number was 15 to 30 on good logs.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mimopilot.tuning.axes import axis_names
from mimopilot.tuning.errors import TuningError
from mimopilot.tuning.estimation.instrumental_variables import Stretches
from mimopilot.tuning.estimation.regression import Solution
from mimopilot.tuning.estimation.vrft import LoopEstimate
from mimopilot.tuning.experiment import Experiment
from mimopilot.tuning.parameter_row import AXES, ROLL_PITCH
from mimopilot.tuning.plant.frequency_response import PlantResponse

#: Share of a regressor's power that the excitation explains: below the first the log is refused, below the second
#: there is a warning.
WEAK, DOUBTFUL = 0.3, 0.5
#: Share of the torque's power that the controller explains, likewise.
POOR_FIT, MODEST_FIT = 0.5, 0.84
#: Share of the samples with the torque at its limit: above the first there is a warning, above the second the log is
#: refused.
SATURATED, OFTEN_SATURATED = 0.02, 0.2
#: Share of its limit at which a torque counts as saturated: single precision and logging round it.
AT_LIMIT = 0.999
#: Above this frequency, Hz, signals are vibration: motors turn at 50 Hz and more, and no rate loop responds.
VIBRATION = 40.0
#: Order of the low-pass filter that removes vibration.
LOW_PASS_ORDER = 4
#: Largest difference between least squares and instruments, as a share of the gain's size.
DIFFERENCE = 0.5
#: Condition number above which the log is refused, and above which there is a warning.
ILL_CONDITIONED, BADLY_CONDITIONED = 1e4, 1e3


def check_estimates(source: str, stretches: Stretches, loops: Sequence[LoopEstimate], Ts: float) -> list[str]:
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
        When the gains would be unusable: the reason and what to do about it.
    """
    warnings: list[str] = []
    for (axes, _), estimate in zip(stretches, loops, strict=True):
        names, solution = ROLL_PITCH[axes], estimate.solution
        strength = solution.strength.reshape(-1, len(names)).min(axis=0)
        for name, value in zip(names, strength, strict=True):
            text = f"the excitation explains {value:.0%} of the signals that the {name} gains are found from"
            if value < WEAK:
                raise TuningError(f"{source}: {text}; inject a stronger or longer torque on {name}")
            if value < DOUBTFUL:
                warnings.append(text)
        text = f"the {' and '.join(names)} gains are hardly distinguishable (condition number {solution.condition:.0f})"
        if solution.condition > ILL_CONDITIONED:
            raise TuningError(f"{source}: {text}; inject more frequencies, or ask for a simpler structure")
        if solution.condition > BADLY_CONDITIONED:
            warnings.append(text)
        for i, (name, value) in enumerate(zip(names, solution.r_squared, strict=True)):
            text = f"the {name} controller explains {value:.0%} of the flown torque"
            calm = _explained_below(solution, Ts, i) if value < POOR_FIT else value
            if value < POOR_FIT <= calm:
                warnings.append(
                    f"{text}, and {calm:.0%} of it below {VIBRATION:g} Hz: a vibration; find its source, or filter it "
                    "on the vehicle (notch or low-pass)"
                )
            elif value < POOR_FIT:
                raise TuningError(
                    f"{source}: {text}; the rate loop cannot reach its model: ask for a slower one or for more delay, "
                    "or check that torque and rates are of the same vehicle and unit"
                )
            elif value < MODEST_FIT:
                warnings.append(text)
        proportional, plain = estimate.gain("P"), solution.least_squares[:, : len(names)]
        apart = np.linalg.norm(proportional - plain) / np.linalg.norm(proportional)
        if apart > DIFFERENCE:
            warnings.append(f"the proportional gains with and without instruments differ by {apart:.0%}: a noisy log")
    return warnings


def _explained_below(solution: Solution, Ts: float, row: int) -> float:
    """Share of a torque's power below `VIBRATION` that the controller explains."""
    from scipy.signal import butter, sosfiltfilt

    if 2 * VIBRATION * Ts >= 1:
        return float(solution.r_squared[row])
    low_pass = butter(LOW_PASS_ORDER, 2 * VIBRATION * Ts, output="sos")
    power = left = 0.0
    for u, x in zip(solution.problem.u, solution.problem.x, strict=True):
        torque, rest = (sosfiltfilt(low_pass, part) for part in (u[:, row], u[:, row] - x @ solution.B[row]))
        power, left = power + float(torque @ torque), left + float(rest @ rest)
    return 1 - left / power


def check_band(source: str, plant: PlantResponse, bandwidths: Sequence[float]) -> list[str]:
    """Warnings about the frequencies that the axes were excited at.

    Parameters
    ----------
    source : str
        Name of the log.
    plant : PlantResponse
        PlantEstimates from it.
    bandwidths : sequence of 2 float, rad/s
        Of the rate loop's reference models, roll and pitch.

    Raises
    ------
    TuningError
        When an axis was excited at no frequency.
    """
    warnings = []
    for axis, (name, wanted) in enumerate(zip(ROLL_PITCH, bandwidths, strict=True)):
        band = plant.band(axis)
        if band is None:
            raise TuningError(
                f"{source}: not excited on {name}: the excitation explains its rate at no frequency; inject a stronger "
                "torque on that axis"
            )
        if band[1] < wanted:
            warnings.append(
                f"{name} is excited only from {band[0]:.1f} to {band[1]:.0f} rad/s, below the rate loop's bandwidth of "
                f"{wanted:g} rad/s: shorten the pulses of the injected torque"
            )
    return warnings


def check_saturation(experiment: Experiment) -> list[str]:
    """Warnings about a torque at its limit, if the log has the limit.

    Raises
    ------
    TuningError
        When it is at its limit for much of the flight.
    """
    if experiment.flown is None:
        return []
    warnings = []
    names = axis_names(experiment.u.shape[1])
    limit = np.array([experiment.flown.limits.moment_max[AXES.index(name)] for name in names])
    used = np.vstack([experiment.u[start:stop] for start, stop in experiment.segments])
    for name, share in zip(names, (np.abs(used) >= AT_LIMIT * limit).mean(axis=0), strict=True):
        text = f"the {name} torque is at its limit for {share:.0%} of the flight"
        if share > OFTEN_SATURATED:
            raise TuningError(
                f"{experiment.source}: saturated: {text}; inject a smaller torque or fly gentler manoeuvres"
            )
        if share > SATURATED:
            warnings.append(text)
    return warnings
