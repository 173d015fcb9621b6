"""Parameter files of the three ground stations: every float32 is written so that it is read back with the same bits."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from pathlib import Path

from sitl.errors import SitlError
from sitl.mavlink.words import REAL32, shortest, single
from tuning.files import read_text
from tuning.toml import shown

NAME = re.compile(r"[A-Z][A-Z0-9_]{0,15}")


def _qgc(values: Mapping[str, float], system: int, component: int) -> str:
    lines = [f"{system}\t{component}\t{name}\t{shortest(value)}\t{REAL32}" for name, value in values.items()]
    return "\n".join(["# Vehicle-Id\tComponent-Id\tName\tValue\tType", *lines, ""])


def _mavproxy(values: Mapping[str, float], system: int, component: int) -> str:
    return "".join(f"{name:<16} {shortest(value)}\n" for name, value in values.items())


def _mission_planner(values: Mapping[str, float], system: int, component: int) -> str:
    return "".join(f"{name},{shortest(value)}\n" for name, value in values.items())


#: Format -> its writer: QGroundControl's .params, MAVProxy's .parm, Mission Planner's .param.
FORMATS = {"qgc": _qgc, "mavproxy": _mavproxy, "missionplanner": _mission_planner}


def parameter_text(form: str, values: Mapping[str, float], system: int = 1, component: int = 1) -> str:
    """Text of a parameter file.

    Parameters
    ----------
    form : str
        A key of `FORMATS`.
    values : mapping
        Name -> value; rounded to single precision.
    system, component : int
        The vehicle's, which only QGroundControl's files hold.
    """
    return FORMATS[form](values, system, component)


def read_parameters(path: Path) -> dict[str, float]:
    """Name -> value in single precision, from a parameter file of any of the three formats.

    Raises
    ------
    TuningError
        When the file cannot be read.
    SitlError
        With the line, when it is none of them, a name is impossible or repeated, or a value is not a finite float.
    """
    values: dict[str, float] = {}
    for number, line in enumerate(read_text(path, "parameter file").splitlines(), 1):
        content = line.split("#")[0].strip()
        if not content:
            continue
        where = f"{path}, line {number}"
        name, value = _entry(content, where)
        if name in values:
            raise SitlError(f"{where}: {name} stands in the file twice")
        values[name] = value
    if not values:
        raise SitlError(f"{path}: holds no parameters")
    return values


def _entry(content: str, where: str) -> tuple[str, float]:
    fields = content.split("\t")
    if len(fields) == 5:
        if fields[4] != str(REAL32):
            raise SitlError(f"{where}: {fields[2]}: param_type {fields[4]}, expected {REAL32}: only floats are written")
        fields = fields[2:4]
    else:
        fields = content.split(",") if "," in content else content.split()
    if len(fields) != 2 or not NAME.fullmatch(fields[0].strip()):
        raise SitlError(
            f"{where}: got {shown(content)}, expected a parameter's name (16 capitals at most) and its value"
        )
    try:
        value = float(fields[1])
    except ValueError:
        value = math.nan
    try:
        return fields[0].strip(), single(value)
    except SitlError as error:
        raise SitlError(f"{where}: {fields[0]}: got {shown(fields[1])}, expected a finite number") from error
