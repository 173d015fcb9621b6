"""The gains with their intervals."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from mimopilot.common.figures import Chart, Line, Panel
from mimopilot.common.html_report import ReportTable, Section
from mimopilot.common.text_table import plus_minus
from mimopilot.sitl.field.report.analysis.flight_data import GainCase
from mimopilot.tuning.parameter_row import Shape
from mimopilot.tuning.parameters import YAW_GAINS, rows

ELEMENTS = ("roll<-roll", "roll<-pitch", "pitch<-roll", "pitch<-pitch")


def gains_section(cases: Sequence[GainCase]) -> Section:
    """All gain sets beside one another."""
    if not cases:
        return Section(
            "Gains", "The log does not hold the flown gains, and none are given: name a gains file with --gains."
        )
    names = [row.key for row in rows(Shape.MATRIX) if any(_used(case, row.key) for case in cases)]
    units = {row.key: row.unit for row in rows(Shape.MATRIX)}
    panels, table = [], []
    for name in names:
        lines = []
        for place, case in enumerate(cases):
            values = np.ravel(getattr(case.gains, name))
            deviation = np.ravel(case.gains.provenance.standard_deviation.get(name, np.full((2, 2), np.nan)))
            x = np.arange(4) + 0.16 * (place - (len(cases) - 1) / 2)
            error = 2 * deviation if np.isfinite(deviation).all() else None
            marker = ("o", "s", "x")[place % 3]
            lines.append(Line(x, values, case.label, case.colour, width=0, marker=marker, error=error))
            for k, (value, spread) in enumerate(zip(values, 2 * deviation, strict=True)):
                table.append([f"{name} {ELEMENTS[k]}", case.label, plus_minus(value, spread)])
        unit = f"[{units[name]}]" if units[name] and units[name] != "norm" else ""
        panels.append(Panel(name, "output<-error", unit, lines, x_names=ELEMENTS, height=240))
    order = [f"{name} {element}" for name in names for element in ELEMENTS]
    columns = ["", *(case.label for case in cases)]
    cells = {(row[0], row[1]): row[2] for row in table}
    body = [[element, *(cells.get((element, case.label), "") for case in cases)] for element in order]
    body += _yaw_rows(cases)
    body.append(["derivative filter", *(_hertz(case.gains.derivative_cutoff_hz) for case in cases)])
    body.append(["controller", *(case.gains.controller for case in cases)])
    body.append(["control rate", *(f"{1 / case.gains.Ts:g} Hz" for case in cases)])
    caption = (
        "Bars: two standard deviations, the spread to expect if the flight were repeated. A set without bars was not "
        "estimated."
    )
    return Section(
        "Gains",
        charts=[Chart("gains", caption, panels, linked=False)],
        tables=[ReportTable("Gains (+- two standard deviations)", columns, body)],
    )


def _yaw_rows(cases: Sequence[GainCase]) -> list[list[str]]:
    """The gains of yaw that any set uses, with their deviations where they were estimated."""
    found = []
    for name in YAW_GAINS:
        values = [float(getattr(case.gains.yaw, name)) for case in cases]
        deviations = [_yaw_deviation(case, name) for case in cases]
        if any(values):
            pairs = zip(values, deviations, strict=True)
            found.append([f"{name} yaw", *(plus_minus(value, 2 * deviation) for value, deviation in pairs)])
    return found


def _yaw_deviation(case: GainCase, name: str) -> float:
    table: Any = case.gains.provenance.standard_deviation.get("yaw", {})
    return float(np.ravel(table[name])[0]) if name in table else float("nan")


def _used(case: GainCase, name: str) -> bool:
    return name in case.gains.matrices and bool(np.any(getattr(case.gains, name)))


def _hertz(value: float) -> str:
    return f"{value:g} Hz" if value else "none"
