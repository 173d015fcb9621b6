"""Names, units and signs of the columns of a CSV or MATLAB file. TOML in, validated."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Annotated, Any, Literal

from mimopilot.tuning.errors import TuningError
from pydantic import BaseModel, ConfigDict, Field

from mimopilot.common.toml import checked, read_toml, shown_text

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

Name = Annotated[str, Field(min_length=1)]
Sign = Literal[1, -1]


class _Column(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)

    column: Name | None = None
    index: Annotated[int, Field(ge=1)] | None = None
    sign: Sign = 1

    @property
    def factor(self) -> float:
        """What a value in the file is multiplied by to be in SI units."""
        return self.sign * _FACTORS[getattr(self, "unit", "s")]


class Time(_Column):
    """Time stamps."""

    sign: Literal[1] = 1
    unit: Literal["s", "ms", "us", "ns"] = "s"


class Moment(_Column):
    """A normalised moment: no unit."""


class Rate(_Column):
    """A body rate or its set-point."""

    unit: Literal["rad/s", "deg/s"] = "rad/s"


class Angle(_Column):
    """An angle or its set-point."""

    unit: Literal["rad", "deg"] = "rad"


class Columns(BaseModel):
    """Where the signals of a table are; an entry without `column` has the field's own name.

    An entry's `index` picks a column of a MATLAB matrix; the first is 1, as in MATLAB.

    Attributes
    ----------
    t
        Time.
    u_roll, u_pitch
        Torque set-point after injection, normalised.
    p, q
        Body rates.
    roll, pitch
        Angles.
    roll_sp, pitch_sp, p_sp, q_sp
        Set-points of the angles and rates; may be absent.
    u_bar_roll, u_bar_pitch
        Injected moment; may be absent.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    t: Time = Time()
    u_roll: Moment = Moment()
    u_pitch: Moment = Moment()
    p: Rate = Rate()
    q: Rate = Rate()
    roll: Angle = Angle()
    pitch: Angle = Angle()
    roll_sp: Angle = Angle()
    pitch_sp: Angle = Angle()
    p_sp: Rate = Rate()
    q_sp: Rate = Rate()
    u_bar_roll: Moment = Moment()
    u_bar_pitch: Moment = Moment()

    def name(self, field: str) -> str:
        """Name of a signal's column in the file."""
        return getattr(self, field).column or field

    def line(self, field: str, other: str, what: str) -> str:
        """The line of a column file that gives a field another ``sign`` or ``unit``, or the column of another field."""
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
        When it cannot be read, is not TOML, or holds an unknown signal, unit or sign.
    """
    table = read_toml(path, "column file")
    unknown = [name for name in table if name not in Columns.model_fields]
    if unknown:
        known = ", ".join(Columns.model_fields)
        raise TuningError(f"{path}: {shown_text(unknown[0])}: no signal; known signals: {known}")
    return checked(Columns, table, str(path))
