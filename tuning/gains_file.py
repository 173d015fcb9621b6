"""Gains as a readable TOML file, ``*.gains.toml``; its keys come from the parameter table."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from mimopilot.common.errors import Error
from mimopilot.common.toml import GAINS_FILE, parse_toml, read_toml, shown, shown_text
from mimopilot.tuning.certificate import Certificate
from mimopilot.tuning.control_laws import LAWS
from mimopilot.tuning.errors import TuningError
from mimopilot.tuning.gains import SCHEMA_1, Gains
from mimopilot.tuning.gains_text import SCHEMA, SHAPING
from mimopilot.tuning.law_filters import MIMO, StockFilters
from mimopilot.tuning.parameter_row import Row, Shape
from mimopilot.tuning.parameters import ROWS, rows
from mimopilot.tuning.provenance import Provenance

#: Tables and entries other than the parameter table's keys.
SECTIONS = ("roll_pitch", "yaw", "limits")
OTHERS = ("schema", "controller", "moment_scale", "certificate", "provenance")
#: Table of the filters of a stock controller.
FILTERS = "filters"


def set_name(path: Path) -> str:
    """Name of a gain set: that of its file without ``.gains.toml``."""
    return path.name.removesuffix(".toml").removesuffix(".gains")


def load_gains(path: str | Path) -> Gains:
    """Read a ``*.gains.toml`` file, of schema 2 or 1.

    Raises
    ------
    Error
        When the file is missing, is not TOML, lacks a matrix, or has a number that is not finite.
    """
    return _gains(read_toml(Path(path), GAINS_FILE), str(path))


def gains_from_toml(text: str, where: str) -> Gains:
    """Parse the text of a gains file; `where` names it in messages. See `load_gains`."""
    return _gains(parse_toml(text, where), where)


def _gains(table: dict[str, Any], where: str) -> Gains:
    schema = table.get("schema")
    if isinstance(schema, int) and not isinstance(schema, bool) and schema > SCHEMA:
        raise TuningError(
            f"{where}: schema: got {schema}, this version of mimopilot knows up to {SCHEMA}: the file is from a later "
            "one; update mimopilot"
        )
    if isinstance(schema, bool) or schema not in (1, SCHEMA):
        raise TuningError(
            f"{where}: schema: got {shown(schema)}, expected {SCHEMA} (or 1, an older one); not a mimopilot gains file?"
        )
    controller = table.get("controller", MIMO)
    if controller not in LAWS:
        raise TuningError(f"{where}: controller: got {shown(controller)}, expected one of {', '.join(LAWS)}")
    lacks = LAWS[controller].lacks
    scalars = {row.key for row in rows(Shape.POLE, Shape.SCALAR)} - set(lacks)
    known = {*OTHERS, *SECTIONS, *scalars, SHAPING if controller == MIMO else FILTERS}
    for key in sorted(set(table) - known):
        raise TuningError(f"{where}: {shown_text(key)}: unknown entry; known: {', '.join(sorted(known))}")
    for name in ("certificate", "provenance"):
        if not isinstance(table.get(name, {}), dict):
            raise TuningError(f"{where}: {name}: got {shown(table[name])}, expected a table")
    try:
        values = {row: _entry(table, row) for row in ROWS if row.key not in lacks and not _is_left_out(table, row)}
        values |= {row: 0.0 for row in rows(Shape.POLE) if row.key in lacks}
        certificate = Certificate.from_table(table["certificate"]) if "certificate" in table else None
        if certificate is not None and schema == 1:
            certificate = replace(certificate, seal=SCHEMA_1)
        scale = _get(table, "moment_scale", "")
        return Gains.from_rows(
            values,
            stock=_stock(table, controller),
            shaping_s=_number(table.get(SHAPING, 0.0), SHAPING),
            moment_scale=None if scale == "unknown" else _triple(scale, "moment_scale"),
            certificate=certificate,
            provenance=Provenance.from_table(table.get("provenance", {})),
        )
    except (Error, OverflowError) as error:
        raise TuningError(f"{where}: {error}") from error


def _stock(table: dict[str, Any], controller: str) -> StockFilters | None:
    """Filters of a stock controller; None for ours."""
    if controller == MIMO:
        return None
    section, names = _get(table, FILTERS, ""), LAWS[controller].filters
    for key in sorted(set(section) - set(names)) if isinstance(section, dict) else ():
        raise TuningError(f"{FILTERS}.{shown_text(key)}: unknown entry; known: {', '.join(names)}")
    # ArduPilot sets from before the shaping was known have none.
    found = [name for name in names if name != "shaping_s" or name in section]
    return StockFilters(
        controller, **{name: _triple(_get(section, name, FILTERS), f"{FILTERS}.{name}") for name in found}
    )


def _is_left_out(table: dict[str, Any], row: Row) -> bool:
    """Whether the file lacks a matrix that it may lack; `Gains` refuses that while the matrix' option is on."""
    section = table.get(row.section)
    optional = row.shape is Shape.MATRIX and row.default is not None
    return optional and isinstance(section, dict) and row.key not in section


def _entry(table: dict[str, Any], row: Row) -> Any:
    """Value of a row in the file, or the row's default."""
    section = _get(table, row.section, "") if row.section else table
    if row.default is not None and isinstance(section, dict) and row.key not in section:
        return (row.default,) * 3 if row.shape is Shape.AXES else row.default
    value = _get(section, row.key, row.section)
    where = f"{row.section}.{row.key}" if row.section else row.key
    if row.shape is Shape.MATRIX:
        return _matrix(value, where)
    return _triple(value, where) if row.shape is Shape.AXES else _number(value, where)


def _get(table: Any, key: str, section: str) -> Any:
    if not isinstance(table, dict) or key not in table:
        name = f"{section}.{key}" if section else key
        raise TuningError(f"{name}: missing; add it to the file, it has no default")
    return table[key]


def _number(value: Any, where: str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise TuningError(f"{where}: got {shown(value)}, expected a number")
    return float(value)


def _matrix(rows: Any, where: str) -> Any:
    well_formed = (
        isinstance(rows, list)
        and len(rows) == 2
        and all(isinstance(row, list) and len(row) == 2 for row in rows)
        and all(isinstance(v, int | float) and not isinstance(v, bool) for row in rows for v in row)
    )
    if not well_formed:
        raise TuningError(f"{where}: got {shown(rows)}, expected a 2x2 list of numbers, roll then pitch")
    return np.array(rows, dtype=np.float64)


def _triple(value: Any, where: str) -> tuple[float, float, float]:
    if (
        not isinstance(value, list)
        or len(value) != 3
        or not all(isinstance(v, int | float) and not isinstance(v, bool) for v in value)
    ):
        raise TuningError(f"{where}: got {shown(value)}, expected three numbers: roll, pitch, yaw")
    return (float(value[0]), float(value[1]), float(value[2]))
