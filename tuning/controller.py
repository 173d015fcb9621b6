"""Independent reference of the generated C++: the flown law, step by step.

With ``dtype=np.float32`` `Controller` must return the same bits as the C++.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mimopilot.tuning.gains import Gains
from mimopilot.tuning.parameters import MATRICES, YAW_GAINS

# The same numbers as in `firmware_templates/core/mimo_pid.hpp`.
#: Periods for which the last valid input replaces an invalid one: 0.1 s at 250 Hz.
HOLD_SAMPLES = 25
#: Largest valid body rate, rad/s: above the range of gyros, 2000 deg/s.
MAX_RATE = 100.0
#: Largest valid angle, rad: two turns.
MAX_ANGLE = 4 * np.pi
#: Largest valid excitation, torque (normalised).
MAX_EXCITATION = 1.0


@dataclass
class Step:
    """Output of one control period: u, r_i and the faults, each for roll, pitch, yaw."""

    moment: NDArray[Any]
    rates_setpoint: NDArray[Any]
    fault: int
    fault_count: int


@dataclass(frozen=True)
class ModelState:
    """Attitude model of roll and pitch: angle (rad), rate (rad/s) and angular acceleration (rad/s^2)."""

    angle: list[Any]
    rate: list[Any]
    acceleration: list[Any]


class Controller:
    """The flown controller, one period at a time, in the precision of `dtype`.

    Parameters
    ----------
    gains : Gains
        Rounded to `dtype`.
    dtype : type
        ``np.float32`` for the bits of the C++, ``np.float64`` for analysis.
    """

    def __init__(self, gains: Gains, dtype: type = np.float32) -> None:
        self.f = dtype
        self._load(gains)
        zero = [self.f(0)] * 3
        self.integral, self.derivative = list(zero), list(zero)
        self.setpoint, self.attitude, self.rates = list(zero), list(zero), list(zero)
        self.age = [[HOLD_SAMPLES + 1] * 3 for _ in range(3)]
        self.fault_count = 0
        #: None: it starts at the measured attitude, at rest, with the next armed sample without a fault.
        self.model: ModelState | None = None

    def _load(self, gains: Gains) -> None:
        """Round and store the gains: block-diagonal 3x3 matrices, yaw last."""
        f = self.f
        self.matrix = {
            name: [
                [f(v) for v in getattr(gains, name)[0]] + [f(0)],
                [f(v) for v in getattr(gains, name)[1]] + [f(0)],
                [f(0), f(0), f(getattr(gains.yaw, name)) if name in YAW_GAINS else f(0)],
            ]
            for name in MATRICES
        }
        self.rate_max = [f(v) for v in gains.limits.rate_max]
        self.moment_max = [f(v) for v in gains.limits.moment_max]
        self.integral_max = [f(v) for v in gains.limits.integral_max]
        self.pole, self.period = f(gains.filters.derivative_pole), f(gains.Ts)
        self.omega, self.damping = f(gains.filters.model_omega), f(gains.filters.model_damping)

    def _times(self, name: str, x: list[Any], axis: int) -> Any:
        """One row of a matrix times x."""
        gain = self.matrix[name][axis]
        return gain[2] * x[2] if axis == 2 else gain[0] * x[0] + gain[1] * x[1]

    def _clamp(self, value: Any, limit: Any) -> Any:
        return limit if value > limit else -limit if value < -limit else value

    def _advanced_model(self) -> ModelState | None:
        """The attitude model one period later; None: no model following."""
        if self.omega == 0:
            return None
        if self.model is None:
            zero = self.f(0)
            return ModelState(self.attitude[:2], [zero, zero], [zero, zero])
        stiffness, friction = self.omega * self.omega, self.f(2) * self.damping * self.omega
        angle, rate, acceleration = [], [], []
        for j in range(2):
            acceleration.append(stiffness * (self.setpoint[j] - self.model.angle[j]) - friction * self.model.rate[j])
            rate.append(self.model.rate[j] + self.period * acceleration[j])
            angle.append(self.model.angle[j] + self.period * rate[j])
        return ModelState(angle, rate, acceleration)

    def _rates_setpoint(self, model: ModelState | None) -> list[Any]:
        f = self.f
        wanted = self.setpoint if model is None else [*model.angle, self.setpoint[2]]
        error = [s - a for s, a in zip(wanted, self.attitude, strict=True)]
        turn, half_turn = f(2 * np.pi), f(np.pi)
        while error[2] > half_turn:
            error[2] = error[2] - turn
        while error[2] < -half_turn:
            error[2] = error[2] + turn
        r = [self._times("Kp_o", error, j) for j in range(3)]
        if model is not None:
            r = [r[0] + self._times("Kff_o", model.rate, 0), r[1] + self._times("Kff_o", model.rate, 1), r[2]]
        return [self._clamp(r[j], self.rate_max[j]) for j in range(3)]

    def _output(self, integral: list[Any], model: ModelState | None) -> list[Any]:
        """V = ((Kp e + I) - Kd d) + (Kff r + Kaff al), in this order of rounding."""
        r = self._rates_setpoint(model)
        e = [a - b for a, b in zip(r, self.rates, strict=True)]
        feedforward = [self._times("Kff_i", r, j) for j in range(3)]
        if model is not None:
            for j in range(2):
                feedforward[j] = feedforward[j] + self._times("Kaff_i", model.acceleration, j)
        return [
            ((self._times("Kp_i", e, j) + integral[j]) - self._times("Kd_i", self.derivative, j)) + feedforward[j]
            for j in range(3)
        ]

    def set_gains(self, gains: Gains) -> None:
        """Change the gains; I is adjusted within its limit so that the output is continuous (bumpless).

        The outputs compared are those of the next period if the inputs stay as they are.
        """
        before = self._output(self.integral, self._advanced_model())
        self._load(gains)
        rest = self._output([self.f(0)] * 3, self._advanced_model())
        if self.omega == 0:
            self.model = None
        for j in range(3):
            integrates = any(gain != 0 for gain in self.matrix["Ki_i"][j])
            self.integral[j] = self._clamp(before[j] - rest[j], self.integral_max[j]) if integrates else self.f(0)

    def _accept(self, kind: int, held: list[Any], values: NDArray[Any], limit: float) -> None:
        """Store valid values; count and hold over invalid ones."""
        for i in range(3):
            if -self.f(limit) <= values[i] <= self.f(limit):
                held[i] = self.f(values[i])
                self.age[kind][i] = 0
            else:
                self.fault_count += 1
                self.age[kind][i] = min(self.age[kind][i] + 1, HOLD_SAMPLES + 1)

    def step(
        self,
        setpoint: NDArray[Any],
        attitude: NDArray[Any],
        rates: NDArray[Any],
        excitation: NDArray[Any] | None = None,
        saturation: NDArray[Any] | None = None,
        armed: bool = True,
        landed: bool = False,
    ) -> Step:
        """Run one period.

        Parameters
        ----------
        setpoint, attitude : (3,) arrays, rad
            Roll, pitch, yaw.
        rates : (3,) array, rad/s
            Body rates.
        excitation : (3,) array, optional
            u_bar, torque (normalised).
        saturation : (3,) array, optional
            Sign of the torque that the allocator could not produce in the last period.
        armed, landed : bool
            Disarmed: I = 0, and the attitude model stays at the measured attitude. Landed: I held.
        """
        f = self.f
        u_bar = [f(0)] * 3 if excitation is None else [f(v) for v in excitation]
        flags = [0] * 3 if saturation is None else [int(v) for v in saturation]

        before, fresh = list(self.rates), [age > HOLD_SAMPLES for age in self.age[2]]
        self._accept(0, self.setpoint, setpoint, MAX_ANGLE)
        self._accept(1, self.attitude, attitude, MAX_ANGLE)
        self._accept(2, self.rates, rates, MAX_RATE)
        valid = [age <= HOLD_SAMPLES for age in self.age[2]]
        slope = (f(1) - self.pole) / self.period
        for i in range(3):
            filtered = self.pole * self.derivative[i] + slope * (self.rates[i] - before[i])
            self.derivative[i] = filtered if valid[i] and not fresh[i] else f(0)
        fault = sum(1 << (3 * kind + i) for kind in range(3) for i in range(3) if self.age[kind][i] > HOLD_SAMPLES)
        for i in range(3):
            if not -f(MAX_EXCITATION) <= u_bar[i] <= f(MAX_EXCITATION):
                self.fault_count += not np.isnan(u_bar[i])  # NaN: nothing is injected
                u_bar[i] = f(0)
        if fault:
            return self._damp_rates(valid, fault, armed)

        if not armed:
            self.model = None
        model = self._advanced_model()
        self.model = model if armed else None
        r = self._rates_setpoint(model)
        e = [a - b for a, b in zip(r, self.rates, strict=True)]
        dI = [self.period * self._times("Ki_i", e, j) for j in range(3)]
        attempt = self._output([i + d for i, d in zip(self.integral, dI, strict=True)], model)
        for j in range(3):
            high = attempt[j] + u_bar[j] > self.moment_max[j] or flags[j] > 0
            low = attempt[j] + u_bar[j] < -self.moment_max[j] or flags[j] < 0
            if landed or (high and dI[j] > 0) or (low and dI[j] < 0):
                dI[j] = f(0)
            self.integral[j] = self._clamp(self.integral[j] + dI[j], self.integral_max[j]) if armed else f(0)
        v = self._output(self.integral, model)
        u = [self._clamp(v[j] + u_bar[j], self.moment_max[j]) for j in range(3)]
        return Step(np.array(u, f), np.array(r, f), 0, self.fault_count)

    def _damp_rates(self, valid: list[bool], fault: int, armed: bool) -> Step:
        """U = -Kp y_i - Kd d on axes with a valid rate, zero on the others; I is frozen."""
        f = self.f
        self.model = None
        if not armed:
            self.integral = [f(0)] * 3
        y = [rate if ok else f(0) for rate, ok in zip(self.rates, valid, strict=True)]
        u = [
            self._clamp(-self._times("Kp_i", y, j) - self._times("Kd_i", self.derivative, j), self.moment_max[j])
            if valid[j]
            else f(0)
            for j in range(3)
        ]
        return Step(np.array(u, f), np.zeros(3, f), fault, self.fault_count)
