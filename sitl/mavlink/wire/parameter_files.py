"""Parameter files of QGroundControl, MAVProxy and Mission Planner: float32 values read back bit for bit.

The first line, a comment in all three formats, holds the number of parameters and the SHA-256 of the rest. So a
truncated file, with half a gain matrix, is detected.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from pathlib import Path

from mimopilot.common.files import read_text, sha256
from mimopilot.common.toml import shown
from mimopilot.sitl.errors import SitlError
from mimopilot.sitl.mavlink.wire.codec import COMPONENT, SYSTEM
from mimopilot.sitl.mavlink.wire.float32 import REAL32, shortest, single

CHECKSUM_LINE = re.compile(r"# mimopilot: (\d+) parameters, sha256 ([0-9a-f]{64})")
NAME = re.compile(r"[A-Z][A-Z0-9_]{0,15}")  # 16 characters: MAVLink's param_id


def _qgc(values: Mapping[str, float], system: int, component: int) -> str:
    lines = [f"{system}\t{component}\t{name}\t{shortest(value)}\t{REAL32}" for name, value in values.items()]
    return "\n".join(["# Vehicle-Id\tComponent-Id\tName\tValue\tType", *lines, ""])


def _mavproxy(values: Mapping[str, float], system: int, component: int) -> str:
    return "".join(f"{name:<16} {shortest(value)}\n" for name, value in values.items())


def _mission_planner(values: Mapping[str, float], system: int, component: int) -> str:
    return "".join(f"{name},{shortest(value)}\n" for name, value in values.items())


#: Format -> writer: QGroundControl's .params, MAVProxy's .parm, Mission Planner's .param.
FORMATS = {"qgc": _qgc, "mavproxy": _mavproxy, "missionplanner": _mission_planner}


def parameter_text(
    form: str, values: Mapping[str, float], system: int = SYSTEM, component: int = COMPONENT, checksum: bool = True
) -> str:
    """Text of a parameter file.

    Parameters
    ----------
    form : str
        A key of `FORMATS`.
    values : mapping
        Name -> value; rounded to single precision.
    system, component : int
        The vehicle's identity; only QGroundControl's files hold it.
    checksum : bool
        Begin with the checksum line; False for a file that is meant to be edited.
    """
    body = FORMATS[form](values, system, component)
    first = f"# mimopilot: {len(values)} parameters, sha256 {sha256(body.strip())}\n" if checksum else ""
    return first + body


def read_parameters(path: Path) -> dict[str, float]:
    """Read a parameter file of any of the three formats: name -> value in single precision.

    Raises
    ------
    InputFileError
        When the file cannot be read.
    SitlError
        With the line, when the format is unknown, a name is invalid or repeated, or a value is not a finite float.
        When the file does not match its checksum line.
    """
    text = read_text(path, "parameter file")
    _verify_checksum(text, path)
    values: dict[str, float] = {}
    for number, line in enumerate(text.splitlines(), 1):
        content = line.split("#")[0].strip()
        if not content:
            continue
        where = f"{path}, line {number}"
        name, value = _parse_line(content, where)
        if name in values:
            raise SitlError(f"{where}: {name} is in the file twice; delete one of the lines")
        values[name] = value
    if not values:
        raise SitlError(f"{path}: holds no parameters; use another file")
    return values


def _verify_checksum(text: str, path: Path) -> None:
    """Refuse a file that does not match its checksum line."""
    expected = CHECKSUM_LINE.match(text)
    if expected is None:
        return
    body = text[expected.end() :].strip()
    count = sum(bool(line) and not line.startswith("#") for line in body.splitlines())
    if count != int(expected[1]):
        raise SitlError(
            f"{path}: incomplete: holds {count} parameters, but its first line says {expected[1]}; use another copy"
        )
    if sha256(body) != expected[2]:
        raise SitlError(
            f"{path}: does not match the checksum in its first line: it was cut short, damaged or edited; use another "
            "copy, or delete the first line to use the values as they are"
        )


def _parse_line(content: str, where: str) -> tuple[str, float]:
    fields = content.split("\t")
    if len(fields) == 5:
        if fields[4] != str(REAL32):
            raise SitlError(
                f"{where}: {fields[2]}: param_type {fields[4]}, expected {REAL32}; "
                "delete the line, only floats can be written"
            )
        fields = fields[2:4]
    else:
        fields = content.split(",") if "," in content else content.split()
    if len(fields) != 2 or not NAME.fullmatch(fields[0].strip()):
        raise SitlError(f"{where}: got {shown(content)}, expected a parameter name (at most 16 capitals) and its value")
    try:
        value = float(fields[1])
    except ValueError:
        value = math.nan
    try:
        return fields[0].strip(), single(value)
    except SitlError as error:
        raise SitlError(f"{where}: {fields[0]}: got {shown(fields[1])}, expected a finite number") from error
