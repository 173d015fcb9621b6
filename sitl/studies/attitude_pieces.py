"""An attitude study as pieces of long work: a run for each seed, the report."""

from __future__ import annotations

from typing import Any

from mimopilot.common.chart_json import chart_from_json, chart_to_json
from mimopilot.common.long_work import Piece
from mimopilot.sitl.studies.attitude_report import run_charts, study_figures, study_sections
from mimopilot.sitl.studies.attitude_run import numbers, run
from mimopilot.sitl.studies.attitude_statistics import StudyStatistics
from mimopilot.sitl.studies.attitude_study import AttitudeStudy
from mimopilot.sitl.studies.report_part import ReportPart

#: The run with this seed is shown in the report.
SHOWN_SEED = 0


def study_pieces(study: AttitudeStudy, seeds: int) -> list[Piece]:
    """The pieces of a study; the last one, of the study's name, is its part of the report.

    Parameters
    ----------
    study : AttitudeStudy
    seeds : int
        Experiments.
    """
    inputs = repr(study)
    runs = [Piece(run_name(study, seed), run_once, (study, seed), f"{inputs} seed {seed}") for seed in range(seeds)]
    return [*runs, Piece(study.name, study_part, study, inputs, tuple(piece.name for piece in runs))]


def run_name(study: AttitudeStudy, seed: int) -> str:
    """Name of the piece of a run."""
    return f"{study.name}-{seed:04d}"


def run_once(task: tuple[AttitudeStudy, int]) -> dict[str, Any]:
    """One run.

    Parameters
    ----------
    task : (AttitudeStudy, int)
        The study, and the seed.

    Returns
    -------
    dict
        ``numbers``: see `sitl.studies.attitude_run.numbers`. ``charts``: of the shown run, else empty.
    """
    study, seed = task
    found = run(study, seed)
    charts = run_charts(study, found) if seed == SHOWN_SEED else []
    return {"numbers": numbers(found), "charts": [chart_to_json(chart) for chart in charts]}


def statistics(study: AttitudeStudy, runs: list[Any]) -> StudyStatistics:
    """The statistics of the results of `run_once`."""
    return StudyStatistics(study, [one["numbers"] for one in runs])


def study_part(study: AttitudeStudy, *runs: Any) -> dict[str, Any]:
    """A study's part of the report from all its runs, as JSON."""
    found = statistics(study, list(runs))
    charts = [chart_from_json(chart) for chart in runs[SHOWN_SEED]["charts"]]
    return ReportPart("", study_sections(found, charts), study_figures(found)).as_json()
