"""The manoeuvres that a gain set is judged by: doublets of several lengths on each axis, a step of torque, an offset.

All figures are energies by Parseval's theorem, so the time after a manoeuvre counts until everything is at rest. Where
a stock law shapes its setpoints, the doublets are those behind the shaping, as they are logged.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from mimopilot.tuning.analysis.closed_loop import doublet_spectrum
from mimopilot.tuning.law import shaping_response
from mimopilot.tuning.law_filters import Filters
from mimopilot.tuning.plant.rigid_body_fit import LOWEST
from mimopilot.tuning.plant.wide_response import WideResponse, hat_weights
from mimopilot.tuning.reference_model import ReferenceModel

#: Amplitude of the doublets that the step of torque is compared with, rad (10 degrees).
AMPLITUDE = np.radians(10.0)
#: Offset of an angle, rad (3 degrees), whose return counts where setpoints are shaped and their rate is fed forward: a
#: gust, the limits of the shaping or a corrected estimate leaves one, and following asks for no attitude gain there.
#: By trial on flights of genuine ArduCopter with two simulated airframes: with 2 degrees noise still decides whether a
#: heading returns by the attitude gain or, slowly, by the integral; 10 change following by less than 10 %.
OFFSET = np.radians(3.0)
#: Frequencies on which the spectra are integrated: a doublet of 2 s has a lobe every 3 rad/s.
FINE = 20_000
#: The same for the torque at a few times, which are at most two periods after the doublet begins.
COARSE = 5_000
#: Share of the Nyquist frequency up to which they are: a doublet has no more power above.
HIGHEST = 0.999
#: Samples after a jump of the setpoint at which the torque is computed.
AFTER = (1, 2, 4, 6, 8, 12, 16, 20, 24, 32)

Complex = NDArray[np.complex128]
Signal = NDArray[np.float64]


@dataclass(frozen=True)
class ManoeuvreFamily:
    """The manoeuvres of roll and pitch, or of yaw.

    Attributes
    ----------
    periods : tuple of float, s
        Whole lengths of the doublets.
    acceleration : float, rad/s^2
        Angular acceleration of the step of torque.
    amplitudes : tuple of 2 float, rad
        Range of the size of the manoeuvres that the limits of the actuators are computed for.
    """

    periods: tuple[float, ...]
    acceleration: float
    amplitudes: tuple[float, float]

    @property
    def seconds(self) -> float:
        """Energy of a mean doublet of amplitude 1, s: its length."""
        return float(np.mean(self.periods))


#: Doublets from a sharp stick input to slow flight, within a normal flight's attitudes (5 to 30 degrees). The step of
#: torque by trial on the simulated airframes and PX4's simulator: half and double of it change following by less than
#: 10 %; without it the integral goes to its lower bound, and with model following the attitude gain, too.
ROLL_PITCH_FAMILY = ManoeuvreFamily((0.4, 0.7, 1.2, 2.0), 1.5, (np.radians(5.0), np.radians(30.0)))
#: A multirotor's yaw has about a fifth of the others' bandwidth and torque, and a third of the disturbance: no gust
#: lifts one side. A heading setpoint is limited in its slew by position controllers and pilots: its jumps are small.
YAW_FAMILY = ManoeuvreFamily((1.2, 2.0, 3.5, 6.0), 0.5, (np.radians(5.0), np.radians(10.0)))


def family_of(axes: int) -> ManoeuvreFamily:
    """The manoeuvres of a number of axes, see `tuning.axes`: one is yaw."""
    return YAW_FAMILY if axes == 1 else ROLL_PITCH_FAMILY


@dataclass(frozen=True, eq=False)
class Manoeuvres:
    """Weights of the manoeuvres on the frequencies of a plant.

    Attributes
    ----------
    omega : (K,) array, rad/s
    doublets : (4, K) array, s
        One row for each of the family's periods: the energy of E times a doublet of amplitude 1 is the sum over
        frequency of the row times |E|^2.
    step : (K, n) array, s
        The same for D and the step of torque on each axis.
    offset : (K,) array, s
        The same for the sensitivity at the angles and the offset of an angle; 0: it does not count.
    model : ReferenceModel
        What the attitude should follow, on every axis.
    family : ManoeuvreFamily
    """

    omega: Signal
    doublets: Signal
    step: Signal
    offset: Signal
    model: ReferenceModel
    family: ManoeuvreFamily

    @cached_property
    def target(self) -> Complex:
        """Response of the model, (K,)."""
        return self.model.frequency_response(self.omega)

    @cached_property
    def moved(self) -> float:
        """Mean energy of the model's own angle over the doublets of amplitude 1, s."""
        return float((self.doublets @ np.abs(self.target) ** 2).mean())

    @cached_property
    def following(self) -> Signal:
        """Weights of the mean relative energy of the error over all doublets and axes, (K,)."""
        weight: Signal = self.doublets.mean(axis=0) / self.moved / self.step.shape[1]
        return weight

    @cached_property
    def disturbance(self) -> Signal:
        """Weights of the relative energy of the angles after the step of torque, mean over the axes, (K, n)."""
        return self._relative(self.step)

    @cached_property
    def returning(self) -> Signal:
        """Weights of the relative energy of the angles that return from the offset, mean over the axes, (K,)."""
        return self._relative(self.offset)

    def _relative(self, energy: Signal) -> Signal:
        weight: Signal = energy / (AMPLITUDE**2 * self.family.seconds) / self.step.shape[1]
        return weight


def manoeuvres(plant: WideResponse, model: ReferenceModel, filters: Filters) -> Manoeuvres:
    """The doublets and the step of torque of its axes on the frequencies of a plant.

    Parameters
    ----------
    plant : WideResponse
    model : ReferenceModel
        Of the attitude.
    filters : Filters
        Of the law whose shaping the setpoints have.
    """
    family = family_of(plant.axes)
    fine = np.linspace(LOWEST, HIGHEST * np.pi / plant.Ts, FINE)
    shaped = np.abs(shaping_response(filters, fine)) ** 2
    spectra = np.array([np.abs(doublet_spectrum(fine, period)) ** 2 * shaped / np.pi for period in family.periods])
    logarithmic = np.geomspace(LOWEST, fine[-1], FINE)
    step = hat_weights(plant.omega, logarithmic, logarithmic**-2.0 / np.pi)
    torque = family.acceleration / np.abs(np.diag(plant.body.B))
    return Manoeuvres(
        omega=plant.omega,
        doublets=hat_weights(plant.omega, fine, spectra.T).T,
        step=step[:, None] * torque**2,
        offset=step * (OFFSET**2 if any(filters.shaping) else 0.0),
        model=model,
        family=family,
    )


def doublet_torque(
    plant: WideResponse, filters: Filters, amplitude: float, lags: Sequence[float] = (0.0,)
) -> list[Complex]:
    """For each lag the weights (T, K) whose product with U gives, in its real part, the torque in the doublets.

    At the times when it is largest: after the setpoint jumps.

    Parameters
    ----------
    plant : WideResponse
    filters : Filters
        Of the law whose shaping the setpoints have.
    amplitude : float, rad
    lags : sequence of float, s
        Of the rotors, for the torque behind them; 0: as commanded.
    """
    fine = np.linspace(LOWEST, HIGHEST * np.pi / plant.Ts, COARSE)
    found: list[list[Complex]] = [[] for _ in lags]
    shaped = shaping_response(filters, fine)
    for period in family_of(plant.axes).periods:
        times = [begin + (k + 0.5) * plant.Ts for begin in (0.0, period / 2, period) for k in AFTER]
        waves = np.exp(1j * np.outer(fine, times))
        spectrum = amplitude * doublet_spectrum(fine, period) * shaped / np.pi
        for rows, lag in zip(found, lags, strict=True):
            rows.append(hat_weights(plant.omega, fine, (spectrum / (1 + 1j * fine * lag))[:, None] * waves).T)
    return [np.concatenate(rows) for rows in found]
