"""Memory layout of the controller's structures, as NumPy types.

`GAINS` comes from the parameter table, the others mirror ``core/mimo_pid.hpp``. `codegen.native` checks sizes, offsets
and the interface hash when it loads a library.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from mimopilot.codegen.errors import CodegenError
from mimopilot.tuning.gains import Gains
from mimopilot.tuning.parameter_row import Row
from mimopilot.tuning.parameters import PARAMETERS, ROWS

GAINS = np.dtype(("<f4", (len(PARAMETERS),)))

INPUT = np.dtype(
    [
        ("attitude_setpoint", "<f4", 4),
        ("yaw_rate_setpoint", "<f4"),
        ("attitude", "<f4", 4),
        ("rates_setpoint", "<f4", 3),
        ("rates", "<f4", 3),
        ("excitation", "<f4", 3),
        ("saturation", "<i4", 3),
        ("silent", "<i4"),
        ("rate_mode", "<i4"),
        ("armed", "<i4"),
        ("landed", "<i4"),
    ]
)

OUTPUT = np.dtype(
    [
        ("moment", "<f4", 3),
        ("rates_setpoint", "<f4", 3),
        ("fault", "<i4"),
        ("fault_count", "<u4"),
    ]
)

MODEL = np.dtype(
    [
        ("angle", "<f4", 2),
        ("rate", "<f4", 2),
        ("acceleration", "<f4", 2),
        ("running", "<i4"),
    ]
)

STATE = np.dtype(
    [
        ("hold", "<i4", 5),
        ("missing", "<i4"),
        ("expired", "<i4"),
        ("fault_count", "<u4"),
        ("rate_mode", "<i4"),
        ("slewing", "<i4"),
        ("rates_setpoint", "<f4", 3),
        ("acceleration", "<f4", 2),
        ("model", MODEL),
        ("attitude_setpoint", "<f4", 4),
        ("yaw_rate_setpoint", "<f4"),
        ("attitude", "<f4", 4),
        ("rates", "<f4", 3),
        ("derivative", "<f4", 3),
        ("integral", "<f4", 3),
        ("derivative_gain", "<f4"),
        ("gains", "<f4", len(PARAMETERS)),
    ]
)


def to_array(gains: Gains) -> NDArray[np.float32]:
    """``mimopilot::Gains`` in memory, (len(PARAMETERS),) float32."""
    values = gains.elements()
    return np.array([values[parameter.code] for parameter in PARAMETERS], dtype=np.float32)


def offset(row: Row) -> int:
    """Offset of a row of the parameter table in ``mimopilot::Gains``, bytes."""
    before = ROWS[: ROWS.index(row)]
    return GAINS.base.itemsize * sum(len(one.codes) for one in before)


def gains_array(gains: Gains | NDArray[np.float32]) -> NDArray[np.float32]:
    """Gains in the layout of the controller, (len(PARAMETERS),) float32.

    Raises
    ------
    CodegenError
        If an array has another shape or type.
    """
    array = gains if isinstance(gains, np.ndarray) else to_array(gains)
    if array.shape != GAINS.shape or array.dtype != np.float32:
        raise CodegenError(f"gains: got {array.dtype} {array.shape}, expected float32 {GAINS.shape}")
    return array


def input_rows(inputs: NDArray[Any]) -> NDArray[Any]:
    """Rows of `INPUT`, (N,), contiguous in memory.

    Raises
    ------
    CodegenError
        If the array has another shape or type.
    """
    if inputs.dtype != INPUT or inputs.ndim != 1:
        raise CodegenError(f"inputs: got {inputs.dtype} {inputs.shape}, expected (N,) of codegen.layout.INPUT")
    return np.ascontiguousarray(inputs)
