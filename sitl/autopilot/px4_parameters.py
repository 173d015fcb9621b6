"""Parameters of the bench's stock PX4: those of its controllers, its autotune and its log."""

from __future__ import annotations

import math
from typing import NamedTuple

from mimopilot.sitl.autopilot.px4_law import AXES, INTEGRAL_LIMITS
from mimopilot.tuning.gains import Gains
from mimopilot.tuning.parameters import YAW_GAINS
from mimopilot.tuning.px4_names import (
    AUTOTUNE_AMPLITUDE,
    AUTOTUNE_APPLY,
    AUTOTUNE_ENABLE,
    AUTOTUNE_RISE_TIME,
    AUTOTUNE_START,
    DEFAULT_TOPICS,
    LOG_PROFILE,
)

#: Parameters that only the autotune's module uses: without it they are in no list.
OF_THE_AUTOTUNE = (AUTOTUNE_AMPLITUDE, AUTOTUNE_APPLY, AUTOTUNE_RISE_TIME, AUTOTUNE_START)


class Px4Parameter(NamedTuple):
    """A parameter of PX4, its value at the first boot, and whether it is an INT32."""

    name: str
    value: float
    integer: bool = False
    writable: bool = True


def px4_parameters(gains: Gains, gyro_cutoff_hz: float) -> tuple[Px4Parameter, ...]:
    """The parameters of a stock PX4 that flies with the diagonal of some gains.

    Parameters
    ----------
    gains : Gains
        Their off-diagonals have no counterpart.
    gyro_cutoff_hz : float, Hz
        Low-pass of the bench's gyro, which no parameter changes.
    """
    table: list[Px4Parameter] = []
    for i, axis in enumerate(AXES):
        values = [float(getattr(gains.yaw, name) if i == 2 else getattr(gains, name)[i, i]) for name in YAW_GAINS]
        table.append(Px4Parameter(f"MC_{axis}_P", values[0]))
        table += [
            Px4Parameter(f"MC_{axis}RATE_{letter}", value)
            for letter, value in zip(("P", "I", "D", "FF"), values[1:], strict=True)
        ]
        table += [
            Px4Parameter(f"MC_{axis}RATE_K", 1.0),
            Px4Parameter(INTEGRAL_LIMITS[i], gains.limits.integral_max[i]),
            Px4Parameter(f"MC_{axis}RATE_MAX", math.degrees(gains.limits.rate_max[i])),
        ]
    # Without another source the values are PX4 v1.16's defaults.
    return (
        *table,
        Px4Parameter("MC_YAW_WEIGHT", gains.filters.yaw_weight),
        Px4Parameter("MC_YAW_TQ_CUTOFF", 2.0),
        Px4Parameter("IMU_GYRO_CUTOFF", gyro_cutoff_hz, writable=False),
        Px4Parameter("IMU_DGYRO_CUTOFF", gains.derivative_cutoff_hz),
        Px4Parameter("IMU_GYRO_RATEMAX", round(1 / gains.Ts), integer=True, writable=False),
        Px4Parameter(AUTOTUNE_ENABLE, 0, integer=True),
        Px4Parameter(AUTOTUNE_APPLY, 1, integer=True),
        Px4Parameter(AUTOTUNE_RISE_TIME, 0.14),
        Px4Parameter(AUTOTUNE_START, 0, integer=True),
        Px4Parameter(AUTOTUNE_AMPLITUDE, 0.7),
        Px4Parameter(LOG_PROFILE, DEFAULT_TOPICS, integer=True),
    )
