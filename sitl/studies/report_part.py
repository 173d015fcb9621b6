"""The part of a report that one study contributes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

from mimopilot.common.chart_json import chart_from_json, chart_to_json
from mimopilot.common.html_report import ReportTable, Section


@dataclass(frozen=True)
class ReportPart:
    """One study's part of a report.

    Attributes
    ----------
    lead : str
        One sentence on what was done.
    sections : sequence of Section
    figures : dict
        The study's part of the object that ``--json`` prints.
    """

    lead: str
    sections: Sequence[Section]
    figures: dict[str, Any]

    @property
    def tables(self) -> list[ReportTable]:
        """The tables of all sections, in order."""
        return [table for section in self.sections for table in section.tables]

    def as_json(self) -> dict[str, Any]:
        """The part as a JSON value, see `from_json`."""
        sections = [
            asdict(replace(section, charts=())) | {"charts": [chart_to_json(chart) for chart in section.charts]}
            for section in self.sections
        ]
        return {"lead": self.lead, "sections": sections, "figures": self.figures}

    @classmethod
    def from_json(cls, value: dict[str, Any]) -> ReportPart:
        """The part from `as_json`."""
        sections = [
            Section(
                **section
                | {
                    "tables": [ReportTable(**table) for table in section["tables"]],
                    "charts": [chart_from_json(chart) for chart in section["charts"]],
                }
            )
            for section in value["sections"]
        ]
        return cls(value["lead"], sections, value["figures"])
