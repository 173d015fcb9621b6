"""Reader of parameter files: QGroundControl's, MAVProxy's, Mission Planner's, and PX4's ``param set`` lines.

The first line may hold the number of parameters and the SHA-256 of the rest, see
`sitl.mavlink.wire.parameter_files`. So a truncated file, with half a gain matrix, is detected.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mimopilot.common.files import read_text, sha256
from mimopilot.common.toml import shown
from mimopilot.tuning.errors import TuningError

CHECKSUM_LINE = re.compile(r"# mimopilot: (\d+) parameters, sha256 ([0-9a-f]{64})")
NAME = re.compile(r"[A-Z][A-Z0-9_]{0,15}")  # 16 characters: MAVLink's param_id
#: Beginning of a line of PX4's start-up files.
COMMAND = re.compile(r"param +set(-default)? +")
#: MAV_PARAM_TYPE of the columns of QGroundControl: 8-bit unsigned to 64-bit float.
KINDS = frozenset(map(str, range(1, 11)))


@dataclass(frozen=True)
class FileParameter:
    """One parameter of a file.

    Attributes
    ----------
    value : float
        In single precision; a whole number of any size.
    kind : int or None
        MAV_PARAM_TYPE; None: the format has none.
    line : int
        Number of its line.
    """

    value: float
    kind: int | None
    line: int


def read_parameter_file(path: Path) -> dict[str, FileParameter]:
    """Read a parameter file of any of these formats, by name.

    Raises
    ------
    InputFileError
        When the file cannot be read.
    TuningError
        With the line, when the format is unknown, a name is invalid or repeated, or a value is not a finite float.
        When the file does not match its checksum line.
    """
    text = read_text(path, "parameter file")
    if path.suffix == ".toml":
        raise TuningError(f"{path}: a TOML file (gains, airframe, specification), expected a parameter file")
    _verify_checksum(text, path)
    found: dict[str, FileParameter] = {}
    for number, line in enumerate(text.splitlines(), 1):
        content = line.split("#")[0].strip()
        if not content:
            continue
        where = f"{path}, line {number}"
        name, value, kind = _parse_line(content, where)
        if name in found:
            raise TuningError(f"{where}: {name} is in the file twice; delete one of the lines")
        found[name] = FileParameter(value, kind, number)
    if not found:
        raise TuningError(f"{path}: holds no parameters; use another file")
    return found


def _verify_checksum(text: str, path: Path) -> None:
    """Refuse a file that does not match its checksum line."""
    expected = CHECKSUM_LINE.match(text)
    if expected is None:
        return
    body = text[expected.end() :].strip()
    count = sum(bool(line) and not line.startswith("#") for line in body.splitlines())
    if count != int(expected[1]):
        raise TuningError(
            f"{path}: incomplete: holds {count} parameters, but its first line says {expected[1]}; use another copy"
        )
    if sha256(body) != expected[2]:
        raise TuningError(
            f"{path}: does not match the checksum in its first line: it was cut short, damaged or edited; use another "
            "copy, or delete the first line to use the values as they are"
        )


def _parse_line(content: str, where: str) -> tuple[str, float, int | None]:
    content = COMMAND.sub("", content, count=1) if content.startswith("param ") else content
    fields, kind = content.split("\t"), None
    if len(fields) == 5 and fields[4] in KINDS:
        fields, kind = fields[2:4], int(fields[4])
    elif len(fields) != 2:
        fields = content.split(",") if "," in content else content.split()
    if len(fields) != 2 or not NAME.fullmatch(fields[0].strip()):
        raise TuningError(
            f"{where}: got {shown(content)}, expected a parameter name (at most 16 capitals) and its value"
        )
    try:
        value = float(fields[1])
    except ValueError:
        value = math.nan
    with np.errstate(over="ignore"):
        single = float(np.float32(value))
    if not math.isfinite(single):
        raise TuningError(f"{where}: {fields[0]}: got {shown(fields[1])}, expected a finite number")
    return fields[0].strip(), single + 0.0, kind
