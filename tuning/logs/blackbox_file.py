"""Files of a blackbox log as CSV: the header line, the settings above it or beside it, and the numbers below it.

Written by blackbox_decode of blackbox-tools (names and units as ``gyroADC[0] (deg/s)``, settings in a second file
NAME.headers.csv with --save-headers), by Blackbox Explorer (settings first, one a line, names in quotes), and by
INDIflight's bfl2csv.py.
"""

from __future__ import annotations

import csv
import itertools
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mimopilot.tuning.errors import TuningError

#: The first column of every tool.
FIRST = "loopIteration"
#: End of the name of the file with the settings that blackbox_decode --save-headers writes beside the table.
BESIDE = ".headers.csv"
#: Lines of settings that Blackbox Explorer writes above the table: about 200 with Betaflight 2025.12.
MAX_SETTINGS = 2000
ONE_LOG = "give each log in a file of its own, as blackbox_decode writes it (NAME.01.csv, NAME.02.csv)"
#: Name and unit in a cell of the header line.
_NAME = re.compile(r"\s*(?P<name>[^()]*?)\s*(?:\((?P<unit>[^()]*)\))?\s*$")


@dataclass(frozen=True, eq=False)
class BlackboxTable:
    """A blackbox log as a table.

    Attributes
    ----------
    path : Path
    settings : mapping
        Setting of the log's header -> its text; empty when they are neither in the file nor beside it.
    units : mapping
        Name of each column -> unit in its head; empty: none.
    columns : mapping
        Name -> values (N,) of the columns that were asked for and are there.
    warnings : tuple of str
    """

    path: Path
    settings: Mapping[str, str]
    units: Mapping[str, str]
    columns: Mapping[str, NDArray[np.float64]]
    warnings: tuple[str, ...] = ()

    def vector(self, name: str, count: int = 3) -> NDArray[np.float64] | None:
        """The columns ``name[0]`` ... as an array (N, count); None when one is missing."""
        found = [self.columns.get(f"{name}[{i}]") for i in range(count)]
        values = [column for column in found if column is not None]
        return np.column_stack(values) if len(values) == count else None

    def numbers(self, name: str) -> tuple[float, ...]:
        """Numbers of a setting, such as ``45,80,30``; empty when there is none or it is no number."""
        try:
            return tuple(float(part) for part in re.split(r"[,\s]+", self.settings[name].strip("[] ")))
        except (KeyError, ValueError):
            return ()

    def number(self, name: str) -> float | None:
        """The first number of a setting."""
        return next(iter(self.numbers(name)), None)


def read_blackbox(path: Path, wanted: re.Pattern[str]) -> BlackboxTable:
    """Read a blackbox log as CSV.

    Parameters
    ----------
    path : Path
    wanted : pattern
        Of the names of the columns to read, without unit.

    Raises
    ------
    TuningError
        When it has no table, or no samples.
    """
    text = path.read_text("utf-8-sig", "replace")
    lines = text.splitlines()
    start = next((i for i, line in enumerate(lines[:MAX_SETTINGS]) if FIRST in line), None)
    if start is None:
        beside = f"it holds the settings of {path.name.removesuffix(BESIDE)}.csv; give that file"
        cause = beside if path.name.endswith(BESIDE) else "decode the log again"
        raise TuningError(f"{path}: no line with the column names ({FIRST}, ...); {cause}")
    _check_separator(path, lines[start])
    names, units = _header(lines[start])
    settings = _settings(lines[:start]) or _settings_beside(path)
    rows = [line for line in lines[start + 1 :] if line.strip()]
    again = next((i for i, line in enumerate(lines[start + 1 :], start + 2) if FIRST in line), None)
    if again is not None:
        raise TuningError(f"{path}: another log begins at line {again}; {ONE_LOG}")
    warnings = []
    if rows and rows[-1].count(",") < len(names) - 1:
        rows.pop()
        warnings.append("the last line is incomplete and ignored")
    if not rows:
        raise TuningError(f"{path}: no samples below the column names; decode the log again")
    places = [i for i, name in enumerate(names) if wanted.fullmatch(name) and name not in names[:i]]
    values = _numbers(path, rows, places)
    columns = {names[place]: values[:, i] for i, place in enumerate(places)}
    return BlackboxTable(path, settings, dict(zip(names, units, strict=True)), columns, tuple(warnings))


def _check_separator(path: Path, line: str) -> None:
    """Refuse a table that a spreadsheet has written with other marks between its cells."""
    mark = max(",;\t", key=line.count)
    if mark != ",":
        name = "tabs" if mark == "\t" else "semicolons"
        raise TuningError(
            f"{path}: its cells are separated by {name}, so a spreadsheet has written it; give the file that "
            "blackbox_decode or Blackbox Explorer wrote"
        )


def _header(line: str) -> tuple[list[str], list[str]]:
    """Names and units of the columns."""
    found = [_NAME.match(cell) for cell in next(csv.reader([line], skipinitialspace=True))]
    return [m["name"] if m else "" for m in found], [(m["unit"] or "") if m else "" for m in found]


def _settings(lines: Sequence[str]) -> dict[str, str]:
    """Name -> text of the settings in lines of two cells."""
    rows = (row for row in csv.reader(lines, skipinitialspace=True) if len(row) >= 2)
    return {row[0].strip(): ",".join(row[1:]).strip() for row in rows}


def _settings_beside(path: Path) -> dict[str, str]:
    """Settings that blackbox_decode --save-headers wrote beside the table; empty when it did not."""
    beside = path.with_name(f"{path.name.removesuffix('.csv')}{BESIDE}")
    return _settings(beside.read_text("utf-8", "replace").splitlines()) if beside.is_file() else {}


def _numbers(path: Path, rows: Sequence[str], places: Sequence[int]) -> NDArray[np.float64]:
    """The cells of some columns, (N, n); NaN where a cell is no number."""
    try:
        return np.loadtxt(rows, delimiter=",", usecols=places, ndmin=2, quotechar='"')
    except ValueError:
        pass  # a cell without a number: slower
    try:
        cells = [row.split(",") for row in rows]
        return np.array([[_number(row[place]) for place in places] for row in cells])
    except IndexError as error:
        short = next(itertools.compress(itertools.count(1), (len(row) <= max(places) for row in cells)))
        raise TuningError(f"{path}: too few cells in row {short} below the column names; decode it again") from error


def _number(cell: str) -> float:
    try:
        return float(cell.strip(' "'))
    except ValueError:
        return float("nan")
