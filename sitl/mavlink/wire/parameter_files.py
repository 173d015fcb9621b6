"""Parameter files of the three ground stations: every float32 is written so that it is read back with the same bits.

The first line, a comment to all three, says how many parameters follow and the SHA-256 of the rest: half of a gain
matrix is never taken for the whole.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from pathlib import Path

from mimopilot.sitl.errors import SitlError
from mimopilot.sitl.mavlink.ground_station.events import REAL32, shortest, single

from mimopilot.common.files import read_text, sha256
from mimopilot.common.toml import shown

SEAL = re.compile(r"# mimopilot: (\d+) parameters, sha256 ([0-9a-f]{64})")
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


def parameter_text(
    form: str, values: Mapping[str, float], system: int = 1, component: int = 1, seal: bool = True
) -> str:
    """Text of a parameter file.

    Parameters
    ----------
    form : str
        A key of `FORMATS`.
    values : mapping
        Name -> value; rounded to single precision.
    system, component : int
        The vehicle's, which only QGroundControl's files hold.
    seal : bool
        Begin with the line that vouches for the rest; False for a file that is meant to be edited.
    """
    body = FORMATS[form](values, system, component)
    first = f"# mimopilot: {len(values)} parameters, sha256 {sha256(body.strip())}\n" if seal else ""
    return first + body


def read_parameters(path: Path) -> dict[str, float]:
    """Name -> value in single precision, from a parameter file of any of the three formats.

    Raises
    ------
    TuningError
        When the file cannot be read.
    SitlError
        With the line, when it is none of them, a name is impossible or repeated, or a value is not a finite float. When
        it is not what its first line says was written.
    """
    text = read_text(path, "parameter file")
    _check_seal(text, path)
    values: dict[str, float] = {}
    for number, line in enumerate(text.splitlines(), 1):
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


def _check_seal(text: str, path: Path) -> None:
    """Refuse a file that is not what its first line says was written."""
    seal = SEAL.match(text)
    if seal is None:
        return
    body = text[seal.end() :].strip()
    count = sum(bool(line) and not line.startswith("#") for line in body.splitlines())
    if count != int(seal[1]):
        raise SitlError(
            f"{path}: holds {count} parameters, but its first line says {seal[1]}: it is not whole; use another copy"
        )
    if sha256(body) != seal[2]:
        raise SitlError(
            f"{path}: is not what its first line vouches for: it was cut short, damaged or edited; use another copy, "
            "or delete the first line to take the values as they are"
        )


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
