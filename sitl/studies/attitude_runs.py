"""Many experiments of the attitude studies on all cores: run k is the same whatever the number of processes."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing import get_context
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sitl.studies.attitude import Run, Study, numbers, optimum, run
from tuning.gains import Gains
from tuning.output import progress_console

#: One thread each: the processes share the cores, and sums do not depend on how many there are.
THREADS = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")


@dataclass(frozen=True, eq=False)
class Statistics:
    """What the runs of a study say.

    Attributes
    ----------
    study : Study
    shown : Run
        That of seed 0, for the figures.
    runs : list of dict
        `numbers` of every seed, in order.
    """

    study: Study
    shown: Run
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


@contextmanager
def processes(workers: int) -> Iterator[ProcessPoolExecutor]:
    """A pool of fresh processes that compute with one thread each."""
    before = {name: os.environ.get(name) for name in THREADS}
    os.environ.update(dict.fromkeys(THREADS, "1"))
    try:
        with ProcessPoolExecutor(workers, get_context("spawn")) as pool:
            try:
                yield pool
            except BaseException:
                pool.shutdown(wait=False, cancel_futures=True)  # what is waiting would keep the message back
                raise
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def _shown(study: Study, best: dict[str, Gains]) -> tuple[Run, dict[str, Any]]:
    found = run(study, 0, best)
    return found, numbers(found)


def run_once(study: Study, seed: int, best: dict[str, Gains]) -> dict[str, Any]:
    """`numbers` of one run."""
    return numbers(run(study, seed, best))


def run_studies(chosen: Sequence[Study], seeds: int, workers: int | None = None) -> list[Statistics]:
    """Every study with every seed.

    Parameters
    ----------
    chosen : sequence of Study
    seeds : int
        Experiments a study.
    workers : int, optional
        Processes; by default one a core.
    """
    from rich.progress import Progress

    with (
        processes(workers or os.cpu_count() or 1) as pool,
        Progress(console=progress_console(), transient=True) as bar,
    ):
        task = bar.add_task("experiments", total=len(chosen) * (seeds + 1))

        def counted(futures: Sequence[Future[Any]]) -> list[Any]:
            for future in as_completed(futures):
                future.result()
                bar.advance(task)
            return [future.result() for future in futures]

        best = counted([pool.submit(optimum, study) for study in chosen])
        first = [pool.submit(_shown, *pair) for pair in zip(chosen, best, strict=True)]
        others = [
            [pool.submit(run_once, study, seed, sets) for seed in range(1, seeds)]
            for study, sets in zip(chosen, best, strict=True)
        ]
        return [
            Statistics(study, shown, [zeroth, *counted(rest)])
            for study, (shown, zeroth), rest in zip(chosen, counted(first), others, strict=True)
        ]
