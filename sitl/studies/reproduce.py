"""`mimopilot reproduce`: the thesis' tables and figures computed again, in one report."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from mimopilot.common.console import print_table
from mimopilot.common.files import inside
from mimopilot.common.html_report import ReportTable, Section, write_report
from mimopilot.sitl.studies.attitude_report import COMPARABILITY, study_figures, study_sections
from mimopilot.sitl.studies.attitude_statistics import StudyStatistics, run_studies
from mimopilot.sitl.studies.attitude_study import studies
from mimopilot.sitl.studies.benchmark_studies import study_lv100, study_numerical_example
from mimopilot.sitl.studies.expectations import expectations, expectations_table
from mimopilot.sitl.studies.report_part import ReportPart

#: Noise seeds of the attitude studies; the expectations apply to the medians over them.
SEEDS = 50
BENCHMARKS: dict[str, Callable[[], ReportPart]] = {"numerical-example": study_numerical_example, "lv100": study_lv100}
STUDIES = (*BENCHMARKS, *studies())
ALL = "all"

UNMET = (
    "J_M,o misses the expectation if the doublet saturates the motors (coupled, adam0-sim, adam0). Rotor lag acts on "
    "speed, and thrust is proportional to its square. So near the limits torque builds up faster than in the small "
    "motions of the log. A model from that log overestimates the effort of high gains, and the refinement uses less "
    "effort than allowed. adam0-small is the same vehicle with a doublet that does not saturate the motors."
)


@dataclass(frozen=True)
class Reproduction:
    """Result of `reproduce`: figures for ``--json``, tables, and the path of the report."""

    figures: dict[str, Any]
    tables: tuple[ReportTable, ...]
    report: Path

    def as_json(self) -> dict[str, Any]:
        """The object that ``--json`` prints."""
        return {**self.figures, "report": str(self.report)}


def reproduce(name: str, out: Path, seeds: int = SEEDS, workers: int | None = None) -> Reproduction:
    """Run one study, or all, and write one report.

    Parameters
    ----------
    name : str
        One of `STUDIES`, or ``all``.
    out : Path
        Folder of the report, NAME.html.
    seeds : int
        Experiments per attitude study.
    workers : int, optional
        Processes; by default one per core. The result does not depend on it.
    """
    report = inside(out, f"{name}.html")
    chosen = STUDIES if name == ALL else (name,)
    parts = {study: BENCHMARKS[study]() for study in chosen if study in BENCHMARKS}
    known = studies()
    flown = [known[study] for study in chosen if study in known]
    if flown:
        parts |= _attitude_parts(run_studies(flown, seeds, workers), seeds)
    lead = " ".join(part.lead for part in parts.values() if part.lead)
    sections = [section for part in parts.values() for section in part.sections]
    write_report(report, f"mimopilot reproduce {name}", lead, sections)
    tables = tuple(table for section in sections for table in section.tables)
    return Reproduction({study: part.figures for study, part in parts.items()}, tables, report)


def _attitude_parts(found: Sequence[StudyStatistics], seeds: int) -> dict[str, ReportPart]:
    """The expectations of all studies, then every study."""
    rows = expectations(found)
    section = Section("Expectations", f"Ratios of medians over {seeds} seeds. {UNMET}", [expectations_table(rows)])
    lead = (
        "Each vehicle flies an experiment in simulation, is tuned from it by every method, and flies doublets. Its "
        f"constants are class values. {COMPARABILITY}"
    )
    table = [{**asdict(row), "met": {method: row.met(method) for method in row.ratios}} for row in rows]
    studied = {one.study.name: ReportPart("", study_sections(one), study_figures(one)) for one in found}
    return {"expectations": ReportPart(lead, [section], {"seeds": seeds, "rows": table}), **studied}


def print_reproduction(found: Reproduction) -> None:
    """Print the tables and the path of the report."""
    for table in found.tables:
        print_table(table.caption, table.columns, table.rows)
    print(f"report  {found.report}")
