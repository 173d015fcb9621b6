"""The controller's difference equation in Python, and its inverse.

`Controller` is an independent, step-by-step statement of the equation that the generated C++ flies;
with ``dtype=np.float32`` it must return the same bits. `rebuild_rate_setpoint` runs the inner loop's
controller backwards, (3.32)-(3.34) of the thesis, for tuning the outer loop.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from mimopilot.tuning.errors import NotMinimumPhaseError
from mimopilot.tuning.gains import MATRICES, Gains, derivative_pole
from numpy.typing import NDArray
from scipy.linalg import schur
from scipy.signal import lfilter

HOLD_SAMPLES = 25
MAX_RATE = 100.0
MAX_ANGLE = 4 * np.pi
MAX_EXCITATION = 1.0


@dataclass
class Step:
    """What one control period gives: u, r_i and the faults, each for roll, pitch, yaw."""

    moment: NDArray[Any]
    rates_setpoint: NDArray[Any]
    fault: int
    fault_count: int


class Controller:
    """The flown controller, one period at a time, in the precision of `dtype`.

    Parameters
    ----------
    gains : Gains
        What it flies with; rounded to `dtype`.
    dtype : type
        ``np.float32`` for the bits of the C++, ``np.float64`` for analysis.
    """

    def __init__(self, gains: Gains, dtype: type = np.float32) -> None:
        self.f = dtype
        self._take(gains)
        zero = [self.f(0)] * 3
        self.integral, self.derivative = list(zero), list(zero)
        self.setpoint, self.attitude, self.rates = list(zero), list(zero), list(zero)
        self.age = [[HOLD_SAMPLES + 1] * 3 for _ in range(3)]
        self.fault_count = 0

    def _take(self, gains: Gains) -> None:
        """Round the gains: block-diagonal 3x3 matrices, yaw last."""
        f = self.f
        self.matrix = {
            name: [
                [f(v) for v in getattr(gains, name)[0]] + [f(0)],
                [f(v) for v in getattr(gains, name)[1]] + [f(0)],
                [f(0), f(0), f(getattr(gains.yaw, name))],
            ]
            for name in MATRICES
        }
        self.rate_max = [f(v) for v in gains.limits.rate_max]
        self.moment_max = [f(v) for v in gains.limits.moment_max]
        self.integral_max = [f(v) for v in gains.limits.integral_max]
        self.pole, self.period = f(gains.derivative_pole), f(gains.Ts)

    def _times(self, name: str, x: list[Any], axis: int) -> Any:
        gain = self.matrix[name][axis]
        return gain[2] * x[2] if axis == 2 else gain[0] * x[0] + gain[1] * x[1]

    def _clamp(self, value: Any, limit: Any) -> Any:
        return limit if value > limit else -limit if value < -limit else value

    def _rates_setpoint(self) -> list[Any]:
        f = self.f
        error = [s - a for s, a in zip(self.setpoint, self.attitude, strict=True)]
        turn, half_turn = f(2 * np.pi), f(np.pi)
        while error[2] > half_turn:
            error[2] = error[2] - turn
        while error[2] < -half_turn:
            error[2] = error[2] + turn
        return [self._clamp(self._times("Kp_o", error, j), self.rate_max[j]) for j in range(3)]

    def _output(self, integral: list[Any]) -> list[Any]:
        """V = ((Kp e + I) - Kd d) + Kff r, in this order of rounding."""
        r = self._rates_setpoint()
        e = [a - b for a, b in zip(r, self.rates, strict=True)]
        return [
            ((self._times("Kp_i", e, j) + integral[j]) - self._times("Kd_i", self.derivative, j))
            + self._times("Kff_i", r, j)
            for j in range(3)
        ]

    def set_gains(self, gains: Gains) -> None:
        """Change the gains; I is re-seated so that v is continuous, within its limit (bumpless)."""
        before = self._output(self.integral)
        self._take(gains)
        rest = self._output([self.f(0)] * 3)
        for j in range(3):
            integrates = any(gain != 0 for gain in self.matrix["Ki_i"][j])
            self.integral[j] = self._clamp(before[j] - rest[j], self.integral_max[j]) if integrates else self.f(0)

    def _accept(self, kind: int, held: list[Any], values: NDArray[Any], limit: float) -> None:
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
        """One period.

        Parameters
        ----------
        setpoint, attitude : (3,) arrays, rad
            Roll, pitch, yaw.
        rates : (3,) array, rad/s
            Body rates.
        excitation : (3,) array, optional
            u_bar, dimensionless.
        saturation : (3,) array, optional
            Sign of the moment that the allocator could not give in the last period.
        armed, landed : bool
            Disarmed: I = 0. Landed: I held.
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

        r = self._rates_setpoint()
        e = [a - b for a, b in zip(r, self.rates, strict=True)]
        dI = [self.period * self._times("Ki_i", e, j) for j in range(3)]
        attempt = self._output([i + d for i, d in zip(self.integral, dI, strict=True)])
        for j in range(3):
            high = attempt[j] + u_bar[j] > self.moment_max[j] or flags[j] > 0
            low = attempt[j] + u_bar[j] < -self.moment_max[j] or flags[j] < 0
            if landed or (high and dI[j] > 0) or (low and dI[j] < 0):
                dI[j] = f(0)
            self.integral[j] = self._clamp(self.integral[j] + dI[j], self.integral_max[j]) if armed else f(0)
        v = self._output(self.integral)
        u = [self._clamp(v[j] + u_bar[j], self.moment_max[j]) for j in range(3)]
        return Step(np.array(u, f), np.array(r, f), 0, self.fault_count)

    def _damp_rates(self, valid: list[bool], fault: int, armed: bool) -> Step:
        """U = -Kp y_i - Kd d on the axes whose rate is valid, zero on the others; I frozen."""
        f = self.f
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


def filtered_derivative(y: NDArray[np.float64], Ts: float, cutoff_hz: float) -> NDArray[np.float64]:
    """d(k) = a d(k-1) + (1-a) (y(k) - y(k-1)) / Ts with d(0) = 0, along axis 0.

    Parameters
    ----------
    y : (N, n) array
        Measured signal, any unit.
    Ts : float, s
        Sampling period.
    cutoff_hz : float, Hz
        Cut-off f_d of the filter; 0 means none (a = 0).

    Returns
    -------
    (N, n) array
        The unit of `y` per second.
    """
    a = derivative_pole(cutoff_hz, Ts)
    slope = np.diff(y, axis=0, prepend=y[:1]) / Ts
    filtered: NDArray[np.float64] = lfilter([1 - a], [1, -a], slope, axis=0)
    return filtered


def inverse_eigenvalues(Kp: NDArray[np.float64], Ki: NDArray[np.float64], Kff: NDArray[np.float64], Ts: float) -> Any:
    """Eigenvalues of I - Ts Ki G_c^-1, G_c = Kp + Ts Ki + Kff: the poles of the inverse controller.

    Raises
    ------
    NotMinimumPhaseError
        When G_c is singular: the controller has no inverse.
    """
    Gc = Kp + Ts * Ki + Kff
    if np.linalg.cond(Gc) > 1e12:
        raise NotMinimumPhaseError(f"the inner controller has no inverse: Kp + Ts Ki + Kff = {Gc.tolist()} is singular")
    return np.linalg.eigvals(np.eye(len(Gc)) - Ts * Ki @ np.linalg.inv(Gc))


def rebuild_rate_setpoint(
    gains: Gains, u: NDArray[np.float64], y_i: NDArray[np.float64]
) -> tuple[NDArray[np.float64], int]:
    """Rate set-point that the inner controller would have needed to make `u`: e_i = C_i^-1 u.

    The recursion e(k) = G_c^-1 (u(k) - I(k-1) + Kd d(k) - Kff y_i(k)), I(k) = I(k-1) + Ts Ki e(k) is
    solved by a Schur form of I - Ts Ki G_c^-1, one first-order filter a state.

    Parameters
    ----------
    gains : Gains
        The inner loop's gains (roll and pitch).
    u : (N, 2) array
        Control moment applied to the plant, injection included: the virtual controller makes all of it.
    y_i : (N, 2) array, rad/s
        Measured body rates.

    Returns
    -------
    r_i : (N, 2) array, rad/s
        The rebuilt set-point; its first samples hold the transient of the unknown initial integrator.
    settling : int, samples
        After so many samples that transient is below 1 %.

    Raises
    ------
    NotMinimumPhaseError
        When the inner controller is not minimum phase, with the eigenvalues; or has no inverse.
    """
    Ts, Ki, Kff = gains.Ts, gains.Ki_i, gains.Kff_i
    eigenvalues = inverse_eigenvalues(gains.Kp_i, Ki, Kff, Ts)
    # An integrator that is not used (a zero row of Ki) leaves its state at rest: an eigenvalue of exactly 1.
    at_rest = np.isclose(eigenvalues, 1.0, rtol=0, atol=1e-12)
    if np.any(np.abs(eigenvalues[~at_rest]) >= 1) or (at_rest.any() and np.linalg.matrix_rank(Ki) + at_rest.sum() > 2):
        raise NotMinimumPhaseError(
            "the inner controller cannot be run backwards, it is not minimum phase: eigenvalues of I - Ts Ki Gc^-1 are "
            f"{', '.join(f'{v:.6g}' for v in eigenvalues)}, expected inside the unit circle; "
            f"Ki_i = {Ki.round(6).tolist()} should be positive definite"
        )
    inverse = np.linalg.inv(gains.Kp_i + Ts * Ki + Kff)
    known = u + filtered_derivative(y_i, Ts, gains.derivative_cutoff_hz) @ gains.Kd_i.T - y_i @ Kff.T
    push = known @ (Ts * Ki @ inverse).T
    triangle, basis = schur(np.eye(2) - Ts * Ki @ inverse, output="complex")
    drive = push @ basis.conj()
    states = np.zeros_like(drive)
    for i in (1, 0):  # upper triangular: the last state depends on itself alone
        coupled = drive[:, i].copy()
        for j in range(i + 1, 2):
            coupled[1:] += triangle[i, j] * states[:-1, j]
        states[:, i] = lfilter([1], [1, -triangle[i, i]], coupled)
    integral = (states @ basis.T).real
    previous = np.vstack([np.zeros((1, 2)), integral[:-1]])
    error = (known - previous) @ inverse.T
    moving = np.abs(eigenvalues[~at_rest])
    slowest = float(moving.max()) if len(moving) else 0.0
    settling = int(np.ceil(np.log(0.01) / np.log(slowest))) if 0 < slowest < 1 else 0
    return error + y_i, settling
