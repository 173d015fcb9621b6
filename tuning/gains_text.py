"""The text of a gains file, ``*.gains.toml``; `tuning.gains_file` reads it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from mimopilot.common.toml import toml_entries, toml_value
from mimopilot.tuning.certificate import Certificate
from mimopilot.tuning.control_laws import control_law
from mimopilot.tuning.law_filters import Filters
from mimopilot.tuning.parameter_row import Row, Shape
from mimopilot.tuning.parameters import rows
from mimopilot.tuning.provenance import Provenance

#: Schema of the gains file.
SCHEMA = 2
#: Key of `Filters.shaping_s` in the file of our law.
SHAPING = "shaping_s"
_SHAPING_COMMENT = ("# r_o is shaped by ArduPilot (shaping_s) and dr_o/dt added to r_i, as in the flight of the log.",)
#: The law of a set with model following, in its file.
_MODEL_COMMENT = (
    "# Model following, roll and pitch: th is the angle of the attitude model, second order from r_o (model_omega,",
    "# model_damping):  r_i = Kp_o (th - y_o) + Kff_o dth/dt;  u has the additional term Kaff_i d2th/dt2",
)


def gains_text(
    values: Mapping[Row, Any],
    filters: Filters,
    moment_scale: tuple[float, float, float] | None,
    certificate: Certificate | None,
    provenance: Provenance,
) -> str:
    """Text of the gains file; reading it back restores the same bits of every float.

    Parameters
    ----------
    values : mapping
        Row of the parameter table -> its matrix, triple or number; what the law lacks is left out of the text.
    filters : Filters
    moment_scale : tuple of 3 float or None, N m
        Torque of u = 1 on roll, pitch and yaw. None: not known.
    certificate : Certificate or None
    provenance : Provenance
    """
    law, stock, shaping = control_law(filters), filters.stock, filters.shaping_s

    def line(row: Row) -> str:
        note = {Shape.SCALAR: row.unit, Shape.POLE: "0: no filter"}.get(row.shape, "")
        plain = np.asarray(values[row], dtype=np.float64).tolist()
        return f"{row.key} = {toml_value(plain)}{f'  # {note}' if note else ''}"

    def lines_of(shape: Shape) -> list[str]:
        return [line(row) for row in rows(shape) if row in values and row.key not in law.lacks]

    scale = toml_value(list(moment_scale)) if moment_scale else '"unknown"'
    lines = [
        *law.text,
        *(_MODEL_COMMENT if filters.model_omega else ()),
        *(_SHAPING_COMMENT if shaping else ()),
        f"schema = {SCHEMA}",
        *(() if stock is None else (f"controller = {toml_value(stock.controller)}",)),
        *lines_of(Shape.SCALAR),
        *lines_of(Shape.POLE),
        *((f"{SHAPING} = {toml_value(shaping)}  # s",) if shaping else ()),
        f"moment_scale = {scale}  # N m that u = 1 stands for: roll, pitch, yaw",
    ]
    for shape, head in ((Shape.MATRIX, ""), (Shape.YAW, ""), (Shape.AXES, "  # roll, pitch, yaw")):
        lines += ["", f"[{rows(shape)[0].section}]{head}", *lines_of(shape)]
    if stock is not None:
        lines += ["", "[filters]  # roll, pitch, yaw; Hz, 0: none"]
        lines += [f"{name} = {toml_value(list(getattr(stock, name)))}" for name in law.filters]
    tables = {"certificate": certificate, "provenance": provenance}
    for name, content in tables.items():
        entries = content.as_table() if content is not None else {}
        if entries:
            lines += ["", f"[{name}]", *toml_entries(entries)]
    return "\n".join(lines) + "\n"
