"""PX4's attitude and rate controllers, as a stock PX4 flies them: the bench's second autopilot.

Written from PX4's description of its controllers (docs.px4.io, Controller Diagrams; mc_att_control, mc_rate_control):

- attitude: the error quaternion is a tilt, then a turn about z, whose angle is scaled by MC_YAW_WEIGHT. The rate
  setpoint is P times twice its vector part, P of yaw divided by the weight, plus the yaw rate setpoint about earth's z
  axis, limited; what the autotune adds comes after the limit. It acts in the next period:
  the rate controller runs first.
- rate: K (P e + I integral of e - D derivative of the measured rate) + FF setpoint. The integral takes the error of
  before the step with the factor max(0, 1 - (e / 400 deg/s)^2), is clamped by the signs of the unallocated torque, held
  on the ground and zero while disarmed. First-order low-passes: IMU_DGYRO_CUTOFF on the derivative, MC_YAW_TQ_CUTOFF on
  the yaw torque. The gyro's low-pass is that of the bench's sensors.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import lru_cache
from typing import Any

import numba
import numpy as np
from numba.np import numpy_support
from numpy.typing import NDArray

from mimopilot.codegen.layout import INPUT, OUTPUT

#: rad/s; rate error from which on PX4 integrates nothing.
INTEGRAL_FADE = math.radians(400.0)
#: Below this cosine of half the turn the error is a half turn, of which no tilt can be split off.
SMALLEST_TURN = 1e-5
AXES = ("ROLL", "PITCH", "YAW")
INTEGRAL_LIMITS = ("MC_RR_INT_LIM", "MC_PR_INT_LIM", "MC_YR_INT_LIM")

#: Gains and memory of the law.
PX4_STATE = np.dtype(
    [
        ("angle_p", "<f8", 3),
        ("yaw_weight", "<f8"),
        ("rate_max", "<f8", 3),
        ("rate_p", "<f8", 3),
        ("rate_i", "<f8", 3),
        ("rate_d", "<f8", 3),
        ("rate_ff", "<f8", 3),
        ("integral_max", "<f8", 3),
        ("derivative_alpha", "<f8"),
        ("yaw_alpha", "<f8"),
        ("Ts", "<f8"),
        ("integral", "<f8", 3),
        ("rates", "<f8", 3),
        ("derivative", "<f8", 3),
        ("yaw_torque", "<f8"),
        ("rates_setpoint", "<f8", 3),
        ("started", "<i8"),
    ]
)


def _attitude_error(q, d, weight):  # type: ignore[no-untyped-def]
    """Twice the vector part of the attitude error from q to d (w, x, y, z), its turn about z scaled."""
    w = q[0] * d[0] + q[1] * d[1] + q[2] * d[2] + q[3] * d[3]
    x = q[0] * d[1] - q[1] * d[0] - q[2] * d[3] + q[3] * d[2]
    y = q[0] * d[2] + q[1] * d[3] - q[2] * d[0] - q[3] * d[1]
    z = q[0] * d[3] - q[1] * d[2] + q[2] * d[1] - q[3] * d[0]
    n = math.sqrt(w * w + z * z)
    if n > SMALLEST_TURN:
        if w < 0.0:
            n = -n
        half = weight * math.atan2(z / n, w / n)
        # The tilt is the error times the inverse of its turn; the scaled turn follows it.
        cw, cz = w / n, -z / n
        tw, tx, ty = w * cw - z * cz, x * cw + y * cz, y * cw - x * cz
        sw, sz = math.cos(half), math.sin(half)
        w, x, y, z = tw * sw, tx * sw + ty * sz, ty * sw - tx * sz, tw * sz
    sign = 2.0 if w >= 0.0 else -2.0
    return sign * x, sign * y, sign * z


_attitude_error_compiled = numba.njit(error_model="numpy")(_attitude_error)


def _step(state_pointer, input_pointer, output_pointer):  # type: ignore[no-untyped-def]
    """One control period, called as the generated controller's step is."""
    s, i, o = numba.carray(state_pointer, 1)[0], numba.carray(input_pointer, 1)[0], numba.carray(output_pointer, 1)[0]
    q = i.attitude
    for axis in range(3):
        o.rates_setpoint[axis] = s.rates_setpoint[axis] if i.rate_mode == 0 else i.rates_setpoint[axis]
    if i.rate_mode == 0:
        ex, ey, ez = _attitude_error_compiled(q, i.attitude_setpoint, s.yaw_weight)
        turn = 0.0 if np.isnan(i.yaw_rate_setpoint) else i.yaw_rate_setpoint
        down = (
            2.0 * (q[1] * q[3] - q[0] * q[2]),
            2.0 * (q[2] * q[3] + q[0] * q[1]),
            1.0 - 2.0 * (q[1] * q[1] + q[2] * q[2]),
        )
        error = (ex, ey, ez)
        for axis in range(3):
            wanted = s.angle_p[axis] * error[axis] + down[axis] * turn
            wanted = min(max(wanted, -s.rate_max[axis]), s.rate_max[axis])
            s.rates_setpoint[axis] = wanted + i.excitation[axis]
    for axis in range(3):
        rate, wanted = i.rates[axis], o.rates_setpoint[axis]
        slope = (rate - s.rates[axis]) / s.Ts if s.started else 0.0
        s.rates[axis] = rate
        s.derivative[axis] += s.derivative_alpha * (slope - s.derivative[axis])
        error = wanted - rate
        if i.armed == 0:
            s.integral[axis] = 0.0
        torque = (
            s.rate_p[axis] * error + s.integral[axis] - s.rate_d[axis] * s.derivative[axis] + s.rate_ff[axis] * wanted
        )
        if i.landed == 0:
            if i.saturation[axis] > 0:
                error = min(error, 0.0)
            elif i.saturation[axis] < 0:
                error = max(error, 0.0)
            share = max(0.0, 1.0 - (error / INTEGRAL_FADE) ** 2)
            integral = s.integral[axis] + share * s.rate_i[axis] * error * s.Ts
            if np.isfinite(integral):
                s.integral[axis] = min(max(integral, -s.integral_max[axis]), s.integral_max[axis])
        if axis == 2:
            s.yaw_torque += s.yaw_alpha * (torque - s.yaw_torque)
            torque = s.yaw_torque
        o.moment[axis] = torque if np.isfinite(torque) else 0.0
    s.started = 1
    o.fault = 0


@lru_cache
def _compiled_step() -> Any:
    """The compiled step; it takes seconds, which only those who fly it wait for."""
    pointers = [numba.types.CPointer(numpy_support.from_dtype(dtype)) for dtype in (PX4_STATE, INPUT, OUTPUT)]
    return numba.cfunc(numba.types.void(*pointers), error_model="numpy")(_step)


def _alpha(cutoff_hz: float, Ts: float) -> float:
    """Weight of a new sample in PX4's first-order low-pass; a cut-off of 0 filters nothing."""
    return 1.0 if cutoff_hz <= 0 else Ts / (Ts + 1 / (math.tau * cutoff_hz))


class Px4Controller:
    """The law with its memory, in place of a generated controller.

    Parameters
    ----------
    parameters : mapping
        PX4's parameters by name, see `sitl.autopilot.px4_parameters`.
    Ts : float, s
        Control period.

    Attributes
    ----------
    state : (1,) array of `PX4_STATE`
    step_address : int
        Address of the step function.
    """

    def __init__(self, parameters: Mapping[str, float], Ts: float) -> None:
        self.state: NDArray[Any] = np.zeros(1, PX4_STATE)
        self.state["Ts"] = self.Ts = Ts
        self.configure(parameters)

    @property
    def step_address(self) -> int:
        """Address of the step function, for calls from compiled loops."""
        return int(_compiled_step().address)

    def configure(self, parameters: Mapping[str, float]) -> None:
        """Take over parameters; the memory stays."""
        s, p = self.state[0], parameters
        weight = min(max(p["MC_YAW_WEIGHT"], 0.0), 1.0)
        angle = [p[f"MC_{axis}_P"] for axis in AXES]
        s["yaw_weight"], s["angle_p"] = weight, [*angle[:2], angle[2] / weight if weight > 1e-4 else angle[2]]
        s["rate_max"] = [math.radians(p[f"MC_{axis}RATE_MAX"]) for axis in AXES]
        for field, letter in (("rate_p", "P"), ("rate_i", "I"), ("rate_d", "D")):
            s[field] = [p[f"MC_{axis}RATE_{letter}"] * p[f"MC_{axis}RATE_K"] for axis in AXES]
        s["rate_ff"] = [p[f"MC_{axis}RATE_FF"] for axis in AXES]
        s["integral_max"] = [p[name] for name in INTEGRAL_LIMITS]
        cutoff = p["IMU_DGYRO_CUTOFF"]
        # PX4 switches this filter off from half the rate on.
        s["derivative_alpha"] = _alpha(cutoff, self.Ts) if cutoff < 0.5 / self.Ts else 1.0
        s["yaw_alpha"] = _alpha(p["MC_YAW_TQ_CUTOFF"], self.Ts)
