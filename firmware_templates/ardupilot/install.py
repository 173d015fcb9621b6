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
NOTE = Path("utility", "mimopilot.txt")  # lists the files that were copied
LIBRARY = Path("libraries", "AC_CustomControl")
HEADER, SOURCE, CONFIG = "AC_CustomControl.h", "AC_CustomControl.cpp", "AC_CustomControl_config.h"
CREATE = r"_backend = (.+) AC_CustomControl_PID\(\*this, _ahrs, _att_control, _motors, _dt\);"


class RefusedError(Exception):
    """ArduPilot's source is not as expected; nothing has been changed."""


class Text:
    """Lines of a file of ArduPilot, without ours; each keeps its own end, LF or CRLF."""

    def __init__(self, path: Path) -> None:
        self.path = path
        lines = path.read_bytes().decode("utf-8", "surrogateescape").split("\n")
        self.lines = [line for line in lines if not line.rstrip("\r").endswith(MARK)]

    def places(self, anchor: str, start: int = 0) -> list[int]:
        """Indices of the lines from `start` on that match; whitespace does not count."""
        lines = enumerate(self.lines)
        return [index for index, line in lines if index >= start and re.fullmatch(anchor, " ".join(line.split()))]

    def find(self, anchor: str) -> int:
        """Index of the one line that matches."""
        found = self.places(anchor)
        if len(found) != 1:
            raise RefusedError(f"{self.path}: found {len(found) or 'no'} lines like {anchor!r}, expected one")
        return found[0]

    def following(self, anchor: str, start: int) -> int:
        """Index of the first line from `start` on that matches."""
        found = self.places(anchor, start)
        if not found:
            raise RefusedError(f"{self.path}: found no line like {anchor!r} after line {start + 1}")
        return found[0]

    def insert(self, index: int, *lines: str) -> None:
        """Insert our lines before a line, with the end of the line before."""
        end = "\r" if self.lines[index - 1].endswith("\r") else ""
        self.lines[index:index] = [line + MARK + end for line in lines]

    def after(self) -> str:
        """The new content."""
        return "\n".join(self.lines)


def edit_header(text: Text) -> None:
    """Our number among the controllers."""
    if any(re.match(r"\s*\w+\s*=\s*3\b", line) for line in text.lines):
        raise RefusedError(f"{text.path}: another custom controller has number 3, which is ours; remove that one first")
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
        text.following(r"break;", created) + 1,
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
        text.following(r"#endif", start) + 1,
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
        if not (tree / folder).is_dir():
            raise RefusedError(f"{tree / folder}: no such folder; run the script where `mimopilot generate` wrote it")
        files.update({Path("utility", path.name): path for path in (tree / folder).glob("*.[ch]pp")})
    return {name: path.read_bytes() for name, path in sorted(files.items())}


def earlier_files(library: Path) -> list[Path]:
    """Files that an earlier run copied."""
    note = library / NOTE
    names = [Path(line) for line in note.read_text().splitlines()] if note.is_file() else []
    return [name for name in names if (library / name).is_file() and name.parent in (Path(), NOTE.parent)]


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
    ours = our_files(tree)
    ours[NOTE] = "".join(f"{name.as_posix()}\n" for name in ours).encode()
    wanted |= dict.fromkeys(library / name for name in earlier_files(library))
    wanted |= {library / name: None if remove else content for name, content in ours.items()}
    return {
        path: content for path, content in wanted.items() if (path.read_bytes() if path.exists() else None) != content
    }


def change(path: Path, content: bytes | None) -> None:
    """Write a file as a whole, or delete it."""
    if content is None:
        path.unlink()
        if not any(path.parent.iterdir()):
            path.parent.rmdir()
        return
    path.parent.mkdir(exist_ok=True)
    draft = path.with_name(path.name + ".mimopilot")
    draft.write_bytes(content)
    draft.replace(path)


def main() -> None:
    """Read the arguments and change the source."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("ardupilot", type=Path, help="folder of ArduPilot's source")
    parser.add_argument("--remove", action="store_true", help="remove the controller again")
    arguments = parser.parse_args()
    library = arguments.ardupilot / LIBRARY
    try:
        changes = plan(library, Path(__file__).resolve().parent.parent, arguments.remove)
    except (RefusedError, OSError) as reason:
        sys.exit(f"{reason}; nothing was changed")
    try:
        for path, content in changes.items():
            change(path, content)
    except OSError as reason:
        sys.exit(f"{reason}; not all files were changed: run it again, or with --remove")
    print(f"{library}: {len(changes)} files changed" if changes else f"{library}: nothing to change")


if __name__ == "__main__":
    main()
