"""The excitation: a pseudo-random binary torque, PRBS, with random hold times."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from mimopilot.tuning.errors import TuningError

#: How many times longer yaw's pulses are than those of roll and pitch, as in the firmware (`kYawHold`). Chosen: torque
#: accelerates yaw 10 to 20 times less, so its loop is slower; pulses twice as long still excite it up to 8 Hz.
YAW_HOLD = 2


def hold_from_bandwidth(bandwidth: float, Ts: float) -> tuple[int, int]:
    """Hold times of a PRBS whose shortest pulse is half a period of `bandwidth`.

    Parameters
    ----------
    bandwidth : float, rad/s
        Upper end w of the band to excite.
    Ts : float, s
        Control period.

    Returns
    -------
    hold_min, hold_max : int, samples
        round(pi / (w Ts)) and four times that.

    Raises
    ------
    TuningError
        When the bandwidth is not between 0 and the Nyquist frequency.
    """
    if not 0 < bandwidth <= math.pi / Ts:
        raise TuningError(
            f"bandwidth: got {bandwidth} rad/s, expected more than 0 and at most {math.pi / Ts:.4g} rad/s"
        )
    hold_min = max(1, round(math.pi / (bandwidth * Ts)))
    return hold_min, 4 * hold_min


def prbs(
    samples: int, amplitude: float, hold_min: int, hold_max: int, generator: np.random.Generator
) -> NDArray[np.float64]:
    """Signal of two values with alternating sign, each held for a random number of samples.

    A constant hold time would put nulls into the spectrum, so it is drawn from ``hold_min..hold_max`` (both included).

    Parameters
    ----------
    samples : int
        Length N.
    amplitude : float
        Absolute value of the signal, in the unit of u.
    hold_min, hold_max : int, samples
        Range of the hold times.
    generator : numpy.random.Generator
        Source of the randomness.

    Returns
    -------
    (N,) array
        The signal.

    Raises
    ------
    TuningError
        When the hold times are not 1 <= hold_min <= hold_max or N is negative.
    """
    if samples < 0:
        raise TuningError(f"prbs: got {samples} samples, expected 0 or more")
    signal = np.empty(samples)
    stream = pulses(hold_min, hold_max, generator)
    start = 0
    while start < samples:  # draws only the pulses it needs: the caller draws from the generator next
        sign, hold = next(stream)
        signal[start : start + hold] = sign * amplitude
        start += hold
    return signal


def pulses(hold_min: int, hold_max: int, generator: np.random.Generator) -> Iterator[tuple[float, int]]:
    """Pulses of `prbs`, one at a time, without end.

    Parameters
    ----------
    hold_min, hold_max, generator
        As in `prbs`.

    Yields
    ------
    sign : float
        1 or -1.
    hold : int, samples
        Length of the pulse.

    Raises
    ------
    TuningError
        When the hold times are not 1 <= hold_min <= hold_max.
    """
    if not 1 <= hold_min <= hold_max:
        raise TuningError(f"prbs: got hold {hold_min}..{hold_max}; expected 1 <= min <= max")
    sign = 1.0 if generator.integers(2) else -1.0
    while True:
        yield sign, int(generator.integers(hold_min, hold_max, endpoint=True))
        sign = -sign
