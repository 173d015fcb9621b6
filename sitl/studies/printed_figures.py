"""How the figures printed in the thesis come out on the airframes that are fitted to its gains."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mimopilot.common.html_report import ReportTable
from mimopilot.sitl.studies.attitude_statistics import StudyStatistics
from mimopilot.sitl.studies.attitude_study import (
    MIMO_PRINTED,
    MIMO_THESIS,
    PRINTED_KEYS,
    SISO_PRINTED,
    SISO_THESIS,
)

#: Largest relative difference that counts as equal, and half a unit of the last printed digit of a gain.
NEAR, ROUNDING = 0.15, 5e-5
#: Figure of `sitl.flight.metrics.Performance` -> its symbol in the thesis.
COSTS = {"J_M_o": "J_M,o", "J_M_i": "J_M,i", "J_r_o": "J_r,o", "J_r_i": "J_r,i"}
COLUMNS = ("figure", "printed", "ours", "ours/printed", "sign", "within 15 %")
SUMMARY_COLUMNS = ("study", "signs", "within 15 %", "J_M,o MIMO/SISO", "tuned here", "printed gains here")


@dataclass(frozen=True)
class PrintedFigure:
    """A printed figure and ours.

    Attributes
    ----------
    name : str
    kind : str
        ``gain``, ``cost`` or ``ratio``: MIMO's cost over SISO's.
    printed, ours : float
        In the same unit; ours is a median, or a ratio of medians, over the seeds.
    """

    name: str
    kind: str
    printed: float
    ours: float

    @property
    def sign(self) -> bool:
        """Whether the sign is the printed one."""
        return self.printed * self.ours > 0

    @property
    def near(self) -> bool:
        """Whether ours is within `NEAR` of the printed one; for a gain also if it is the same when rounded."""
        rounding = ROUNDING if self.kind == "gain" else 0.0
        return abs(self.ours - self.printed) <= max(NEAR * abs(self.printed), rounding)


def printed_figures(found: StudyStatistics) -> list[PrintedFigure]:
    """Every printed figure of a study that is not zero."""
    study = found.study
    figures = []
    methods = {key: method for method, key in PRINTED_KEYS.items()}
    for key, matrices in study.gains_table[1].items():
        for matrix, printed in matrices.items():
            ours = np.median(found.gains(methods[key], matrix), axis=0)
            for (i, j), value in np.ndenumerate(np.array(printed)):
                if value:
                    name = f"{key} {matrix}({i + 1},{j + 1})"
                    figures.append(PrintedFigure(name, "gain", float(value), float(ours[i, j])))
    _, axis, costs = study.costs_table
    for key, entries in costs.items():
        for cost, value in entries.items():
            median = found.median(methods[key], axis, cost)
            figures.append(PrintedFigure(f"{key} {COSTS[cost]}", "cost", value, median))
    for cost, symbol in COSTS.items() if costs else ():
        printed_ratio = costs["MIMO"][cost] / costs["SISO"][cost]
        pairs = {"": (MIMO_THESIS, SISO_THESIS), ", printed gains": (MIMO_PRINTED, SISO_PRINTED)}
        for text, (over, under) in pairs.items():
            ours_ratio = found.median(over, axis, cost) / found.median(under, axis, cost)
            figures.append(PrintedFigure(f"{symbol} MIMO/SISO{text}", "ratio", printed_ratio, ours_ratio))
    return figures


def printed_table(found: StudyStatistics) -> ReportTable:
    """Table of `printed_figures`."""
    rows = [
        [
            one.name,
            f"{one.printed:.4g}",
            f"{one.ours:.4g}",
            f"{one.ours / one.printed:.2f}",
            "" if one.kind != "gain" else "yes" if one.sign else "NO",
            "yes" if one.near else "no",
        ]
        for one in printed_figures(found)
    ]
    axis = f", {found.study.costs_table[0]} for {found.study.costs_table[1]}" if found.study.costs_table[2] else ""
    return ReportTable(f"{found.study.name}: {found.study.gains_table[0]}{axis}", COLUMNS, rows)


def summary_table(every: Sequence[StudyStatistics]) -> ReportTable:
    """How many printed gains come out in each study, and the main result: J_M,o of MIMO over SISO's."""
    rows = []
    for found in every:
        figures = printed_figures(found)
        gains = [one for one in figures if one.kind == "gain"]
        ratios = [one for one in figures if one.kind == "ratio" and one.name.startswith(COSTS["J_M_o"])]
        main = [*(one.printed for one in ratios[:1]), *(one.ours for one in ratios)]
        rows.append(
            [
                f"{found.study.name}, {found.study.gains_table[0]}",
                f"{sum(one.sign for one in gains)} of {len(gains)}",
                f"{sum(one.near for one in gains)} of {len(gains)}",
                *(f"{value:.2f}" for value in main),
                *[""] * (3 - len(main)),
            ]
        )
    return ReportTable("Printed gains that come out", SUMMARY_COLUMNS, rows)
