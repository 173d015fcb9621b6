"""The gains that flew, from the vehicle's parameters.

This controller's (``MIMO_``), else those of PX4 (``MC_``) or ArduPilot (``ATC_``). With ``MIMO_EN`` 0 in the log, the
latter flew.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from mimopilot.tuning.control_laws import LAWS
from mimopilot.tuning.errors import TuningError
from mimopilot.tuning.gains import Gains
from mimopilot.tuning.logs.stock_controllers import stock_of
from mimopilot.tuning.parameter_row import AXIS_LETTERS, PREFIX, Row, Shape
from mimopilot.tuning.parameters import ENABLE, ROWS, SCALE, rows
from mimopilot.tuning.provenance import Provenance

#: Details of a flown stock set: filters whose parameters are not logged, and the control rate in the parameters, Hz.
LACKING, LOOP_RATE = "lacking_parameters", "loop_rate_hz"
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
        Elements without a ``MIMO_`` parameter in the log (yaw, limits) are the autopilot's own. Without any, the set is
        that of the stock law, with its filters; where a parameter of these is not logged the set is in our law, and
        `LACKING` of its details names what is missing.
    """
    # Vehicles store float32: use the shortest decimal that rounds to the same float32.
    values = {name: float(str(np.float32(value))) for name, value in parameters.items()}
    if values.get(ENABLE.name, 1.0) == 0.0:  # our module waits while the autopilot's own controllers fly
        values = {name: value for name, value in values.items() if not name.startswith(PREFIX)}
    stock = stock_of(values)
    found: dict[Row, Any] = {_PERIOD: Ts}
    details: dict[str, Any] = {}
    filters = None
    if not any(PREFIX + code in values for row in rows(Shape.MATRIX) for code in row.codes):
        lacking = [name for name in stock.filter_names if name not in values]
        details = {LACKING: lacking} if lacking else {LOOP_RATE: values[stock.rate]} if stock.rate in values else {}
        filters = None if lacking else stock.stock_filters(values)
    lacks = () if filters is None else LAWS[stock.profile].lacks
    for row in ROWS:
        if row.key in lacks:
            found |= {row: 0.0} if row.shape is Shape.POLE else {}
            continue
        ours = any(PREFIX + code in values for code in row.codes)
        if row is _PERIOD or (row.default is not None and not ours and not stock.maps(row)):
            continue
        numbers = []
        for code in row.codes:
            own = values.get(PREFIX + code)
            numbers.append(stock.value(row, code, values) if own is None else _of_the_file(row, own, Ts))
        if not all(row.shape is Shape.POLE or row.valid.holds(number) for number in numbers):
            return None
        found[row] = numbers[0] if len(numbers) == 1 else numbers
    scale: Any = tuple(values.get(f"{PREFIX}{SCALE}_{letter}") for letter in AXIS_LETTERS)
    try:
        shaping = stock.shaping(values) if filters is None else 0.0
        gains = Gains.from_rows(found, filters, shaping, provenance=Provenance("flown", details=details))
    except TuningError:  # such as an attitude model that is too fast for the period of the log
        return None
    return replace(gains, moment_scale=None if None in scale else scale)


def _of_the_file(row: Row, element: float, Ts: float) -> float:
    """What a gains file has for an element of the controller; a cut-off to 6 digits, as precise as its pole."""
    return float(f"{row.value(element, Ts):.6g}") if row.shape is Shape.POLE else element
