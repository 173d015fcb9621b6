"""The column file: names, units and signs of the columns of a CSV or MATLAB file (TOML)."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field

from mimopilot.common.toml import checked, read_toml, shown_text
from mimopilot.tuning.errors import TuningError

TIME_UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
_FACTORS = TIME_UNITS | {"rad": 1.0, "deg": math.pi / 180, "rad/s": 1.0, "deg/s": math.pi / 180}

#: Signal -> the two columns that hold it, by their names in `Columns`.
SIGNALS = {
    "u": ("u_roll", "u_pitch"),
    "y_i": ("p", "q"),
    "y_o": ("roll", "pitch"),
    "r_o": ("roll_sp", "pitch_sp"),
    "r_i": ("p_sp", "q_sp"),
    "u_bar": ("u_bar_roll", "u_bar_pitch"),
}
#: The same of yaw, all optional.
YAW_SIGNALS = {"u": "u_yaw", "y_i": "r", "y_o": "yaw", "r_o": "yaw_sp", "r_i": "r_sp", "u_bar": "u_bar_yaw"}

Name = Annotated[str, Field(min_length=1)]
Sign = Literal[1, -1]


class _Column(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)

    column: Name | None = None
    index: Annotated[int, Field(ge=1)] | None = None
    sign: Sign = 1

    @property
    def factor(self) -> float:
        """Factor from a value in the file to SI units."""
        return self.sign * _FACTORS[getattr(self, "unit", "s")]


class TimeColumn(_Column):
    """Time stamps."""

    sign: Literal[1] = 1
    unit: Literal["s", "ms", "us", "ns"] = "s"


class TorqueColumn(_Column):
    """A torque, normalised: no unit."""


class RateColumn(_Column):
    """A body rate or its setpoint."""

    unit: Literal["rad/s", "deg/s"] = "rad/s"


class AngleColumn(_Column):
    """An angle or its setpoint."""

    unit: Literal["rad", "deg"] = "rad"


class Columns(BaseModel):
    """The column of each signal in a table. An entry without `column` has the field's own name.

    `index` picks a column of a MATLAB matrix; the first is 1, as in MATLAB.

    Attributes
    ----------
    t
        Time.
    u_roll, u_pitch
        Torque setpoint after injection, normalised.
    p, q
        Body rates.
    roll, pitch
        Angles.
    roll_sp, pitch_sp, p_sp, q_sp
        Setpoints of the angles and rates; may be absent.
    u_bar_roll, u_bar_pitch
        Injected torque, normalised; may be absent.
    u_yaw, r, yaw, yaw_sp, r_sp, u_bar_yaw
        The same of yaw; may be absent. Without torque, rate and heading yaw is left out.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    t: TimeColumn = TimeColumn()
    u_roll: TorqueColumn = TorqueColumn()
    u_pitch: TorqueColumn = TorqueColumn()
    p: RateColumn = RateColumn()
    q: RateColumn = RateColumn()
    roll: AngleColumn = AngleColumn()
    pitch: AngleColumn = AngleColumn()
    roll_sp: AngleColumn = AngleColumn()
    pitch_sp: AngleColumn = AngleColumn()
    p_sp: RateColumn = RateColumn()
    q_sp: RateColumn = RateColumn()
    u_bar_roll: TorqueColumn = TorqueColumn()
    u_bar_pitch: TorqueColumn = TorqueColumn()
    u_yaw: TorqueColumn = TorqueColumn()
    r: RateColumn = RateColumn()
    yaw: AngleColumn = AngleColumn()
    yaw_sp: AngleColumn = AngleColumn()
    r_sp: RateColumn = RateColumn()
    u_bar_yaw: TorqueColumn = TorqueColumn()

    def name(self, field: str) -> str:
        """Name of a field's column in the file."""
        return getattr(self, field).column or field

    def line(self, field: str, other: str, what: str) -> str:
        """The column-file line that corrects a field: `what` is ``sign``, ``unit`` or ``other`` (column of `other`)."""
        entry = getattr(self, other)
        values: dict[str, Any] = {"column": self.name(other)}
        values |= {key: value for key, value in entry.model_dump(exclude_defaults=True).items() if key != "column"}
        if what == "sign":
            values["sign"] = -entry.sign
        if what == "unit":
            values["unit"] = {"rad": "deg", "deg": "rad", "rad/s": "deg/s", "deg/s": "rad/s"}[entry.unit]
        return f"{field} = {{ {', '.join(f'{key} = {json.dumps(value)}' for key, value in values.items())} }}"


def load_columns(path: Path) -> Columns:
    """Read a column file.

    Raises
    ------
    TuningError
        When it holds an unknown signal.
    InputFileError
        When it cannot be read, is not TOML, or an entry is unknown or impossible.
    """
    table = read_toml(path, "column file", "leave out --columns, or give the columns' names")
    unknown = [name for name in table if name not in Columns.model_fields]
    if unknown:
        known = ", ".join(Columns.model_fields)
        raise TuningError(f"{path}: {shown_text(unknown[0])}: not a signal; known signals: {known}")
    return checked(Columns, table, str(path))
