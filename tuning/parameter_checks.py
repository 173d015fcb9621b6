"""Whether the numbers of a gains set keep the rules of the parameter table."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import cache

import numpy as np

from mimopilot.tuning.errors import TuningError
from mimopilot.tuning.parameter_row import ANY, AXES, Row, Shape, Valid


def check_values(row: Row, values: Sequence[float], Ts: float) -> None:
    """Check the numbers of a row.

    Parameters
    ----------
    row : Row
    values : sequence of float, in the row's unit
        In the order of `Row.codes`.
    Ts : float, s
        Control period.

    Raises
    ------
    TuningError
        If a number breaks the row's rule; it names the number.
    """
    valid = _valid(row)
    for place, value in enumerate(values):
        if not valid.holds(value):
            raise TuningError(f"{_name(row, place)}: got {value}{_unit(row)}, expected {_expectation(valid)}")
        if _exceeds_period(row, value, Ts):
            raise TuningError(
                f"{_name(row, place)}: got {value}{_unit(row)}, expected at most {row.largest_in_period:g}/Ts, "
                f"{row.largest_in_period / Ts:g}{_unit(row)}"
            )


def _name(row: Row, place: int) -> str:
    """Name of one of a row's numbers in messages."""
    where = f"{row.section}.{row.key}" if row.shape in (Shape.YAW, Shape.AXES) else row.key
    if row.shape is Shape.MATRIX:
        return f"{where}[{place // 2}][{place % 2}]"
    return f"{where} ({AXES[place]})" if row.shape is Shape.AXES and place < len(AXES) else where


@cache
def _valid(row: Row) -> Valid:
    """Valid values of a row's numbers in a gains set."""
    return replace(row.valid, highest=np.inf) if row.shape is Shape.POLE else row.valid  # a cut-off, Hz


def _unit(row: Row) -> str:
    return f" {row.unit}" if row.unit and row.shape in (Shape.SCALAR, Shape.AXES) and row.unit != "norm" else ""


def _exceeds_period(row: Row, value: float, Ts: float) -> bool:
    """Whether the product with the period is too large; in single precision, as the controller checks it."""
    if not math.isfinite(row.largest_in_period):
        return False
    with np.errstate(over="ignore"):
        return bool(np.float32(value) * np.float32(Ts) > np.float32(row.largest_in_period))


def _expectation(valid: Valid) -> str:
    return str(valid) if valid != ANY else f"{valid}; tune again or correct the file"
