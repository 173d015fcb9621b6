"""Where inside the band that a certificate rests on the excitation explains too little of the motion, in words."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from mimopilot.tuning.analysis.beyond_band import MAX_GAIN_ABOVE_BAND
from mimopilot.tuning.axes import axis_names
from mimopilot.tuning.logs.resample import Interval
from mimopilot.tuning.plant.frequency_response import COHERENT, HOLE, PlantResponse

#: Most ranges of frequencies that are listed; more are told as one from the first to the last.
MOST_RANGES = 3


def weak_ranges(plant: PlantResponse) -> list[Interval]:
    """Ranges (rad/s) of the known band in which the coherence of an axis is below `COHERENT`.

    Such a frequency is known by its small error alone: the mean of many bins. Ranges closer to one another than the
    band allows between two known frequencies are one.
    """
    run = plant.known_run()
    if not len(run):
        return []
    inside = np.arange(run[0], run[-1] + 1)
    weak = inside[np.any(plant.coherence[inside] < COHERENT, axis=1)]
    if not len(weak):
        return []
    apart = (plant.omega[weak[1:]] > HOLE * plant.omega[weak[:-1]]) & (np.diff(weak) > 1)
    parts = np.split(weak, np.flatnonzero(apart) + 1)
    return [(float(plant.omega[part[0]]), float(plant.omega[part[-1]])) for part in parts]


def coherence_note(plant: PlantResponse, loops: NDArray[np.complex128], omega: NDArray[np.float64]) -> str:
    """What weak coherence inside the known band means for the margins, and what to do; empty: there is none.

    Parameters
    ----------
    plant : PlantResponse
        Of roll and pitch, or of yaw.
    loops : (n, K) array
        Loops of its axes that are judged.
    omega : (K,) array, rad/s
    """
    ranges = weak_ranges(plant)
    if not ranges:
        return ""
    run = plant.known_run()
    weak = run[np.any([(plant.omega[run] >= low) & (plant.omega[run] <= high) for low, high in ranges], axis=0)]
    told = (
        f"Coherence of {' or '.join(axis_names(plant.axes))} with the excitation is below {COHERENT:g} at "
        f"{_in_words(ranges)}, inside the known band: other things also move the vehicle there. The margins include "
        f"the error of the response, up to {plant.rate_error()[weak].max():.0%} there (one standard deviation)."
    )
    hit = [
        f"{axis}: {low:.3g} to {high:.3g}"
        for axis, (low, high) in zip(axis_names(plant.axes), (deciding_range(one, omega) for one in loops), strict=True)
        if any(low <= b and a <= high for a, b in ranges)
    ]
    if not hit:
        return f"{told} The crossover, which decides the margins, is elsewhere: nothing to do."
    return (
        f"{told} The region of the crossover, which decides the margins ({', '.join(hit)} rad/s), is among them: fly "
        "the experiment again in calm air, longer or stronger, and judge by that log."
    )


def deciding_range(loop: NDArray[np.complex128], omega: NDArray[np.float64]) -> Interval:
    """First and last frequency (rad/s) at which a loop's gain is within a factor of 1 that bounds it above the band.

    NaN where it never is.
    """
    size = np.abs(loop)
    near = omega[(size >= MAX_GAIN_ABOVE_BAND) & (size <= 1 / MAX_GAIN_ABOVE_BAND)]
    return (float(near[0]), float(near[-1])) if len(near) else (np.nan, np.nan)


def _in_words(ranges: Sequence[Interval]) -> str:
    """Ranges of frequencies with their unit."""
    shown = ranges if len(ranges) <= MOST_RANGES else [(ranges[0][0], ranges[-1][1])]
    text = " and ".join(f"{low:.3g}" if low == high else f"{low:.3g} to {high:.3g}" for low, high in shown)
    return f"{text} rad/s" if shown is ranges else f"{len(ranges)} ranges between {text} rad/s"
