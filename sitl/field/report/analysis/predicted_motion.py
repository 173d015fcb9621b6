"""Motion over time that a gain set will give the vehicle of a log: doublets, and a step of torque."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mimopilot.tuning.analysis.closed_loop import doublet_spectrum
from mimopilot.tuning.analysis.manoeuvres import AMPLITUDE, ROLL_PITCH_FAMILY
from mimopilot.tuning.design.free_gains import free_gains
from mimopilot.tuning.design.loop_gradient import LoopGradient
from mimopilot.tuning.gains import Gains
from mimopilot.tuning.law import shaping_response
from mimopilot.tuning.plant.frequency_response import SAME_PERIOD
from mimopilot.tuning.plant.wide_response import WideResponse

#: Whole length of the doublet and time shown, s; size of the doublet: that of `tuning.analysis.manoeuvres`.
PERIOD, SHOWN, BEFORE = 1.2, 2.5, 0.1
#: Points of a curve; frequencies of the inverse transform, whose step repeats the motion after 2 pi over it: 50 s.
POINTS, FREQUENCIES = 261, 6000
#: Plants drawn for the band: as many as a prediction's error uses.
DRAWS = 12

Complex = NDArray[np.complex128]
Signal = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class PredictedMotion:
    """Angles over time, (T, 2, 2) each: [time, angle, axis that is moved], degrees.

    Attributes
    ----------
    time : (T,) array, s
    doublet, torque : (T, 2, 2) arrays, deg
        After a doublet of the attitude setpoint, and after a step of torque.
    doublet_band, torque_band : (T, 2, 2) arrays, deg
        Two standard deviations, from the error of the measured response.
    """

    time: Signal
    doublet: Signal
    torque: Signal
    doublet_band: Signal
    torque_band: Signal


def predicted_motion(gains: Gains, plant: WideResponse) -> PredictedMotion | None:
    """Motion of a gain set; None for another control period than that of the response."""
    if abs(gains.Ts / plant.Ts - 1) > SAME_PERIOD:
        return None
    time = np.linspace(-BEFORE, SHOWN, POINTS)
    fine: Signal = np.asarray((np.arange(FREQUENCIES) + 0.5) * (np.pi / plant.Ts * 0.999 / FREQUENCIES), np.float64)
    step = fine[1] - fine[0]
    turn = np.exp(1j * np.outer(time, fine)) * (step / np.pi)
    sharp = AMPLITUDE * doublet_spectrum(fine, PERIOD) * shaping_response(gains.filters, fine)
    torque = ROLL_PITCH_FAMILY.acceleration / np.abs(np.diag(plant.body.B))

    def motion(around: WideResponse) -> tuple[Signal, Signal]:
        free = free_gains(gains, around.body)
        loop = LoopGradient(around, free, free.vector(gains))
        # D / (j w), the answer to a step, hardly changes where D falls like w: it is what is continued below.
        answers = (
            _between(fine, around.omega, loop.T) * sharp[:, None, None],
            _between(fine, around.omega, loop.D / (1j * around.omega[:, None, None])) * torque,
        )
        doublet, pushed = ((turn @ one.reshape(len(fine), 4)).real.reshape(-1, 2, 2) for one in answers)
        return np.degrees(doublet), np.degrees(pushed)

    generator = np.random.default_rng(0)
    doublet, pushed = motion(plant)
    drawn = [motion(plant.draw(generator)) for _ in range(DRAWS)]
    bands = [2 * np.std([one[k] for one in drawn], axis=0) for k in range(2)]
    return PredictedMotion(time, doublet, pushed, *bands)


def doublet_setpoint(time: Signal) -> Signal:
    """The setpoint of the doublet at some times (s), deg."""
    inside = (time >= 0) & (time < PERIOD)
    return np.where(inside, np.where(time < PERIOD / 2, 1.0, -1.0), 0.0) * float(np.degrees(AMPLITUDE))


def _between(fine: Signal, omega: Signal, response: Complex) -> Complex:
    """A response (K, 2, 2) at other frequencies, linear in between."""
    found: Complex = np.empty((len(fine), 2, 2), complex)
    for i in range(2):
        for j in range(2):
            column = response[:, i, j]
            found[:, i, j] = np.interp(fine, omega, column.real) + 1j * np.interp(fine, omega, column.imag)
    return found
