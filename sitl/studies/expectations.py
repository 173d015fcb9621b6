"""Expected performance of the multivariable method: limits on ratios of medians, and whether they are met."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from mimopilot.common.html_report import ReportTable
from mimopilot.sitl.flight.scenario import AXES
from mimopilot.sitl.studies.attitude_statistics import StudyStatistics
from mimopilot.sitl.studies.attitude_study import BEST, MIMO, REFINED, SISO

#: Limits: J_M,o over the best on the true plant, effort over SISO's, J_M,o over SISO's.
NEAR_BEST, EFFORT, NO_WORSE = 1.15, 1.10, 1.0
COLUMNS = ("study", "medians", "at most", MIMO, "", REFINED, "")


@dataclass(frozen=True)
class Expectation:
    """A ratio of medians and its limit.

    Attributes
    ----------
    study, axis, figure : str
        `figure` is a field of `sitl.flight.metrics.Performance`.
    over : str
        Method in the denominator.
    text : str
        Label of the row.
    limit : float
    ratios : dict
        Method -> ratio.
    """

    study: str
    axis: str
    figure: str
    over: str
    text: str
    limit: float
    ratios: dict[str, float]

    def met(self, method: str) -> bool:
        """Whether a method is within the limit."""
        return self.ratios[method] <= self.limit


def expectations(found: Sequence[StudyStatistics]) -> list[Expectation]:
    """All expectations of all studies, for the medians over the seeds."""
    rows = []
    for statistics in found:
        offaxis = statistics.study.offaxis
        asked = [
            ("J_M_o", SISO, "J_M,o over SISO's", NO_WORSE),
            ("J_M_o", BEST, "J_M,o over the best possible", NEAR_BEST),
            ("effort_rms", SISO, "effort over SISO's", EFFORT),
        ]
        if offaxis is not None:
            asked.insert(0, ("offaxis_peak_deg", SISO, "off-axis peak over SISO's", offaxis))
        for figure, over, text, limit in asked:
            for axis in AXES:
                base = statistics.median(over, axis, figure)
                ratios = {method: statistics.median(method, axis, figure) / base for method in (MIMO, REFINED)}
                rows.append(Expectation(statistics.study.name, axis, figure, over, text, limit, ratios))
    return rows


def expectations_table(rows: Sequence[Expectation]) -> ReportTable:
    """Table of the ratios and whether each is met."""

    def cells(row: Expectation, method: str) -> list[str]:
        return [f"{row.ratios[method]:.3f}", "met" if row.met(method) else "NOT met"]

    return ReportTable(
        "Expectations: ratios of medians",
        COLUMNS,
        [
            [row.study, f"{row.text}, {row.axis}", f"{row.limit:.3g}", *cells(row, MIMO), *cells(row, REFINED)]
            for row in rows
        ],
    )
