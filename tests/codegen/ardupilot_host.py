"""ArduPilot's custom controller, added by its script to stand-ins of ArduPilot's source and driven by text commands.

The stand-ins have the names and types that the controller and the script use. They are not ArduPilot.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

from mimopilot.codegen.render import render, write_tree
from mimopilot.codegen.toolchain import find_compiler
from mimopilot.tuning.gains import Gains

STUBS = Path(__file__).parent / "ardupilot_stubs"
#: Version of ArduPilot -> what its stand-in differs in, for the host program.
VERSIONS = {
    "4.5": ["-DATTITUDE_CONTROL=AC_AttitudeControl_Multi", "-DWITH_PERIOD"],
    "4.6": ["-DATTITUDE_CONTROL=AC_AttitudeControl", "-DWITH_PERIOD"],
    "master": ["-DATTITUDE_CONTROL=AC_AttitudeControl"],
}
#: ArduPilot's compiler flags for SITL (Tools/ardupilotwaf/boards.py, 4.8-dev), where they could matter here. Those of
#: warnings without -Werror there are errors here.
FLAGS = (
    "-std=gnu++11",
    "-O1",
    "-fno-exceptions",
    "-fsingle-precision-constant",
    "-Wall",
    "-Wextra",
    "-Wno-unused-parameter",
    "-Wno-invalid-offsetof",
    *(f"-Werror={name}" for name in ("shadow", "float-equal", "missing-declarations", "undef", "narrowing", "switch")),
    *(f"-Werror={name}" for name in ("reorder", "cast-align", "sign-compare", "type-limits", "suggest-override")),
    *(f"-Werror={name}" for name in ("maybe-uninitialized", "unused-variable", "format", "duplicated-cond")),
    "-Werror",
)
#: Columns of a row that the host program prints.
TORQUE, LOGGED, PHASE = slice(0, 3), 3, 4
LOG_RATE, LOG_TORQUE, LOG_EXCITATION, LOG_FAULTS = slice(5, 8), slice(8, 11), slice(11, 14), 14


def at_400_hz(gains: Gains) -> Gains:
    """The gains for ArduPilot's loop rate."""
    return replace(gains, filters=replace(gains.filters, Ts=0.0025))


def emit(gains: Gains, folder: Path) -> Path:
    """Emit the target; returns its root."""
    write_tree(render(gains, "ardupilot"), folder / "tree")
    return folder / "tree"


def stand_in(version: str, folder: Path) -> Path:
    """A stand-in of ArduPilot's source that may be changed."""
    shutil.copytree(STUBS / version, folder / version)
    return folder / version


def install(tree: Path, ardupilot: Path, *options: str) -> subprocess.CompletedProcess[str]:
    """Run the emitted script."""
    command = [sys.executable, "-I", str(tree / "ardupilot" / "install.py"), str(ardupilot), *options]
    return subprocess.run(command, capture_output=True, text=True, check=False)


def build(version: str, tree: Path, folder: Path) -> Path:
    """Add the controller to a stand-in and compile it."""
    ardupilot = stand_in(version, folder)
    done = install(tree, ardupilot)
    assert done.returncode == 0, done.stderr
    library = ardupilot / "libraries" / "AC_CustomControl"
    sources = [STUBS / "host.cpp", *sorted(library.glob("*.cpp")), *sorted((library / "utility").glob("*.cpp"))]
    program = folder / f"host-{version}"
    includes = [f"-I{STUBS / 'common'}", f"-I{library}"]
    command = [find_compiler(), *FLAGS, "-DAP_CUSTOMCONTROL_ENABLED=1", *VERSIONS[version], *includes, "-o", program]
    done = subprocess.run([*map(str, command), *map(str, sources)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return program


def fly(program: Path, *lines: str) -> tuple[np.ndarray, list[str]]:
    """Rows and texts of a run; commands of ``ardupilot_stubs/host.cpp``."""
    done = subprocess.run([str(program)], input="\n".join(lines), capture_output=True, text=True, check=True)
    printed = done.stdout.splitlines()
    rows = [line.split()[1:] for line in printed if line.startswith("row ")]
    return np.array(rows, dtype=float), [line.removeprefix("text ") for line in printed if line.startswith("text ")]
