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
#: Largest valid difference of a quaternion's squared length from 1.
MAX_NORM_ERROR = 0.02
#: Largest valid excitation, torque (normalised).
MAX_EXCITATION = 1.0
#: Bits of the faults: setpoint, attitude, and three of the rates from there on.
SETPOINT_FAULT, ATTITUDE_FAULT, RATE_FAULT = 1, 2, 4
#: Cosine of half the tilt below which the attitude error has no turn.
INVERTED = 0.0045


@dataclass
class Step:
    """Output of one control period: u, r_i and the faults, each for roll, pitch, yaw."""

    moment: NDArray[Any]
    rates_setpoint: NDArray[Any]
    fault: int
    fault_count: int


@dataclass(frozen=True)
class ModelState:
    """Attitude model of roll and pitch: angle (rad), rate (rad/s) and angular acceleration (rad/s^2).

    In the axes of the setpoint's heading; the angle is 2 sin of half the tilt, times its axis.
    """

    angle: list[Any]
    rate: list[Any]
    acceleration: list[Any]


@dataclass(frozen=True)
class AttitudeError:
    """Attitude error of roll, pitch, yaw (rad), and cosine and sine of the turn about z that is in it."""

    axes: list[Any]
    turn: tuple[Any, Any]


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
        level = [self.f(1), *zero]
        #: The flown attitude setpoint and the last valid attitude: quaternions w, x, y, z.
        self.setpoint, self.attitude = list(level), list(level)
        self.yaw_rate, self.rates = self.f(0), list(zero)
        #: r_i, and the acceleration of the attitude model in body axes.
        self.rates_setpoint, self.acceleration = list(zero), list(zero[:2])
        self.rate_mode = self.slewing = False
        self.age = [HOLD_SAMPLES + 1] * 5
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
        self.yaw_weight, self.slew = f(gains.filters.yaw_weight), f(gains.filters.setpoint_slew)

    def _times(self, name: str, x: list[Any], axis: int) -> Any:
        """One row of a matrix times x."""
        gain = self.matrix[name][axis]
        return gain[2] * x[2] if axis == 2 else gain[0] * x[0] + gain[1] * x[1]

    def _clamp(self, value: Any, limit: Any) -> Any:
        return limit if value > limit else -limit if value < -limit else value

    def _root(self, square: Any) -> Any:
        return np.sqrt(square) if square > 0 else self.f(0)

    def _attitude_error(self, target: list[Any]) -> AttitudeError:
        """Error from the measured attitude to a target, its turn weighted; in body axes."""
        f, weight = self.f, self.yaw_weight
        aw, ax, ay, az = self.attitude
        bw, bx, by, bz = target
        w = aw * bw + ax * bx + ay * by + az * bz
        x = aw * bx - ax * bw - ay * bz + az * by
        y = aw * by + ax * bz - ay * bw - az * bx
        z = aw * bz - ax * by + ay * bx - az * bw
        if w < 0:
            w, x, y, z = -w, -x, -y, -z
        square = w * w + z * z
        cosine = self._root(square)
        if cosine < f(INVERTED):
            return AttitudeError([f(2) * x, f(2) * y, f(0)], (f(1), f(0)))
        along, across = cosine - weight * (cosine - w), weight * z
        scale = f(2) / (cosine * self._root(along * along + across * across))
        roll, pitch = x * w - y * z, y * w + x * z
        error = [
            scale * (roll * along + pitch * across),
            scale * (pitch * along - roll * across),
            scale * (square * z),
        ]
        share = f(2) * z / square
        return AttitudeError(error, (f(1) - share * z, share * w))

    def _heading(self) -> tuple[Any, Any]:
        """Cosine and sine of half the heading of the setpoint."""
        cosine = self._root(self.setpoint[0] * self.setpoint[0] + self.setpoint[3] * self.setpoint[3])
        if cosine < self.f(INVERTED):
            return self.f(1), self.f(0)
        share = self.f(1) / cosine
        return self.setpoint[0] * share, self.setpoint[3] * share

    def _advanced_model(self) -> ModelState | None:
        """The attitude model one period later; None: no model following."""
        if self.omega == 0 or self.rate_mode:
            return None
        zero, two = self.f(0), self.f(2)
        if self.model is None:
            return ModelState(self._measured_direction(), [zero, zero], [zero, zero])
        cosine, sine = self._heading()
        _, x, y, _ = self.setpoint
        wanted = [two * (cosine * x + sine * y), two * (cosine * y - sine * x)]
        stiffness, friction = self.omega * self.omega, two * self.damping * self.omega
        angle, rate, acceleration = [], [], []
        for j in range(2):
            acceleration.append(stiffness * (wanted[j] - self.model.angle[j]) - friction * self.model.rate[j])
            rate.append(self.model.rate[j] + self.period * acceleration[j])
            angle.append(self.model.angle[j] + self.period * rate[j])
        return ModelState(angle, rate, acceleration)

    def _measured_direction(self) -> list[Any]:
        """Measured direction of body z: 2 imag of the tilt, in the axes of the setpoint's heading."""
        q, two, (cosine, sine) = self.attitude, self.f(2), self._heading()
        w, x = cosine * q[0] + sine * q[3], cosine * q[1] + sine * q[2]
        y, z = cosine * q[2] - sine * q[1], cosine * q[3] - sine * q[0]
        length = self._root(w * w + z * z)
        if length < self.f(INVERTED):
            return [two * x, two * y]
        scale = two / length
        return [scale * (x * w - y * z), scale * (y * w + x * z)]

    def _model_attitude(self, model: ModelState) -> list[Any]:
        """Quaternion with the setpoint's heading and the model's tilt."""
        f = self.f
        cosine, sine = self._heading()
        roll, pitch = f(0.5) * model.angle[0], f(0.5) * model.angle[1]
        tilt = self._root(f(1) - (roll * roll + pitch * pitch))
        return [cosine * tilt, cosine * roll - sine * pitch, cosine * pitch + sine * roll, sine * tilt]

    def _rates_setpoint(self, model: ModelState | None) -> tuple[list[Any], list[Any]]:
        """Rate setpoint, and the acceleration of the attitude model in body axes."""
        f = self.f
        still = [f(0), f(0)]
        if self.rate_mode:
            return list(self.rates_setpoint), still
        error = self._attitude_error(self.setpoint if model is None else self._model_attitude(model))
        w, x, y, z = self.attitude
        turn = f(2) * self.yaw_rate
        down = [x * z - w * y, y * z + w * x, f(0.5) - (x * x + y * y)]  # half of earth's z axis
        r = [self._times("Kp_o", error.axes, j) + turn * down[j] for j in range(3)]
        acceleration = still
        if model is not None:
            cosine, sine = error.turn
            rate, acceleration = (
                [cosine * v[0] - sine * v[1], sine * v[0] + cosine * v[1]] for v in (model.rate, model.acceleration)
            )
            r = [r[0] + self._times("Kff_o", rate, 0), r[1] + self._times("Kff_o", rate, 1), r[2]]
        return [self._clamp(r[j], self.rate_max[j]) for j in range(3)], acceleration

    def _rest(self, r: list[Any], acceleration: list[Any]) -> list[Any]:
        """V without I: (Kp e - Kd d) + (Kff r + Kaff al), in this order of rounding."""
        e = [a - b for a, b in zip(r, self.rates, strict=True)]
        feedforward = [self._times("Kff_i", r, j) for j in range(3)]
        if self.omega != 0:
            for j in range(2):
                feedforward[j] = feedforward[j] + self._times("Kaff_i", acceleration, j)
        return [
            (self._times("Kp_i", e, j) - self._times("Kd_i", self.derivative, j)) + feedforward[j] for j in range(3)
        ]

    def _next_rest(self) -> list[Any]:
        """V without I of the next period, if the inputs stay as they are."""
        return self._rest(*self._rates_setpoint(self._advanced_model()))

    def set_gains(self, gains: Gains) -> None:
        """Change the gains; I is adjusted within its limit so that the output is continuous (bumpless).

        The outputs compared are those of the next period if the inputs stay as they are.
        """
        before = [a + b for a, b in zip(self._next_rest(), self.integral, strict=True)]
        self._load(gains)
        rest = self._next_rest()
        if self.omega == 0:
            self.model, self.acceleration = None, [self.f(0)] * 2
        for j in range(3):
            integrates = any(gain != 0 for gain in self.matrix["Ki_i"][j])
            self.integral[j] = self._clamp(before[j] - rest[j], self.integral_max[j]) if integrates else self.f(0)

    def _expired(self, kind: int, valid: bool, silent: bool) -> bool:
        """Count an invalid sample of one input; whether it was invalid for too long."""
        if valid and not silent:
            self.age[kind] = 0
            return False
        self.fault_count += 1
        self.age[kind] = HOLD_SAMPLES + 1 if silent else min(self.age[kind] + 1, HOLD_SAMPLES + 1)
        return self.age[kind] > HOLD_SAMPLES

    def _quaternion(self, given: NDArray[Any]) -> list[Any] | None:
        """A quaternion in the precision of the controller; None: its length is not 1."""
        w, x, y, z = q = [self.f(v) for v in given]
        with np.errstate(over="ignore", invalid="ignore"):
            error = abs(((w * w + x * x) + y * y) + z * z - self.f(1))
        return q if error <= self.f(MAX_NORM_ERROR) else None

    def _normalised(self, q: list[Any]) -> list[Any]:
        scale = self.f(1) / self._length(q)
        return [a * scale for a in q]

    def _optional(self, value: Any, limit: float) -> Any:
        """The value, or 0 for NaN, which means none, and for an invalid value, which counts as a fault."""
        if -self.f(limit) <= value <= self.f(limit):
            return self.f(value)
        self.fault_count += not np.isnan(value)
        return self.f(0)

    def _slew(self, target: list[Any], limit: Any) -> list[Any]:
        """The flown setpoint, turned towards a target by at most twice `limit` (rad)."""
        q = self.setpoint
        along = q[0] * target[0] + q[1] * target[1] + q[2] * target[2] + q[3] * target[3]
        sign = self.f(-1) if along < 0 else self.f(1)
        across = [sign * (b - along * a) for a, b in zip(q, target, strict=True)]
        distance = self._length(across)
        if distance <= limit:
            return target
        step = limit / distance
        return self._normalised([a + step * c for a, c in zip(q, across, strict=True)])

    def _length(self, q: list[Any]) -> Any:
        return self._root(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])

    def _accept_setpoint(self, setpoint: NDArray[Any], yaw_rate: Any, silent: int, armed: bool) -> int:
        """Take over a setpoint of the present mode; its fault bit."""
        f = self.f
        if self.rate_mode:
            given = [f(v) for v in setpoint] if np.all(np.abs(setpoint) <= f(MAX_RATE)) else None
            self.rates_setpoint = given or self.rates_setpoint
            self.model, self.acceleration = None, [f(0), f(0)]
        else:
            given, limit = self._quaternion(setpoint), f(0.5) * (self.slew * self.period)
            if given and limit != 0:
                self.setpoint = self.setpoint if self.slewing else list(self.attitude)
                given, self.slewing = self._slew(given, limit), armed
            self.setpoint = given or self.setpoint
        failed = self._expired(0, given is not None, bool(silent & SETPOINT_FAULT))
        if self.rate_mode or not armed:
            self.slewing = False
        self.yaw_rate = self._optional(yaw_rate, MAX_RATE)
        return SETPOINT_FAULT if failed else 0

    def step(
        self,
        setpoint: NDArray[Any],
        attitude: NDArray[Any],
        rates: NDArray[Any],
        excitation: NDArray[Any] | None = None,
        saturation: NDArray[Any] | None = None,
        armed: bool = True,
        landed: bool = False,
        yaw_rate: float = 0.0,
        rate_mode: bool = False,
        silent: int = 0,
    ) -> Step:
        """Run one period.

        Parameters
        ----------
        setpoint : (4,) array, or (3,) array, rad/s, in rate mode
            Attitude setpoint, a unit quaternion w, x, y, z; or rate setpoint.
        attitude : (4,) array
            Unit quaternion w, x, y, z, body to earth; not used in rate mode.
        rates : (3,) array, rad/s
            Body rates.
        excitation : (3,) array, optional
            u_bar, torque (normalised).
        saturation : (3,) array, optional
            Sign of the torque that the allocator could not produce in the last period.
        armed, landed : bool
            Disarmed: I = 0, and the attitude model stays at the measured attitude. Landed: I held.
        yaw_rate : float, rad/s
            Of the attitude setpoint, about earth's z axis; NaN: none.
        rate_mode : bool
            The rate gains alone follow a rate setpoint.
        silent : int
            Fault bits of the inputs whose source has stopped.
        """
        f = self.f
        u_bar = [f(0)] * 3 if excitation is None else [f(v) for v in excitation]
        flags = [0] * 3 if saturation is None else [int(v) for v in saturation]

        self.rate_mode = rate_mode
        given = self._quaternion(attitude)
        self.attitude = given or self.attitude
        lost_attitude = self._expired(1, given is not None, bool(silent & ATTITUDE_FAULT))
        fault = ATTITUDE_FAULT * (lost_attitude and not rate_mode)
        fault |= self._accept_setpoint(setpoint, yaw_rate, silent, armed)
        lost = [False] * 3
        slope = (f(1) - self.pole) / self.period
        for i in range(3):
            before, first = self.rates[i], self.age[2 + i] > HOLD_SAMPLES
            ok = bool(-f(MAX_RATE) <= rates[i] <= f(MAX_RATE))
            self.rates[i] = f(rates[i]) if ok else before
            lost[i] = self._expired(2 + i, ok, bool(silent & RATE_FAULT << i))
            fault |= (RATE_FAULT << i) * lost[i]
            filtered = self.pole * self.derivative[i] + slope * (self.rates[i] - before)
            self.derivative[i] = f(0) if lost[i] or first else filtered
            self.rates[i] = f(0) if lost[i] else self.rates[i]
        if fault:
            return self._damp_rates(lost, fault, armed)

        u_bar = [self._optional(v, MAX_EXCITATION) for v in u_bar]
        if not any(self.age):
            self.model = self._advanced_model()
            self.rates_setpoint, self.acceleration = self._rates_setpoint(self.model)
        if not armed:
            self.model, self.acceleration = None, [f(0)] * 2
        r = self.rates_setpoint
        rest = [a + b for a, b in zip(self._rest(r, self.acceleration), u_bar, strict=True)]
        u = []
        for j in range(3):
            limit = self.moment_max[j]
            dI = self.period * self._times("Ki_i", [a - b for a, b in zip(r, self.rates, strict=True)], j)
            attempt = rest[j] + (self.integral[j] + dI)
            high, low = attempt > limit or flags[j] > 0, attempt < -limit or flags[j] < 0
            if landed or (high and dI > 0) or (low and dI < 0):
                dI = f(0)
            self.integral[j] = self._clamp(self.integral[j] + dI, self.integral_max[j]) if armed else f(0)
            u.append(self._clamp(rest[j] + self.integral[j], limit))
        return Step(np.array(u, f), np.array(r, f), 0, self.fault_count)

    def _damp_rates(self, lost: list[bool], fault: int, armed: bool) -> Step:
        """U = -Kp y_i - Kd d on axes with a valid rate, zero on the others; I is frozen."""
        f = self.f
        self.model, self.slewing = None, False
        self.rates_setpoint, self.acceleration = [f(0)] * 3, [f(0)] * 2
        if not armed:
            self.integral = [f(0)] * 3
        v = self._rest(self.rates_setpoint, self.acceleration)
        u = [f(0) if lost[j] else self._clamp(v[j], self.moment_max[j]) for j in range(3)]
        return Step(np.array(u, f), np.zeros(3, f), fault, self.fault_count)
