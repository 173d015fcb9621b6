"""`mimopilot reproduce`: the thesis' tables and figures computed again, one report."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from mimopilot.sitl.studies.attitude import studies
from mimopilot.sitl.studies.attitude_report import IN_KIND, study_figures, study_sections
from mimopilot.sitl.studies.attitude_runs import StudyStatistics, run_studies
from mimopilot.sitl.studies.benchmark_studies import study_lv100, study_numerical_example
from mimopilot.sitl.studies.expectations import expectations, expectations_table
from mimopilot.sitl.studies.report_part import ReportPart

from mimopilot.common.console import print_table
from mimopilot.common.files import inside
from mimopilot.common.html_report import Section, Table, write_report

#: Noise seeds of the attitude studies: what is expected is expected of their medians.
SEEDS = 50
BENCHMARKS: dict[str, Callable[[], ReportPart]] = {"numerical-example": study_numerical_example, "lv100": study_lv100}
STUDIES = (*BENCHMARKS, *studies())
ALL = "all"

UNMET = (
    "Where J_M,o misses the best possible, the doublet drives the motors to their limits (coupled, adam0-sim, adam0). "
    "A rotor's lag acts on its speed, thrust goes with the square: at the limits moments come faster than in the small "
    "motions of the log, so a model from that log overrates the effort of brisk gains and asks for less than is "
    "allowed. adam0-small is the same vehicle with a doublet that stays away from the limits."
)


@dataclass(frozen=True)
class Reproduction:
    """What was computed: the object that ``--json`` prints, the tables, and the report."""

    figures: dict[str, Any]
    tables: tuple[Table, ...]
    report: Path

    def as_json(self) -> dict[str, Any]:
        """The object that ``--json`` prints."""
        return {**self.figures, "report": str(self.report)}


def reproduce(name: str, out: Path, seeds: int = SEEDS, workers: int | None = None) -> Reproduction:
    """One study, or all of them, into one report.

    Parameters
    ----------
    name : str
        One of `STUDIES`, or ``all``.
    out : Path
        Folder of the report, NAME.html.
    seeds : int
        Experiments of each attitude study.
    workers : int, optional
        Processes; by default one a core. The result does not depend on it.
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
    """Expectations of all, then every study."""
    rows = expectations(found)
    section = Section("Expectations", f"Ratios of medians over {seeds} seeds. {UNMET}", [expectations_table(rows)])
    lead = (
        "Each vehicle flies an experiment on the bench, is tuned from it by every method, and flies doublets. Its "
        f"constants are class values. {IN_KIND}"
    )
    table = [{**asdict(row), "met": {method: row.met(method) for method in row.ratios}} for row in rows]
    studied = {one.study.name: ReportPart("", study_sections(one), study_figures(one)) for one in found}
    return {"expectations": ReportPart(lead, [section], {"seeds": seeds, "rows": table}), **studied}


def print_reproduction(found: Reproduction) -> None:
    """The tables, and where the report is."""
    for table in found.tables:
        print_table(table.caption, table.columns, table.rows)
    print(f"report  {found.report}")
