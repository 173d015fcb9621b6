"""The memory layout of the controller's structures, as NumPy sees them.

They mirror ``core/mimo_pid.hpp``; `codegen.native` checks sizes, offsets and the interface hash when a
library is loaded.
"""

from __future__ import annotations

import numpy as np

from codegen.parameters import PARAMETERS

GAINS = np.dtype(("<f4", (len(PARAMETERS),)))

INPUT = np.dtype(
    [
        ("attitude_setpoint", "<f4", 3),
        ("attitude", "<f4", 3),
        ("rates", "<f4", 3),
        ("excitation", "<f4", 3),
        ("saturation", "<i4", 3),
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

STATE = np.dtype(
    [
        ("gains", "<f4", len(PARAMETERS)),
        ("integral", "<f4", 3),
        ("derivative", "<f4", 3),
        ("setpoint", "<f4", 3),
        ("attitude", "<f4", 3),
        ("rates", "<f4", 3),
        ("age", "<i4", 9),
        ("fault_count", "<u4"),
    ]
)
