"""The gains that flew, from the vehicle's parameters: this controller's (``MIMO_``), else PX4's (``MC_``)."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from mimopilot.tuning.errors import TuningError
from mimopilot.tuning.gains import Gains
from mimopilot.tuning.parameter_row import AXIS_LETTERS, PREFIX, Row, Shape
from mimopilot.tuning.parameters import ROWS, SCALE
from mimopilot.tuning.provenance import Provenance

#: Matrix -> PX4's parameter for an axis. PX4 multiplies the rate terms by MC_*RATE_K.
_PX4 = {
    "Kp_o": "MC_{axis}_P",
    "Kp_i": "MC_{axis}RATE_P",
    "Ki_i": "MC_{axis}RATE_I",
    "Kd_i": "MC_{axis}RATE_D",
    "Kff_i": "MC_{axis}RATE_FF",
}
_PX4_AXES = ("ROLL", "PITCH", "YAW")
#: Limit -> PX4's parameter of each axis, its factor to our unit, and its value where it is not logged (NaN: not known).
_PX4_LIMITS = {
    "rate_max": [(f"MC_{axis}RATE_MAX", math.pi / 180, math.nan) for axis in _PX4_AXES],
    "moment_max": [("", 1.0, 1.0)] * 3,
    "integral_max": [(name, 1.0, math.nan) for name in ("MC_RR_INT_LIM", "MC_PR_INT_LIM", "MC_YR_INT_LIM")],
}
#: Cut-off of a filter -> PX4's parameter, Hz.
_PX4_CUTOFFS = {"derivative_cutoff_hz": "IMU_DGYRO_CUTOFF"}
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
        Elements without a ``MIMO_`` parameter in the log (yaw, limits) are PX4's.
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
    """What PX4's own controller has for an element; not a number where the log does not tell."""
    if row.shape is Shape.POLE:
        return values.get(_PX4_CUTOFFS.get(row.key, ""), row.default or 0.0)
    if row.shape is not Shape.AXES and row.key not in _PX4:
        return math.nan
    *_, axes = code.rpartition("_")
    if axes[0] != axes[-1]:
        return 0.0
    axis = AXIS_LETTERS.index(axes[0])
    if row.shape is Shape.AXES:
        name, factor, default = _PX4_LIMITS[row.key][axis]
        return factor * values.get(name, default)
    name = _PX4_AXES[axis]
    factor = 1.0 if row.key == "Kp_o" else values.get(f"MC_{name}RATE_K", 1.0)
    return factor * values.get(_PX4[row.key].format(axis=name), math.nan)
