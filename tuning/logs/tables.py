"""Tables: CSV files with a header line, and MATLAB files with one vector a signal."""

from __future__ import annotations

import csv
import itertools
import json
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from mimopilot.tuning.errors import TuningError
from mimopilot.tuning.logs.columns import SIGNALS, TIME_UNITS, Columns
from mimopilot.tuning.logs.matlab_sizes import check_sizes
from mimopilot.tuning.logs.recording import Recording, listed
from mimopilot.tuning.logs.resample import MIN_RATE, MIN_SECONDS, REQUIRED, Series
from numpy.typing import NDArray

ADVICE = (
    "log it at 100 Hz or more on the vehicle (PX4: SDLOG_PROFILE 49, ArduPilot: LOG_BITMASK bit 0) and export every "
    "sample; other names of columns are told with --columns"
)


NOTE = "which controller flew is not in such a file: give [yaw] and derivative_cutoff_hz in a --spec file"
REQUIRED_COLUMNS = tuple(field for signal in REQUIRED for field in SIGNALS[signal])
#: Sampling rates, Hz, that a log may have: position logs are slower, no flight controller is faster. Above the rate
#: of PX4's and ArduPilot's loops a short log is one whose time is in a larger unit.
RATES, FAST = (5.0, 10e3), 1e3


def record_csv(path: Path, columns: Columns) -> Recording:
    """Read a CSV file: a header line, then one sample a line; an empty cell or NaN is not logged.

    Parameters
    ----------
    path : Path
        The file; fields are separated by commas, semicolons or tabs. Numbers may have a decimal comma where commas
        do not separate them.
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
            used = {columns.name(field) for field in Columns.model_fields}
            twice = sorted(name for name, count in Counter(header).items() if count > 1 and name in used)
            if twice:
                raise TuningError(f"{path}: column {', '.join(twice)} appears twice; rename one")
            if all(_is_number(name) for name in header):
                raise TuningError(
                    f"{path}: the first line holds numbers; put a line with the names of the columns above"
                )
            indexed = [field for field in Columns.model_fields if getattr(columns, field).index is not None]
            if indexed:
                raise TuningError(f"{path}: {', '.join(indexed)}: index is for the columns of a MATLAB matrix")
            places = [i for i, name in enumerate(header) if name in used]
            filled = (line for line in stream if line.strip())
            if (row := next(filled, None)) is None:
                raise TuningError(f"{path}: no samples below the header line; export the log again")
            cells = next(csv.reader([row.rstrip("\r\n").rstrip(delimiter)], delimiter=delimiter))
            if len(cells) > len(header):
                raise TuningError(
                    f"{path}: {len(cells)} cells in the first row, {len(header)} names in the header"
                    + ("; decimal commas? Then separate the cells with semicolons" if delimiter == "," else "")
                )
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
    return _record(
        path, "CSV", {field: table.get(columns.name(field)) for field in Columns.model_fields}, header, columns
    )


def record_matlab(path: Path, columns: Columns) -> Recording:
    """Read a MATLAB file (version 5 to 7): vectors or columns of matrices, by variable or ``structure.field``.

    Parameters
    ----------
    path : Path
        The file.
    columns : Columns
        Names, indices, units and signs.

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
        check_sizes(path)
        variables = loadmat(path, simplify_cells=True)
    except TuningError:
        raise
    except Exception as error:  # scipy raises whatever a damaged file makes of its parser
        raise TuningError(f"{path}: damaged MATLAB file: {error or type(error).__name__}; save it again") from error
    found = _flat({name: value for name, value in variables.items() if not name.startswith("__")})
    table = {field: _vector(path, found, field, columns) for field in Columns.model_fields}
    return _record(path, "MATLAB", table, sorted(found), columns)


def _vector(path: Path, found: Mapping[str, Any], field: str, columns: Columns) -> NDArray[np.float64] | None:
    """A signal in a MATLAB file, of a matrix the column that the column file picks; None when it is not there."""
    name, index = columns.name(field), getattr(columns, field).index
    if name not in found:
        return None
    values = np.squeeze(np.asarray(found[name]))
    got = f"{path}: {name}: got {values.dtype} of shape {values.shape}"
    if values.dtype.kind not in "fiu" or values.ndim not in (1, 2):
        raise TuningError(f"{got}, expected a vector of real numbers")
    if values.ndim == 2 or index is not None:
        mend = f'{field} = {{ column = "{name}", index = 1 }}'
        rows = np.atleast_2d(values)
        rows = rows if rows.shape[0] >= rows.shape[1] else rows.T  # there are more samples than signals
        if index is None:
            raise TuningError(f"{got}, expected a vector of real numbers; pick its column: {mend} (the first is 1)")
        if index > rows.shape[1]:
            raise TuningError(f"{got}: {field}: index {index}, expected 1 to {rows.shape[1]} (the first is 1)")
        values = rows[:, index - 1]
    return values.astype(np.float64)


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _cell(text: str) -> float:
    return float(text.replace(",", ".")) if text.strip() else float("nan")


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
    path: Path, kind: str, table: Mapping[str, NDArray[np.float64] | None], contents: list[str], columns: Columns
) -> Recording:
    """The signals of a table: field of `Columns` -> values as they are in the file, None when it is not there."""
    lost = [field for field, values in table.items() if values is None]
    wrong = [f"{f}: no column {columns.name(f)!r}" for f in lost if getattr(columns, f).column is not None]
    if table["t"] is None and columns.t.column is None:
        wrong.append("no column 't' with the time, without which the sampling rate is not known")
    if wrong:
        lacking = [f for f in REQUIRED_COLUMNS if f in lost and getattr(columns, f).column is None]
        wrong += [f"no column {', '.join(lacking)}"] if lacking else []
        raise TuningError(
            f"{path}: {'; '.join(wrong)}; this file has {listed(contents)}. Give the names in a --columns FILE.toml"
        )
    wanted = {signal: f"column {' and '.join(columns.name(f) for f in fields)}" for signal, fields in SIGNALS.items()}
    given = table["t"]
    assert given is not None
    time = given * columns.t.factor
    signals = {}
    for signal, fields in SIGNALS.items():
        pair = [(field, values) for field in fields if (values := table[field]) is not None]
        if len(pair) < len(fields):
            continue
        for field, values in pair:
            if len(values) != len(time):
                raise TuningError(
                    f"{path}: {columns.name(field)} has {len(values)} values, {columns.name('t')} has {len(time)}"
                )
        rows = np.column_stack([values * getattr(columns, field).factor for field, values in pair])
        signals[signal] = Series(time, rows, ", ".join(columns.name(field) for field in fields))
    faults = _clock_faults(path, given, columns)
    return Recording(path, kind, signals, wanted, contents, ADVICE, faults=faults, notes=(NOTE,), columns=columns)


def _clock_faults(path: Path, given: NDArray[np.float64], columns: Columns) -> tuple[str, ...]:
    """Why a time column as it is in the file cannot be that of a multirotor's log, and the line that mends it."""
    name, unit = columns.name("t"), columns.t.unit
    steps = np.diff(given[np.isfinite(given)])
    steps = steps[steps != 0]
    step = float(np.median(steps)) if len(steps) else 0.0
    if step <= 0:
        raise TuningError(f"{path}: column {name}: the time does not rise; it must be the time of each sample")
    rate, seconds = 1 / (step * columns.t.factor), step * len(given) * columns.t.factor
    if RATES[0] <= rate <= RATES[1] and (rate <= FAST or seconds >= MIN_SECONDS):
        return ()
    found = f"column {name}: steps of {step:.6g} {unit} are a rate of {rate:.4g} Hz and a flight of {seconds:.4g} s"
    if step == 1 and np.all(steps == 1):
        return (f"{found}: it counts the samples, whose time must be in its place, or {_unit_line(name, 'ms')}",)
    fitting = next((other for other in TIME_UNITS if RATES[0] <= 1 / (step * TIME_UNITS[other]) <= FAST), unit)
    if fitting != unit:
        right = 1 / (step * TIME_UNITS[fitting])
        slow = f"; its rate is then {right:.4g} Hz, tuning needs {MIN_RATE:g} Hz or more" if right < MIN_RATE else ""
        return (f"{found}, of no multirotor log; {_unit_line(name, fitting)}{slow}",)
    return (f"{found}, of no multirotor log; its unit must be s, ms, us or ns: minutes, say, must be converted",)


def _unit_line(name: str, unit: str) -> str:
    return f'put its unit into the --columns file: t = {{ column = {json.dumps(name)}, unit = "{unit}" }}'
