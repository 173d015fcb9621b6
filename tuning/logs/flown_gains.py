"""The gains that flew, from the vehicle's parameters.

This controller's (``MIMO_``), else those of PX4 (``MC_``) or ArduPilot (``ATC_``).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from mimopilot.tuning.errors import TuningError
from mimopilot.tuning.gains import Gains, Limits
from mimopilot.tuning.parameter_row import AXIS_LETTERS, PREFIX, Row, Shape
from mimopilot.tuning.parameters import ROWS, SCALE
from mimopilot.tuning.provenance import Provenance


@dataclass(frozen=True)
class _Stock:
    """Parameters of an autopilot's own controller.

    Attributes
    ----------
    axes : tuple of 3 str
        Its names of roll, pitch and yaw.
    gains : mapping
        Matrix -> parameter of an axis.
    factor : str
        Parameter of an axis that multiplies the rate terms; empty: none.
    limits : mapping
        Limit -> for each axis its parameter, the factor to our unit, and the value where it is not logged (NaN: not
        known).
    cutoffs : mapping
        Cut-off of a filter -> parameter, Hz.
    unlimited : mapping
        Limit -> value where the parameter is 0, which means that there is no limit.
    """

    axes: tuple[str, str, str]
    gains: Mapping[str, str]
    factor: str
    limits: Mapping[str, list[tuple[str, float, float]]]
    cutoffs: Mapping[str, str]
    unlimited: Mapping[str, tuple[float, ...]] = field(default_factory=dict)


_DEGREE = math.pi / 180
_PX4_AXES = ("ROLL", "PITCH", "YAW")
_PX4 = _Stock(
    axes=_PX4_AXES,
    gains={
        "Kp_o": "MC_{axis}_P",
        "Kp_i": "MC_{axis}RATE_P",
        "Ki_i": "MC_{axis}RATE_I",
        "Kd_i": "MC_{axis}RATE_D",
        "Kff_i": "MC_{axis}RATE_FF",
    },
    factor="MC_{axis}RATE_K",
    limits={
        "rate_max": [(f"MC_{axis}RATE_MAX", _DEGREE, math.nan) for axis in _PX4_AXES],
        "moment_max": [("", 1.0, 1.0)] * 3,
        "integral_max": [(name, 1.0, math.nan) for name in ("MC_RR_INT_LIM", "MC_PR_INT_LIM", "MC_YR_INT_LIM")],
    },
    cutoffs={"derivative_cutoff_hz": "IMU_DGYRO_CUTOFF"},
)
_ARDUPILOT_AXES = ("RLL", "PIT", "YAW")
_ARDUPILOT = _Stock(
    axes=_ARDUPILOT_AXES,
    gains={
        "Kp_o": "ATC_ANG_{axis}_P",
        "Kp_i": "ATC_RAT_{axis}_P",
        "Ki_i": "ATC_RAT_{axis}_I",
        "Kd_i": "ATC_RAT_{axis}_D",
        "Kff_i": "ATC_RAT_{axis}_FF",
    },
    factor="",
    limits={
        "rate_max": [(f"ATC_RATE_{letter}_MAX", _DEGREE, 0.0) for letter in AXIS_LETTERS],
        "moment_max": [("", 1.0, 1.0)] * 3,
        "integral_max": [(f"ATC_RAT_{axis}_IMAX", 1.0, math.nan) for axis in _ARDUPILOT_AXES],
    },
    cutoffs={"derivative_cutoff_hz": "ATC_RAT_RLL_FLTD"},
    unlimited={"rate_max": Limits().rate_max},
)
#: The period is that of the log.
_PERIOD = next(row for row in ROWS if row.key == "Ts")


def flown_gains(parameters: Mapping[str, float], Ts: float) -> Gains | None:
    """The gains in a vehicle's parameters.

    Parameters
    ----------
    parameters : mapping
        Parameter name -> value, as logged.
    Ts : float, s
        Control period.

    Returns
    -------
    Gains or None
        None when the parameters do not describe a complete controller, or one that cannot run with that period.
        Elements without a ``MIMO_`` parameter in the log (yaw, limits) are the autopilot's own.
    """
    # Vehicles store float32: use the shortest decimal that rounds to the same float32.
    values = {name: float(str(np.float32(value))) for name, value in parameters.items()}
    found: dict[Row, Any] = {_PERIOD: Ts}
    for row in ROWS:
        if row is _PERIOD or (row.default is not None and not any(PREFIX + code in values for code in row.codes)):
            continue
        numbers = []
        for code in row.codes:
            ours = values.get(PREFIX + code)
            numbers.append(_stock(row, code, values) if ours is None else _of_the_file(row, ours, Ts))
        if not all(row.shape is Shape.POLE or row.valid.holds(number) for number in numbers):
            return None
        found[row] = numbers[0] if len(numbers) == 1 else numbers
    scale: Any = tuple(values.get(f"{PREFIX}{SCALE}_{letter}") for letter in AXIS_LETTERS)
    try:
        gains = Gains.from_rows(found, provenance=Provenance("flown"))
    except TuningError:  # such as an attitude model that is too fast for the period of the log
        return None
    return replace(gains, moment_scale=None if None in scale else scale)


def _of_the_file(row: Row, element: float, Ts: float) -> float:
    """What a gains file has for an element of the controller; a cut-off to 6 digits, as precise as its pole."""
    return float(f"{row.value(element, Ts):.6g}") if row.shape is Shape.POLE else element


def _stock(row: Row, code: str, values: Mapping[str, float]) -> float:
    """What the autopilot's own controller has for an element; not a number where the log does not tell."""
    stock = _ARDUPILOT if "ATC_RAT_RLL_P" in values else _PX4
    if row.shape is Shape.POLE:
        return values.get(stock.cutoffs.get(row.key, ""), row.default or 0.0)
    if row.shape is Shape.SCALAR:
        return math.nan if row.default is None else row.default
    if row.shape is not Shape.AXES and row.key not in stock.gains:
        return math.nan
    *_, axes = code.rpartition("_")
    if axes[0] != axes[-1]:
        return 0.0
    axis = AXIS_LETTERS.index(axes[0])
    if row.shape is Shape.AXES:
        name, factor, default = stock.limits[row.key][axis]
        return factor * values.get(name, default) or stock.unlimited.get(row.key, (0.0, 0.0, 0.0))[axis]
    name = stock.axes[axis]
    factor = 1.0 if row.key == "Kp_o" else values.get(stock.factor.format(axis=name), 1.0)
    return factor * values.get(stock.gains[row.key].format(axis=name), math.nan)
