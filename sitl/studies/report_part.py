"""What a study contributes to a report."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from mimopilot.common.html_report import Section, Table


@dataclass(frozen=True)
class ReportPart:
    """One study's share.

    Attributes
    ----------
    lead : str
        What was done, in a sentence.
    sections : sequence of Section
    figures : dict
        What ``--json`` prints.
    """

    lead: str
    sections: Sequence[Section]
    figures: dict[str, Any]

    @property
    def tables(self) -> list[Table]:
        """Of all sections, in order."""
        return [table for section in self.sections for table in section.tables]
