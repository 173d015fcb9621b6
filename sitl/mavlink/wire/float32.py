"""Single-precision parameter values: how a vehicle stores them and how text shows them."""

from __future__ import annotations

import struct

import numpy as np
from pymavlink.dialects.v20 import common as mavlink

from mimopilot.sitl.errors import SitlError

#: param_type of a float32.
REAL32: int = mavlink.MAV_PARAM_TYPE_REAL32
INT32: int = mavlink.MAV_PARAM_TYPE_INT32


def single(value: float) -> float:
    """`value` rounded to single precision, as a vehicle stores it; zero has no sign.

    Raises
    ------
    SitlError
        When it is not finite in single precision.
    """
    try:
        rounded: float = struct.unpack("<f", struct.pack("<f", value))[0]
    except OverflowError:
        rounded = float("inf")
    if not abs(rounded) < float("inf"):
        raise SitlError(f"got {value}, expected a number that is finite in single precision")
    return rounded + 0.0


def shortest(value: float) -> str:
    """Shortest decimal that reads back to float32(value).

    Examples
    --------
    >>> shortest(0.1), shortest(-5.0), shortest(1e-7)
    ('0.1', '-5.0', '1e-07')
    """
    return str(np.float32(value))
