#!/usr/bin/env python3
"""Add the controller in this folder to ArduPilot's source, or remove it.

    python3 install.py ARDUPILOT [--remove]

ARDUPILOT is the folder of ArduPilot's source. The files of this tree are copied to libraries/AC_CustomControl, and a
few lines are added to three files there, each marked at its end. Nothing is changed unless every place for them is
found; a second run changes nothing. Needs Python 3 only.
"""

from __future__ import annotations

import argparse
import re
import sys
from pathlib import Path

MARK = "  // mimopilot"
LIBRARY = Path("libraries", "AC_CustomControl")
HEADER, SOURCE, CONFIG = "AC_CustomControl.h", "AC_CustomControl.cpp", "AC_CustomControl_config.h"
CREATE = r"_backend = (.+) AC_CustomControl_PID\(\*this, _ahrs, _att_control, _motors, _dt\);"


class RefusedError(Exception):
    """ArduPilot's source is not as expected; nothing has been changed."""


class Text:
    """Lines of a file of ArduPilot, without ours."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.before = path.read_bytes().decode("utf-8", "surrogateescape")
        self.end = "\r\n" if "\r\n" in self.before else "\n"
        self.lines = [line for line in self.before.split(self.end) if not line.endswith(MARK)]

    def find(self, anchor: str, start: int = 0) -> int:
        """Index of the first line from `start` on that matches; whitespace does not count."""
        for index in range(start, len(self.lines)):
            if re.fullmatch(anchor, " ".join(self.lines[index].split())):
                return index
        raise RefusedError(f"{self.path}: found no line like {anchor!r}")

    def insert(self, index: int, *lines: str) -> None:
        """Insert our lines before a line."""
        self.lines[index:index] = [line + MARK for line in lines]

    def after(self) -> str:
        """The new content."""
        return self.end.join(self.lines)


def edit_header(text: Text) -> None:
    """Our number among the controllers."""
    if any("= 3," in line for line in text.lines):
        raise RefusedError(f"{text.path}: another custom controller has number 3")
    text.find(r"#define CUSTOMCONTROL_MAX_TYPES 2")
    text.insert(text.find(r"#ifndef CUSTOMCONTROL_MAX_TYPES"), "#define CUSTOMCONTROL_MAX_TYPES 3")
    text.insert(text.find(r"CONT_PID = 2,") + 1, "        CONT_MIMO            = 3,")


def edit_source(text: Text) -> None:
    """Its parameters, and its construction."""
    include = text.find(r'#include "AC_CustomControl_PID\.h"')
    text.insert(include + 1, '#include "AC_CustomControl_MIMO.h"')
    group = text.find(r'AP_SUBGROUPVARPTR\(_backend, "2_", 7, AC_CustomControl, _backend_var_info\[1\]\),')
    text.insert(
        group + 1,
        "#if AP_CUSTOMCONTROL_MIMO_ENABLED",
        '    AP_SUBGROUPVARPTR(_backend, "3_", 8, AC_CustomControl, _backend_var_info[2]),',
        "#endif",
    )
    created = text.find(CREATE)
    new = text.lines[created].split("=")[1].split(" AC_")[0].strip()  # differs between versions
    text.insert(
        text.find(r"break;", created) + 1,
        "#if AP_CUSTOMCONTROL_MIMO_ENABLED",
        "        case CustomControlType::CONT_MIMO:",
        f"            _backend = {new} AC_CustomControl_MIMO(*this, _ahrs, _att_control, _motors, _dt);",
        "            _backend_var_info[get_type()] = AC_CustomControl_MIMO::var_info;",
        "            break;",
        "#endif",
    )


def edit_config(text: Text) -> None:
    """The switch that leaves it out of a build."""
    start = text.find(r"#ifndef AP_CUSTOMCONTROL_PID_ENABLED")
    text.insert(
        text.find(r"#endif", start) + 1,
        "#ifndef AP_CUSTOMCONTROL_MIMO_ENABLED",
        "#define AP_CUSTOMCONTROL_MIMO_ENABLED AP_CUSTOMCONTROL_BACKEND_DEFAULT_ENABLED",
        "#endif",
    )


EDITS = {HEADER: edit_header, SOURCE: edit_source, CONFIG: edit_config}


def our_files(tree: Path) -> dict[Path, bytes]:
    """Path in the library -> content, of every file of ours."""
    own = tree / "ardupilot" / "AC_CustomControl"
    files = {path.relative_to(own): path for path in own.rglob("*") if path.is_file()}
    for folder in ("core", "vehicle"):
        files.update({Path("utility", path.name): path for path in (tree / folder).glob("*.[ch]pp")})
    return {name: path.read_bytes() for name, path in sorted(files.items())}


def plan(library: Path, tree: Path, remove: bool) -> dict[Path, bytes | None]:
    """Path -> new content, None to delete it, of all that must change."""
    wanted: dict[Path, bytes | None] = {}
    for name, edit in EDITS.items():
        if name == CONFIG and not (library / name).exists():
            continue  # ArduPilot before 4.6
        if not (library / name).is_file():
            raise RefusedError(f"{library / name}: no such file; give the folder of ArduPilot's source")
        text = Text(library / name)
        if not remove:
            edit(text)
        wanted[library / name] = text.after().encode("utf-8", "surrogateescape")
    for name, content in our_files(tree).items():
        wanted[library / name] = None if remove else content
    return {
        path: content for path, content in wanted.items() if (path.read_bytes() if path.exists() else None) != content
    }


def main() -> None:
    """Read the arguments and change the source."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("ardupilot", type=Path, help="folder of ArduPilot's source")
    parser.add_argument("--remove", action="store_true", help="remove the controller again")
    arguments = parser.parse_args()
    library = arguments.ardupilot / LIBRARY
    try:
        changes = plan(library, Path(__file__).resolve().parent.parent, arguments.remove)
    except RefusedError as reason:
        sys.exit(f"{reason}; nothing was changed")
    for path, content in changes.items():
        if content is None:
            path.unlink()
            if not any(path.parent.iterdir()):
                path.parent.rmdir()
            continue
        path.parent.mkdir(exist_ok=True)
        draft = path.with_name(path.name + ".mimopilot")
        draft.write_bytes(content)
        draft.replace(path)
    print(f"{library}: {len(changes)} files changed" if changes else f"{library}: nothing to change")


if __name__ == "__main__":
    main()
