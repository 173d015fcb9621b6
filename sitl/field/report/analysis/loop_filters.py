"""Filters in the path of the rates: which ones a vehicle's parameters name, their response and their delay."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mimopilot.tuning.gains import Gains

#: Kinds of filters.
LOW_PASS, FIRST_ORDER, NOTCH = "low-pass, second order", "low-pass, first order", "notch"
#: What a filter acts on.
RATES, DERIVATIVE = "measured rates", "derivative term"
#: Attenuation of ArduPilot's notch that stands for a complete one, dB.
COMPLETE = 60.0
#: Bits of INS_HNTCH_HMNCS that are looked at.
HARMONICS = 8

Signal = NDArray[np.float64]
Complex = NDArray[np.complex128]


@dataclass(frozen=True)
class LoopFilter:
    """One filter, as in continuous time: both autopilots run their gyro filters at 1 kHz or more.

    Attributes
    ----------
    name : str
        Parameters that set it.
    kind : str
        `LOW_PASS` (Butterworth), `FIRST_ORDER` or `NOTCH`.
    hertz : float, Hz
        Cut-off, or centre of a notch.
    acts_on : str
        `RATES` or `DERIVATIVE`.
    width_hz : float, Hz
        Of a notch, between its points of -3 dB.
    depth_db : float, dB
        Attenuation at the centre of a notch.
    """

    name: str
    kind: str
    hertz: float
    acts_on: str = RATES
    width_hz: float = 0.0
    depth_db: float = COMPLETE

    def response(self, omega: Signal) -> Complex:
        """Frequency response at frequencies (K,), rad/s."""
        s, corner = 1j * np.asarray(omega, np.float64), 2 * np.pi * self.hertz
        if self.kind == FIRST_ORDER:
            return np.asarray(corner / (s + corner))
        if self.kind == LOW_PASS:
            return np.asarray(corner**2 / (s**2 + math.sqrt(2) * corner * s + corner**2))
        wide = 2 * np.pi * self.width_hz
        left = 10 ** (-self.depth_db / 20) if self.depth_db < COMPLETE else 0.0
        return np.asarray((s**2 + left * wide * s + corner**2) / (s**2 + wide * s + corner**2))

    def delay(self) -> float:
        """Delay of slow signals, s: minus the slope of the phase at 0.

        1 / w_c of the first order, sqrt(2) / w_c of Butterworth's second, (1 - depth) w_b / w_0^2 of a notch.
        """
        corner = 2 * np.pi * self.hertz
        if self.kind == FIRST_ORDER:
            return float(1 / corner)
        if self.kind == LOW_PASS:
            return float(math.sqrt(2) / corner)
        left = 10 ** (-self.depth_db / 20) if self.depth_db < COMPLETE else 0.0
        return float((1 - left) * 2 * np.pi * self.width_hz / corner**2)

    def lag_deg(self, omega: float) -> float:
        """Phase that it takes at a frequency (rad/s), degrees."""
        return float(-np.degrees(np.angle(self.response(np.array([omega]))[0])))

    @property
    def setting(self) -> str:
        """Its frequency in words."""
        wide = f", {self.width_hz:g} Hz wide" if self.kind == NOTCH else ""
        return f"{self.hertz:g} Hz{wide}"


def filters_of(parameters: Mapping[str, float], gains: Gains | None) -> list[LoopFilter]:
    """The filters that a log's parameters name, and the derivative filter of the gains."""
    found = _of_ardupilot(parameters) if "INS_GYRO_FILTER" in parameters else _of_px4(parameters)
    if gains is not None and gains.derivative_cutoff_hz > 0:
        names = ("ATC_RAT_RLL_FLTD", "IMU_DGYRO_CUTOFF")
        name = next((one for one in names if one in parameters), "derivative_cutoff_hz")
        found.append(LoopFilter(name, FIRST_ORDER, gains.derivative_cutoff_hz, DERIVATIVE))
    return found


def moving_filters(parameters: Mapping[str, float]) -> list[str]:
    """Filters whose frequency moves in flight, in words: their delay is not one number."""
    told = []
    if parameters.get("IMU_GYRO_DNF_EN", 0) > 0:
        told.append("PX4's dynamic notches run (IMU_GYRO_DNF_EN): they move with the motors, and are not listed.")
    for name in ("INS_HNTCH", "INS_HNTC2"):
        if parameters.get(f"{name}_ENABLE", 0) == 1 and parameters.get(f"{name}_MODE", 0) > 0:
            told.append(f"{name}'s notches move with the motors ({name}_MODE): listed at their lowest frequency.")
    return told


def _of_px4(parameters: Mapping[str, float]) -> list[LoopFilter]:
    """PX4 (VehicleAngularVelocity): low-pass and two static notches; dynamic notches move and are not listed."""
    found = []
    if parameters.get("IMU_GYRO_CUTOFF", 0) > 0:
        found.append(LoopFilter("IMU_GYRO_CUTOFF", LOW_PASS, _shortest(parameters["IMU_GYRO_CUTOFF"])))
    for number in (0, 1):
        name = f"IMU_GYRO_NF{number}"
        hertz, wide = (_shortest(parameters.get(f"{name}_{part}", 0.0)) for part in ("FRQ", "BW"))
        if hertz > 0 and wide > 0:
            found.append(LoopFilter(f"{name}_FRQ, {name}_BW", NOTCH, hertz, width_hz=wide))
    return found


def _of_ardupilot(parameters: Mapping[str, float]) -> list[LoopFilter]:
    """ArduPilot (AP_InertialSensor): low-pass and harmonic notches at their lowest frequency."""
    found = []
    if parameters["INS_GYRO_FILTER"] > 0:
        found.append(LoopFilter("INS_GYRO_FILTER", LOW_PASS, _shortest(parameters["INS_GYRO_FILTER"])))
    for name in ("INS_HNTCH", "INS_HNTC2"):
        if parameters.get(f"{name}_ENABLE", 0) != 1:
            continue
        hertz, wide = (_shortest(parameters.get(f"{name}_{part}", 0.0)) for part in ("FREQ", "BW"))
        depth, harmonics = parameters.get(f"{name}_ATT", 40.0), int(parameters.get(f"{name}_HMNCS", 1))
        for k in range(HARMONICS):
            if hertz > 0 and wide > 0 and harmonics >> k & 1:
                label = f"{name}_FREQ, {name}_BW" + (f", harmonic {k + 1}" if k else "")
                found.append(LoopFilter(label, NOTCH, hertz * (k + 1), width_hz=wide * (k + 1), depth_db=depth))
    return found


def _shortest(value: float) -> float:
    """The shortest decimal of a number that vehicles store in single precision."""
    return float(str(np.float32(value)))
