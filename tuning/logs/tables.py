"""Readers of tables: CSV files with a header line, MATLAB files with one vector per signal."""

from __future__ import annotations

import csv
import itertools
import json
from collections import Counter
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mimopilot.tuning.errors import TuningError
from mimopilot.tuning.logs.columns import SIGNALS, TIME_UNITS, YAW_SIGNALS, Columns
from mimopilot.tuning.logs.matlab_sizes import check_sizes
from mimopilot.tuning.logs.recording import Recording, listed
from mimopilot.tuning.logs.resample import MIN_RATE, MIN_SECONDS, REQUIRED, Series
from mimopilot.tuning.px4_names import LOG_PROFILE, TUNING_PROFILE

ADVICE = (
    f"log it at 100 Hz or more on the vehicle (PX4: {LOG_PROFILE} {TUNING_PROFILE}, ArduPilot: LOG_BITMASK bit 0) and "
    "export every sample; if the columns have other names, give them with --columns"
)
NOTE = "the file does not hold the flown gains: give [yaw] and derivative_cutoff_hz in a --spec file"
REQUIRED_COLUMNS = tuple(field for signal in REQUIRED for field in SIGNALS[signal])
#: Plausible sampling rates, Hz: position logs are slower, no flight controller logs faster.
RATES = (5.0, 10e3)
#: Hz. PX4 and ArduPilot loops are slower; a short log that seems faster has its time in a larger unit.
FAST = 1e3


def record_csv(path: Path, columns: Columns) -> Recording:
    """Read a CSV file: a header line, then one sample per line. An empty cell or NaN means not logged.

    Parameters
    ----------
    path : Path
        The file. Commas, semicolons or tabs separate the cells. Decimal commas are allowed with the latter two.
    columns : Columns
        Names, units and signs.

    Returns
    -------
    Recording

    Raises
    ------
    TuningError
        When it has no header line or no samples, or a cell is not a number.
    """
    try:
        with path.open(encoding="utf-8-sig", newline="") as stream:
            first = stream.readline()
            delimiter = max(",;\t", key=first.count)
            header = [name.strip().lstrip("#").strip() for name in next(csv.reader([first], delimiter=delimiter))]
            optional = _optional(columns)
            used = {columns.name(field) for field in Columns.model_fields}
            count = Counter(header)
            used -= {name for name in optional if count[name] > 1}
            twice = sorted(name for name in used if count[name] > 1)
            if twice:
                raise TuningError(f"{path}: column {', '.join(twice)} appears twice; rename one")
            if all(_is_number(name) for name in header):
                raise TuningError(f"{path}: the first line holds numbers; add a line with the column names above")
            indexed = [field for field in Columns.model_fields if getattr(columns, field).index is not None]
            if indexed:
                raise TuningError(f"{path}: {', '.join(indexed)}: index picks a column of a MATLAB matrix; remove it")
            places = [i for i, name in enumerate(header) if name in used]
            filled = (line for line in stream if line.strip())
            if (row := next(filled, None)) is None:
                raise TuningError(f"{path}: no samples below the header line; export the log again")
            cells = next(csv.reader([row.rstrip("\r\n").rstrip(delimiter)], delimiter=delimiter))
            if len(cells) > len(header):
                raise TuningError(
                    f"{path}: {len(cells)} cells in the first row, {len(header)} names in the header"
                    + (
                        "; if the numbers have decimal commas, separate the cells with semicolons"
                        if delimiter == ","
                        else ""
                    )
                )
            rows = np.empty((0, 0))
            if places:
                lines = itertools.chain([row], filled)
                cell: dict[int | str, Callable[[str], Any]] = {}
                cell |= {place: _number_or_nan if header[place] in optional else _cell for place in places}
                rows = np.loadtxt(lines, delimiter=delimiter, usecols=places, ndmin=2, converters=cell, quotechar='"')
    except TuningError:
        raise
    except (ValueError, UnicodeDecodeError, csv.Error, OverflowError, IndexError) as error:
        raise TuningError(f"{path}: expected numbers below one header line: {error}") from error
    names = [header[i] for i in places]
    table = dict(zip(names, rows.T, strict=False)) if rows.size else {}
    return _record(
        path, "CSV", {field: table.get(columns.name(field)) for field in Columns.model_fields}, header, columns
    )


def record_matlab(path: Path, columns: Columns) -> Recording:
    """Read a MATLAB file (version 5 to 7): vectors or matrix columns, named by variable or ``structure.field``.

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
    except Exception as error:  # a damaged file makes scipy raise almost anything
        raise TuningError(f"{path}: damaged MATLAB file: {error or type(error).__name__}; save it again") from error
    found = _flat({name: value for name, value in variables.items() if not name.startswith("__")})
    table = {field: _vector(path, found, field, columns) for field in Columns.model_fields}
    return _record(path, "MATLAB", table, sorted(found), columns)


def _optional(columns: Columns) -> set[str]:
    """Names of yaw's columns that the column file does not name: they may be something else."""
    used = {columns.name(field) for field in Columns.model_fields if field not in YAW_SIGNALS.values()}
    return {field for field in YAW_SIGNALS.values() if getattr(columns, field).column is None} - used


def _vector(path: Path, found: Mapping[str, Any], field: str, columns: Columns) -> NDArray[np.float64] | None:
    """Values of a field in a MATLAB file; None when it is not there. Of a matrix, the column that `index` picks."""
    name, index = columns.name(field), getattr(columns, field).index
    if name not in found:
        return None
    values = np.squeeze(np.asarray(found[name]))
    if name in _optional(columns) and (values.dtype.kind not in "fiu" or values.ndim != 1):
        return None
    got = f"{path}: {name}: got {values.dtype} of shape {values.shape}"
    if values.dtype.kind not in "fiu" or values.ndim not in (1, 2):
        raise TuningError(f"{got}, expected a vector of real numbers")
    if values.ndim == 2 or index is not None:
        correction = f'{field} = {{ column = "{name}", index = 1 }}'
        rows = np.atleast_2d(values)
        rows = rows if rows.shape[0] >= rows.shape[1] else rows.T  # there are more samples than signals
        if index is None:
            raise TuningError(
                f"{got}, expected a vector of real numbers; pick its column: {correction} (the first is 1)"
            )
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


def _number_or_nan(text: str) -> float:
    """A cell of a column that may hold something else."""
    try:
        return _cell(text)
    except ValueError:
        return float("nan")


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
    """The recording of a table: field of `Columns` -> values as in the file, None when it is not there."""
    lost = [field for field, values in table.items() if values is None]
    wrong = [f"{f}: no column {columns.name(f)!r}" for f in lost if getattr(columns, f).column is not None]
    if table["t"] is None and columns.t.column is None:
        wrong.append("no column 't' with the time of each sample")
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
    yaw = {}
    for signal, field in YAW_SIGNALS.items():
        heading = table[field]
        name = columns.name(field)
        if heading is not None and len(heading) != len(time) and name not in _optional(columns):
            raise TuningError(f"{path}: {name} has {len(heading)} values, {columns.name('t')} has {len(time)}")
        if heading is not None and len(heading) == len(time):
            yaw[signal] = Series(time, heading[:, None] * getattr(columns, field).factor, name)
    faults = _clock_faults(path, given, columns)
    return Recording(
        path, kind, signals, wanted, contents, ADVICE, faults=faults, notes=(NOTE,), yaw=yaw, columns=columns
    )


def _clock_faults(path: Path, given: NDArray[np.float64], columns: Columns) -> tuple[str, ...]:
    """Why the time column cannot be that of a multirotor log, with the line that corrects it; empty when it can."""
    name, unit = columns.name("t"), columns.t.unit
    steps = np.diff(given[np.isfinite(given)])
    steps = steps[steps != 0]
    step = float(np.median(steps)) if len(steps) else 0.0
    if step <= 0:
        raise TuningError(
            f"{path}: column {name}: the time does not increase; give the column with the time of each sample"
        )
    rate, seconds = 1 / (step * columns.t.factor), step * len(given) * columns.t.factor
    if RATES[0] <= rate <= RATES[1] and (rate <= FAST or seconds >= MIN_SECONDS):
        return ()
    found = f"column {name}: steps of {step:.6g} {unit} mean a rate of {rate:.4g} Hz and a flight of {seconds:.4g} s"
    if step == 1 and np.all(steps == 1):
        return (f"{found}: it counts samples: give the column with their time, or {_unit_line(name, 'ms')}",)
    fitting = next((other for other in TIME_UNITS if RATES[0] <= 1 / (step * TIME_UNITS[other]) <= FAST), unit)
    if fitting != unit:
        right = 1 / (step * TIME_UNITS[fitting])
        slow = f"; its rate is then {right:.4g} Hz, tuning needs {MIN_RATE:g} Hz or more" if right < MIN_RATE else ""
        return (f"{found}, not a multirotor log; {_unit_line(name, fitting)}{slow}",)
    return (f"{found}, not a multirotor log; convert the time to s, ms, us or ns",)


def _unit_line(name: str, unit: str) -> str:
    return f'give its unit in the --columns file: t = {{ column = {json.dumps(name)}, unit = "{unit}" }}'
