"""Motion over time that a gain set will give the vehicle of a log: doublets, and a step of torque."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mimopilot.tuning.analysis.closed_loop import doublet_spectrum
from mimopilot.tuning.analysis.manoeuvres import AMPLITUDE, HIGHEST, family_of
from mimopilot.tuning.axes import Law
from mimopilot.tuning.design.free_gains import free_gains
from mimopilot.tuning.design.loop_gradient import LoopGradient
from mimopilot.tuning.law import shaping_response
from mimopilot.tuning.plant.frequency_response import SAME_PERIOD
from mimopilot.tuning.plant.wide_response import WideResponse

#: Place of the doublet among the lengths of `tuning.analysis.manoeuvres`, whose size it has: one that is followed to
#: rest in each half.
LENGTH = 2
#: Number of axes of roll and pitch together.
BOTH = 2
#: Time shown, in lengths of the doublet, and before it, s.
SHOWN, BEFORE = 2.1, 0.1
#: Points of a curve; frequencies of the inverse transform, whose step repeats the motion after 2 pi over it: 50 s,
#: on yaw 140 s.
POINTS, FREQUENCIES = 161, 6000
#: Plants drawn for the band: as many as a prediction's error uses.
DRAWS = 12

Complex = NDArray[np.complex128]
Signal = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class PredictedMotion:
    """Angles of n axes over time, (T, n, n) each: [time, angle, axis that is moved], degrees.

    Attributes
    ----------
    time : (T,) array, s
    setpoint : (T,) array, deg
        The doublet.
    doublet, torque : (T, n, n) arrays, deg
        After a doublet of the attitude setpoint, and after a step of torque.
    doublet_band, torque_band : (T, n, n) arrays, deg
        Two standard deviations, from the error of the measured response.
    """

    time: Signal
    setpoint: Signal
    doublet: Signal
    torque: Signal
    doublet_band: Signal
    torque_band: Signal


def predicted_motion(law: Law, plant: WideResponse) -> PredictedMotion | None:
    """Motion of the law of the plant's axes; None for another control period than that of the response."""
    if abs(law.Ts / plant.Ts - 1) > SAME_PERIOD:
        return None
    n, period = plant.axes, period_of(plant.axes)
    time = np.linspace(-BEFORE, SHOWN * period, POINTS)
    # A longer motion is a slower one: the frequencies end lower, and the motion repeats later.
    top = HIGHEST * np.pi / plant.Ts * period_of(BOTH) / period
    fine: Signal = np.asarray((np.arange(FREQUENCIES) + 0.5) * (top / FREQUENCIES), np.float64)
    step = fine[1] - fine[0]
    turn = np.exp(1j * np.outer(time, fine)) * (step / np.pi)
    sharp = AMPLITUDE * doublet_spectrum(fine, period) * shaping_response(law.filters, fine)
    torque = family_of(n).acceleration / np.abs(np.diag(plant.body.B))

    def motion(around: WideResponse) -> tuple[Signal, Signal]:
        free = free_gains(law, around.body)
        loop = LoopGradient(around, free, free.vector(law))
        yielded = loop.D / (1j * around.omega[:, None, None])
        steps = _between(fine, around.omega, yielded)
        low = fine < around.omega[0]
        steps[low] = _from_stiffness(fine[low], float(around.omega[0]), yielded[0])
        answers = (_between(fine, around.omega, loop.T) * sharp[:, None, None], steps * torque)
        doublet, pushed = ((turn @ one.reshape(len(fine), n * n)).real.reshape(-1, n, n) for one in answers)
        # Without an integral the angle stays: the transform, whose mean is 0, then begins below 0.
        return np.degrees(doublet), np.degrees(pushed - pushed[time < 0].mean(axis=0))

    doublet, pushed = motion(plant)
    drawn = [motion(one) for one in drawn_plants(plant)]
    bands = [2 * np.std([one[k] for one in drawn], axis=0) for k in range(2)]
    return PredictedMotion(time, doublet_setpoint(time, period), doublet, pushed, *bands)


def drawn_plants(plant: WideResponse) -> list[WideResponse]:
    """Plants within the error of a response, always the same ones: two sets around them are compared in pairs."""
    generator = np.random.default_rng(0)
    return [plant.draw(generator) for _ in range(DRAWS)]


def period_of(axes: int) -> float:
    """Whole length of the doublet of a number of axes, s; one axis is yaw."""
    return family_of(axes).periods[LENGTH]


def doublet_setpoint(time: Signal, period: float) -> Signal:
    """The setpoint of a doublet at some times (s), deg."""
    inside = (time >= 0) & (time < period)
    return np.where(inside, np.where(time < period / 2, 1.0, -1.0), 0.0) * float(np.degrees(AMPLITUDE))


def _between(fine: Signal, omega: Signal, response: Complex) -> Complex:
    """A response (K, n, n) at other frequencies, linear in between."""
    found: Complex = np.empty((len(fine), *response.shape[1:]), complex)
    for i, j in np.ndindex(*response.shape[1:]):
        column = response[:, i, j]
        found[:, i, j] = np.interp(fine, omega, column.real) + 1j * np.interp(fine, omega, column.imag)
    return found


def _from_stiffness(omega: Signal, above: float, response: Complex) -> Complex:
    """Answer to a step of torque below the frequency `above` at which it is `response` (n, n), (K, n, n).

    There a loop with an integral resists like a spring and a damper: the inverse, Kp_o Ki + s (Kp_o Kp + Ki) of one
    axis, is a constant plus s times a constant. The pole of both is slower than the lowest measured frequency of yaw.
    """
    inverse = np.linalg.inv(response)
    stiffness: Complex = inverse.real + 1j * inverse.imag * (omega / above)[:, None, None]
    return np.asarray(np.linalg.inv(stiffness))
