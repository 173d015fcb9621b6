"""What the design on the response must reach with full matrices (MIMO): limits on medians, and whether they are met."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from mimopilot.common.html_report import ReportTable
from mimopilot.sitl.flight.scenario import AXES
from mimopilot.sitl.studies.attitude_statistics import StudyStatistics
from mimopilot.sitl.studies.attitude_study import BEST, DEFAULT, MIMO, SISO
from mimopilot.tuning.spec import DesignLimits

#: Limits of J_M,o over the best on the true plant, and over the flown gains.
NEAR_BEST, BETTER = 1.15, 1.0
COLUMNS = ("study", "medians of MIMO", "found", "at most", "")


@dataclass(frozen=True)
class Expectation:
    """A figure of MIMO by design, or its ratio to another method's, and its limit.

    Attributes
    ----------
    study, axis, figure : str
        `figure`: see `sitl.studies.attitude_run.numbers`. `axis` is empty for those of the whole loop.
    over : str
        Method in the denominator; empty: none.
    text : str
        Label of the row.
    limit : float
    value : float
    """

    study: str
    axis: str
    figure: str
    over: str
    text: str
    limit: float
    value: float

    @property
    def met(self) -> bool:
        """Whether it is within the limit."""
        return self.value <= self.limit


def expectations(found: Sequence[StudyStatistics]) -> list[Expectation]:
    """All expectations of all studies, for the medians over the seeds.

    J_M,o is taken against one attitude model for all methods: that of MIMO's design in each run.
    """
    rows = []
    for statistics in found:
        name, offaxis = statistics.study.name, statistics.study.offaxis
        asked = [
            ("J_M_o_design", DEFAULT, "J_M,o over the flown gains'", BETTER),
            ("J_M_o_design", BEST, "J_M,o over the best possible", NEAR_BEST),
        ]
        if offaxis is not None:
            asked.insert(0, ("offaxis_peak_deg", SISO, "off-axis peak over SISO's", offaxis))
        for figure, over, text, limit in asked:
            for axis in AXES:
                ratio = statistics.median(MIMO, axis, figure) / statistics.median(over, axis, figure)
                rows.append(Expectation(name, axis, figure, over, f"{text}, {axis}", limit, ratio))
        limits = DesignLimits()
        for figure, text, limit in (
            ("noise", "noise of the torque over the flown gains'", limits.noise),
            ("true_Ms", "true Ms", limits.Ms),
        ):
            rows.append(Expectation(name, "", figure, "", text, limit, statistics.true_median(MIMO, figure)))
    return rows


def expectations_table(rows: Sequence[Expectation]) -> ReportTable:
    """Table of the figures and whether each is met."""
    return ReportTable(
        "Expectations of the design with full matrices",
        COLUMNS,
        [
            [row.study, row.text, f"{row.value:.3f}", f"{row.limit:.3g}", "met" if row.met else "NOT met"]
            for row in rows
        ],
    )
