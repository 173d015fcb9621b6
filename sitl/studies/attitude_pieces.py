"""An attitude study as pieces of long work: the best gains, a run for each seed, the report."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from mimopilot.common.long_work import Piece
from mimopilot.sitl.studies.attitude_report import run_pictures, study_figures, study_sections
from mimopilot.sitl.studies.attitude_run import numbers, optimum, run
from mimopilot.sitl.studies.attitude_statistics import StudyStatistics
from mimopilot.sitl.studies.attitude_study import AttitudeStudy
from mimopilot.sitl.studies.report_part import ReportPart
from mimopilot.tuning.gains import gains_to_toml
from mimopilot.tuning.gains_file import gains_from_toml

#: The run with this seed is shown in the report.
SHOWN_SEED = 0
#: With fewer seeds a study is a first look: the best gains are searched less thoroughly; chosen.
THOROUGH_SEEDS = 10


def study_pieces(study: AttitudeStudy, seeds: int) -> list[Piece]:
    """The pieces of a study; the last one, of the study's name, is its part of the report.

    Parameters
    ----------
    study : AttitudeStudy
    seeds : int
        Experiments.
    """
    inputs = repr(study)
    thorough = seeds >= THOROUGH_SEEDS
    search = Piece(f"{study.name}-best", best_texts, (study, thorough), f"{inputs} thorough {thorough}")
    best = [] if study.fitted else [search]
    runs = [
        Piece(run_name(study, seed), run_once, (study, seed), f"{inputs} seed {seed}", tuple(p.name for p in best))
        for seed in range(seeds)
    ]
    return [*best, *runs, Piece(study.name, study_part, study, inputs, tuple(piece.name for piece in runs))]


def run_name(study: AttitudeStudy, seed: int) -> str:
    """Name of the piece of a run."""
    return f"{study.name}-{seed:04d}"


def best_texts(task: tuple[AttitudeStudy, bool]) -> dict[str, str]:
    """The best gains on the true plant: method -> text of its gains file; arguments as `optimum`."""
    return {method: gains_to_toml(gains) for method, gains in optimum(*task).items()}


def run_once(task: tuple[AttitudeStudy, int], best: Mapping[str, str] | None = None) -> dict[str, Any]:
    """One run.

    Parameters
    ----------
    task : (AttitudeStudy, int)
        The study, and the seed.
    best : mapping, optional
        See `best_texts`.

    Returns
    -------
    dict
        ``numbers``: see `sitl.studies.attitude_run.numbers`. ``pictures``: of the shown run, else empty.
    """
    study, seed = task
    found = run(study, seed, {method: gains_from_toml(text, method) for method, text in (best or {}).items()})
    return {"numbers": numbers(found), "pictures": run_pictures(study, found) if seed == SHOWN_SEED else {}}


def statistics(study: AttitudeStudy, runs: list[Any]) -> StudyStatistics:
    """The statistics of the results of `run_once`."""
    return StudyStatistics(study, [one["numbers"] for one in runs])


def study_part(study: AttitudeStudy, *runs: Any) -> dict[str, Any]:
    """A study's part of the report from all its runs, as JSON."""
    found = statistics(study, list(runs))
    return ReportPart("", study_sections(found, runs[SHOWN_SEED]["pictures"]), study_figures(found)).as_json()
