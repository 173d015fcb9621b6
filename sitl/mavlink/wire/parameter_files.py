"""Parameter files of QGroundControl, MAVProxy and Mission Planner: float32 values read back bit for bit.

The first line, a comment in all three formats, holds the number of parameters and the SHA-256 of the rest. So a
truncated file, with half a gain matrix, is detected. The next one, if any, says what a ground station cannot check.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from pathlib import Path

from mimopilot.common.files import sha256
from mimopilot.sitl.errors import SitlError
from mimopilot.sitl.mavlink.wire.codec import COMPONENT, SYSTEM
from mimopilot.sitl.mavlink.wire.float32 import INT32, REAL32, shortest
from mimopilot.tuning.logs.parameter_file import read_parameter_file


def _qgc(values: Mapping[str, float], system: int, component: int, integers: Collection[str]) -> str:
    lines = [
        f"{system}\t{component}\t{name}\t{shortest(value)}\t{INT32 if name in integers else REAL32}"
        for name, value in values.items()
    ]
    return "\n".join(["# Vehicle-Id\tComponent-Id\tName\tValue\tType", *lines, ""])


def _mavproxy(values: Mapping[str, float], system: int, component: int, integers: Collection[str]) -> str:
    return "".join(f"{name:<16} {shortest(value)}\n" for name, value in values.items())


def _mission_planner(values: Mapping[str, float], system: int, component: int, integers: Collection[str]) -> str:
    return "".join(f"{name},{shortest(value)}\n" for name, value in values.items())


#: Format -> writer: QGroundControl's .params, MAVProxy's .parm, Mission Planner's .param.
FORMATS = {"qgc": _qgc, "mavproxy": _mavproxy, "missionplanner": _mission_planner}


def parameter_text(
    form: str,
    values: Mapping[str, float],
    system: int = SYSTEM,
    component: int = COMPONENT,
    checksum: bool = True,
    integers: Collection[str] = (),
    built_with: Mapping[str, float] | None = None,
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
    integers : collection of str
        Names of INT32 parameters; only QGroundControl's files hold the type.
    built_with : mapping, optional
        Name -> value that the vehicle must hold already, for a comment.
    """
    body = FORMATS[form](values, system, component, integers)
    if built_with:
        held = ", ".join(f"{name} {shortest(value)}" for name, value in built_with.items())
        body = f"# load only into a vehicle that holds {held}\n{body}"
    first = f"# mimopilot: {len(values)} parameters, sha256 {sha256(body.strip())}\n" if checksum else ""
    return first + body


def read_parameters(path: Path) -> dict[str, float]:
    """Read a parameter file of any of the three formats to write it to a vehicle: name -> value in single precision.

    Raises
    ------
    InputFileError, TuningError
        See `tuning.logs.parameter_file.read_parameter_file`.
    SitlError
        When a parameter is neither a float nor an INT32: only these can be written.
    """
    values: dict[str, float] = {}
    for name, found in read_parameter_file(path).items():
        if found.kind not in (None, INT32, REAL32):
            raise SitlError(
                f"{path}, line {found.line}: {name}: param_type {found.kind}, expected {REAL32} "
                f"or {INT32}; delete the line, only floats and INT32 can be written"
            )
        values[name] = found.value
    return values
