"""Tables: CSV files with a header line, and MATLAB files with one vector a signal."""

from __future__ import annotations

import csv
import itertools
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tuning.errors import TuningError
from tuning.logs.columns import Columns
from tuning.logs.recording import Recording
from tuning.logs.resample import Series

#: Signal -> the two columns that hold it, by their names in `Columns`.
SIGNALS = {
    "u": ("u_roll", "u_pitch"),
    "y_i": ("p", "q"),
    "y_o": ("roll", "pitch"),
    "r_o": ("roll_sp", "pitch_sp"),
    "r_i": ("p_sp", "q_sp"),
    "u_bar": ("u_bar_roll", "u_bar_pitch"),
}
ADVICE = (
    "log it at 100 Hz or more on the vehicle (PX4: SDLOG_PROFILE 49, ArduPilot: LOG_BITMASK bit 0) and export every "
    "sample; other names of columns are told with --columns"
)


def record_csv(path: Path, columns: Columns) -> Recording:
    """Read a CSV file: a header line, then one sample a line; an empty cell or NaN is not logged.

    Parameters
    ----------
    path : Path
        The file; fields are separated by commas, semicolons or tabs.
    columns : Columns
        Names, units and signs.

    Returns
    -------
    Recording

    Raises
    ------
    TuningError
        When it is not such a file, or a cell is not a number.
    """
    try:
        with path.open(encoding="utf-8-sig", newline="") as stream:
            first = stream.readline()
            delimiter = max(",;\t", key=first.count)
            header = [name.strip().lstrip("#").strip() for name in next(csv.reader([first], delimiter=delimiter))]
            twice = sorted({name for name in header if header.count(name) > 1})
            used = [columns.name(field) for field in Columns.model_fields]
            if set(twice) & set(used):
                raise TuningError(f"{path}: column {', '.join(twice)} appears twice; rename one")
            places = [i for i, name in enumerate(header) if name in used]
            filled = (line for line in stream if line.strip())
            if (row := next(filled, None)) is None:
                raise TuningError(f"{path}: no samples below the header line; export the log again")
            rows = np.empty((0, 0))
            if places:
                lines = itertools.chain([row], filled)
                rows = np.loadtxt(lines, delimiter=delimiter, usecols=places, ndmin=2, converters=_cell, quotechar='"')
    except TuningError:
        raise
    except (ValueError, UnicodeDecodeError, csv.Error, OverflowError, IndexError) as error:
        raise TuningError(f"{path}: not a table of numbers below one header line: {error}") from error
    names = [header[i] for i in places]
    table = dict(zip(names, rows.T, strict=False)) if rows.size else {}
    return _record(path, "CSV", table, header, columns)


def record_matlab(path: Path, columns: Columns) -> Recording:
    """Read a MATLAB file (version 5 to 7): one vector a signal, by variable or ``structure.field``.

    Parameters
    ----------
    path : Path
        The file.
    columns : Columns
        Names, units and signs.

    Returns
    -------
    Recording

    Raises
    ------
    TuningError
        When the file is damaged, or a signal is not a vector of real numbers as long as the time.
    """
    from scipy.io import loadmat

    try:
        variables = loadmat(path, simplify_cells=True)
    except Exception as error:  # scipy raises whatever a damaged file makes of its parser
        raise TuningError(f"{path}: damaged MATLAB file: {error or type(error).__name__}; save it again") from error
    found = _flat({name: value for name, value in variables.items() if not name.startswith("__")})
    table = {}
    for field in Columns.model_fields:
        name = columns.name(field)
        if name in found:
            vector = np.squeeze(np.asarray(found[name]))
            if vector.ndim != 1 or vector.dtype.kind not in "fiu":
                raise TuningError(
                    f"{path}: {name}: got {vector.dtype} of shape {vector.shape}, expected a vector of real numbers"
                )
            table[name] = vector.astype(np.float64)
    return _record(path, "MATLAB", table, sorted(found), columns)


def _cell(text: str) -> float:
    return float(text) if text.strip() else float("nan")


def _flat(variables: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Variables by name, fields of structures as ``structure.field``."""
    found: dict[str, Any] = {}
    for name, value in variables.items():
        if isinstance(value, dict):
            found |= _flat(value, f"{prefix}{name}.")
        else:
            found[f"{prefix}{name}"] = value
    return found


def _record(
    path: Path, kind: str, table: Mapping[str, NDArray[np.float64]], contents: list[str], columns: Columns
) -> Recording:
    there = ", ".join(contents) or "none"
    for field in Columns.model_fields:
        if getattr(columns, field).column is not None and columns.name(field) not in table:
            raise TuningError(f"{path}: {field}: no column {columns.name(field)!r}; this file has {there}")
    wanted = {signal: f"column {' and '.join(columns.name(f) for f in fields)}" for signal, fields in SIGNALS.items()}
    if columns.name("t") not in table:
        raise TuningError(
            f"{path}: no column {columns.name('t')!r} with the time; tell its name with --columns. There is {there}"
        )
    time = table[columns.name("t")] * columns.t.factor
    signals = {}
    for signal, fields in SIGNALS.items():
        names = [columns.name(field) for field in fields]
        if not all(name in table for name in names):
            continue
        for name in names:
            if len(table[name]) != len(time):
                raise TuningError(f"{path}: {name} has {len(table[name])} values, {columns.name('t')} has {len(time)}")
        factors = [getattr(columns, field).factor for field in fields]
        values = np.column_stack([table[name] * factor for name, factor in zip(names, factors, strict=True)])
        signals[signal] = Series(time, values, ", ".join(names))
    return Recording(path, kind, signals, wanted, contents, ADVICE)
