"""Many runs of the attitude studies on all cores; the results do not depend on the number of processes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mimopilot.common.console import progress_console
from mimopilot.common.parallel import cores, processes, run_all
from mimopilot.sitl.studies.attitude_run import AttitudeRun, numbers, optimum, run
from mimopilot.sitl.studies.attitude_study import AttitudeStudy
from mimopilot.tuning.gains import Gains


@dataclass(frozen=True, eq=False)
class StudyStatistics:
    """The runs of a study and their statistics.

    Attributes
    ----------
    study : AttitudeStudy
    shown : AttitudeRun
        Run with seed 0, for the plots.
    runs : list of dict
        `numbers` of every seed, in order.
    """

    study: AttitudeStudy
    shown: AttitudeRun
    runs: list[dict[str, Any]]

    def values(self, method: str, axis: str, figure: str) -> NDArray[np.float64]:
        """One figure of `Performance` over the seeds, (seeds,)."""
        return np.array([run[method][axis][figure] for run in self.runs], dtype=np.float64)

    def median(self, method: str, axis: str, figure: str) -> float:
        """The median of `values`."""
        return float(np.median(self.values(method, axis, figure)))

    def gains(self, method: str, matrix: str) -> NDArray[np.float64]:
        """A matrix over the seeds, (seeds, 2, 2)."""
        return np.array([run[method]["gains"][matrix] for run in self.runs], dtype=np.float64)

    def verdicts(self, method: str) -> dict[str, int]:
        """Certificate's verdict -> number of seeds."""
        found = [run[method]["verdict"] for run in self.runs]
        return {verdict: found.count(verdict) for verdict in sorted(set(found))}


def run_once(task: tuple[AttitudeStudy, int, dict[str, Gains]]) -> tuple[AttitudeRun, dict[str, Any]]:
    """One run of a study with a seed and the best gain sets, and its `numbers`."""
    found = run(*task)
    return found, numbers(found)


def _counted(task: tuple[AttitudeStudy, int, dict[str, Gains]]) -> tuple[AttitudeRun | None, dict[str, Any]]:
    """`run_once`, which returns flights for seed 0 only: other flights are not shown and slow to transfer."""
    found, counted = run_once(task)
    return (found if task[1] == 0 else None), counted


def run_studies(chosen: Sequence[AttitudeStudy], seeds: int, workers: int | None = None) -> list[StudyStatistics]:
    """Run every study with every seed.

    Parameters
    ----------
    chosen : sequence of AttitudeStudy
    seeds : int
        Experiments per study.
    workers : int, optional
        Processes; by default one per core.
    """
    from rich.progress import Progress

    count = workers or cores()
    best: dict[str, dict[str, Gains]] = {}
    runs: dict[tuple[str, int], tuple[AttitudeRun | None, dict[str, Any]]] = {}
    with processes(count) as pool, Progress(console=progress_console(), transient=True) as bar:
        shown = bar.add_task("experiments", total=len(chosen) * (seeds + 1))

        def keep_best(study: AttitudeStudy, sets: dict[str, Gains]) -> None:
            best[study.name] = sets
            bar.advance(shown)

        def keep_run(task: tuple[AttitudeStudy, int, Any], found: tuple[AttitudeRun | None, dict[str, Any]]) -> None:
            runs[task[0].name, task[1]] = found
            bar.advance(shown)

        run_all(pool, 2 * count, optimum, chosen, keep_best)
        tasks = [(study, seed, best[study.name]) for study in chosen for seed in range(seeds)]
        run_all(pool, 2 * count, _counted, tasks, keep_run)
    results = []
    for study in chosen:
        first = runs[study.name, 0][0]
        assert first is not None
        results.append(StudyStatistics(study, first, [runs[study.name, seed][1] for seed in range(seeds)]))
    return results
