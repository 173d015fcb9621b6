"""`mimopilot reproduce`: the thesis' tables and figures computed again, in one report."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from mimopilot.common.extras import REPORT
from mimopilot.common.files import inside
from mimopilot.common.html_report import Section, write_report
from mimopilot.common.long_work import Piece, run_pieces
from mimopilot.common.parallel import cores
from mimopilot.sitl.studies.attitude_figures import OF_ALL_RUNS
from mimopilot.sitl.studies.attitude_pieces import run_name, statistics, study_pieces
from mimopilot.sitl.studies.attitude_report import COMPARABILITY
from mimopilot.sitl.studies.attitude_statistics import StudyStatistics
from mimopilot.sitl.studies.attitude_study import studies
from mimopilot.sitl.studies.benchmark_studies import study_lv100, study_numerical_example
from mimopilot.sitl.studies.expectations import expectations, expectations_table
from mimopilot.sitl.studies.printed_figures import summary_table
from mimopilot.sitl.studies.report_part import ReportPart
from mimopilot.sitl.studies.reproduction import Reproduction

#: Noise seeds of the attitude studies; the expectations apply to the medians over them.
SEEDS = 50
BENCHMARKS: dict[str, Callable[[], ReportPart]] = {"numerical-example": study_numerical_example, "lv100": study_lv100}
STUDIES = (*BENCHMARKS, *studies())
ALL = "all"

SAME_MODEL = (
    "J_M,o is against the attitude model of MIMO's design for all methods: the flown gains are compared with a model "
    "that they were not made for. The doublets of adam0-sim and adam0 saturate the motors; adam0-small is the vehicle "
    "of adam0-sim with one that does not."
)

ELSEWHERE = (
    "The flights of a study are shown on its own page, in the file beside this one that has its name: one page of 6 MB "
    "does not hold all of them."
)

PRINTED = (
    "On airframes that are fitted to the printed gains: how many of the printed gains have the printed sign, and how "
    "many are within 15 % or equal when rounded (medians over the seeds), and the main result of the real flights, "
    "J_M,o of MIMO over SISO's: printed, with the gains tuned here, and with the printed gains flown here. Each method "
    "is compared with the reference model that it was tuned for."
)


def reproduce(name: str, out: Path, seeds: int = SEEDS, workers: int | None = None) -> Reproduction:
    """Run one study, or all, and write one report.

    Each finished run is kept in the folder, and each finished study gets its own report at once: the same call goes on
    where it was interrupted.

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

    Raises
    ------
    Error
        When the folder is in use, a vehicle was lost, or plotly is not installed; exit code 130 after Ctrl-C.
    """
    REPORT.need()
    chosen = STUDIES if name == ALL else (name,)
    for study in {name, *chosen}:
        inside(out, f"{study}.html")
    known = studies()
    pieces = []
    for study in chosen:
        pieces += [Piece(study, _benchmark, study, study)] if study in BENCHMARKS else study_pieces(known[study], seeds)
    results: dict[str, Any] = {}

    def kept(piece: str, result: Any) -> None:
        results[piece] = result
        if name == ALL and piece in STUDIES:
            _write(out, piece, _parts([piece], results, seeds))

    run_pieces(pieces, out, workers or cores(), f"mimopilot reproduce {name}", kept)
    return _write(out, name, _parts(chosen, results, seeds))


def _benchmark(name: str) -> dict[str, Any]:
    return BENCHMARKS[name]().as_json()


def _parts(chosen: Sequence[str], results: Mapping[str, Any], seeds: int) -> dict[str, ReportPart]:
    """The parts of a report: benchmarks, the expectations of the attitude studies, and these studies."""
    known = studies()
    own = {study: ReportPart.from_json(results[study]) for study in chosen}
    if len(chosen) > 1:
        own = {study: _without_flights(study, part) if study in known else part for study, part in own.items()}
    found = [
        statistics(known[study], [results[run_name(known[study], seed)] for seed in range(seeds)])
        for study in chosen
        if study in known
    ]
    before = {"expectations": _overview(found, seeds, ELSEWHERE if len(chosen) > 1 else "")} if found else {}
    return {
        **{study: part for study, part in own.items() if study not in known},
        **before,
        **{study: part for study, part in own.items() if study in known},
    }


def _without_flights(study: str, part: ReportPart) -> ReportPart:
    """A study's part for a page of several studies: with the figures of all runs, without those of one."""
    kept = {f"{study}-{name}" for name in OF_ALL_RUNS}
    sections = [replace(one, charts=[chart for chart in one.charts if chart.name in kept]) for one in part.sections]
    return replace(part, sections=sections)


def _overview(found: Sequence[StudyStatistics], seeds: int, note: str) -> ReportPart:
    """The expectations, how the printed figures come out, and a note on the page."""
    rows = expectations([one for one in found if not one.study.fitted])
    fitted = [one for one in found if one.study.fitted]
    sections = []
    if rows:
        text = f"Medians over {seeds} seeds. {SAME_MODEL}"
        sections.append(Section("Expectations", text, [expectations_table(rows)]))
    if fitted:
        sections.append(Section("Printed figures", PRINTED, [summary_table(fitted)]))
    lead = (
        "Each vehicle flies an experiment in simulation, is tuned from it by every method, and flies doublets. Its "
        f"constants are class values, or fitted to the printed gains. {COMPARABILITY} {note}"
    ).rstrip()
    table = [{**asdict(row), "met": row.met} for row in rows]
    return ReportPart(lead, sections, {"seeds": seeds, "rows": table})


def _write(out: Path, name: str, parts: Mapping[str, ReportPart]) -> Reproduction:
    """Write the report of some parts."""
    report = inside(out, f"{name}.html")
    lead = " ".join(part.lead for part in parts.values() if part.lead)
    sections = [section for part in parts.values() for section in part.sections]
    write_report(report, f"mimopilot reproduce {name}", lead, sections)
    tables = tuple(table for section in sections for table in section.tables)
    return Reproduction({study: part.figures for study, part in parts.items()}, tables, report)
