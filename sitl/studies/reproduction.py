"""Result of `mimopilot reproduce`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mimopilot.common.console import print_table
from mimopilot.common.html_report import ReportTable


@dataclass(frozen=True)
class Reproduction:
    """Result of a reproduction: figures for ``--json``, tables, and the path of the report."""

    figures: dict[str, Any]
    tables: tuple[ReportTable, ...]
    report: Path

    def as_json(self) -> dict[str, Any]:
        """The object that ``--json`` prints."""
        return {**self.figures, "report": str(self.report)}


def print_reproduction(found: Reproduction) -> None:
    """Print the tables and the path of the report."""
    for table in found.tables:
        print_table(table.caption, table.columns, table.rows)
    print(f"report  {found.report}")
