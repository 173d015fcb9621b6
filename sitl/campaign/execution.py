"""Flying a campaign: chunks to workers, parts to disk, parts to one table; begun again where it was left."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Iterator
from concurrent.futures import CancelledError, Executor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from sitl.campaign.flights import CHUNK, chunks, fly_chunk, stand_of
from sitl.campaign.plan import PARTS, RESULTS, Plan, settle
from sitl.errors import SitlError
from tuning.files import write_atomically
from tuning.output import progress_console
from tuning.parallel import processes, run_all

ROW_GROUP = 1 << 14  # rows: what is in memory at a time
AGAIN = "give the same command again to go on"


def run_campaign(plan: Plan, folder: Path, workers: int, scheduler: str | None = None) -> Path:
    """Fly all runs that are not flown yet, and merge them into one table.

    Parameters
    ----------
    plan : Plan
        What to fly.
    folder : Path
        Where its files and its results go; may hold a part of them from before.
    workers : int
        Processes on this machine.
    scheduler : str, optional
        Address of a dask.distributed scheduler, whose workers are then used instead.

    Returns
    -------
    Path
        The results: one Parquet file, the same bytes whatever the workers and however often it was begun.

    Raises
    ------
    SitlError
        When the folder holds another campaign, when it was interrupted, or when workers are lost.
    """
    results, parts = folder / RESULTS, folder / PARTS
    if not results.is_file():  # compiles before workers are forked, and finds what is wrong before the folder is taken
        list(stand_of(tuple(plan.files.items())).flights(0))
    settle(plan, folder)
    if not results.is_file():
        parts.mkdir(exist_ok=True)
        missing = [chunk for chunk in range(chunks(plan)) if not _part(parts, chunk).is_file()]
        if missing:
            _fly(plan, parts, missing, workers, scheduler)
        _merge(parts, chunks(plan), results)
    shutil.rmtree(parts, ignore_errors=True)
    return results


def _part(parts: Path, chunk: int) -> Path:
    return parts / f"{chunk:07d}.parquet"


def _fly(plan: Plan, parts: Path, missing: list[int], workers: int, scheduler: str | None) -> None:
    flights = len(plan.gains) * len(plan.scenarios)
    flown = chunks(plan) - len(missing)
    with _executor(workers, scheduler) as (executor, ahead), _progress(plan, flown) as advance:

        def keep(chunk: int, part: bytes) -> None:
            nonlocal flown
            write_atomically(_part(parts, chunk), part)
            flown += 1
            advance(min(CHUNK, plan.description.runs - chunk * CHUNK) * flights)

        try:
            run_all(executor, ahead, partial(fly_chunk, plan.files), missing, keep)
        except KeyboardInterrupt:
            runs = min(flown * CHUNK, plan.description.runs)
            raise SitlError(f"ended after {runs} of {plan.description.runs} runs; {AGAIN}", exit_code=130) from None
        except BrokenProcessPool:
            raise SitlError(f"a worker process was killed, out of memory perhaps; {AGAIN}", exit_code=1) from None


@contextmanager
def _executor(workers: int, scheduler: str | None) -> Iterator[tuple[Executor, int]]:
    """Where to fly, and how many chunks to hand over at a time."""
    if scheduler is None:
        with processes(workers) as executor:
            yield executor, 2 * workers
        return
    try:
        from distributed import Client, KilledWorker
        from distributed.comm import CommClosedError
    except ImportError:
        raise SitlError("--scheduler needs dask: pip install 'mimopilot[cluster]'") from None
    try:
        client = Client(scheduler, timeout=5)
    except (OSError, ValueError) as error:
        raise SitlError(f"--scheduler {scheduler}: no scheduler answers there ({error})", exit_code=1) from error
    with client:
        threads = sum(client.ncores().values())
        if not threads:
            raise SitlError(f"--scheduler {scheduler}: it has no workers; start some with dask worker", exit_code=1)
        try:
            yield client.get_executor(pure=False), 2 * threads
        except (KilledWorker, CancelledError, CommClosedError) as error:
            raise SitlError(f"--scheduler {scheduler}: the cluster failed ({error}); {AGAIN}", exit_code=1) from error


@contextmanager
def _progress(plan: Plan, flown: int) -> Iterator[Callable[[int], Any]]:
    """A bar with the rate and the time left, on a terminal; yields what advances it by so many flights."""
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    a_run = len(plan.gains) * len(plan.scenarios)
    columns = (
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("flights, {task.fields[rate]}/s, left"),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=progress_console(), transient=True) as bar:
        task = bar.add_task("", total=plan.description.runs * a_run, completed=flown * CHUNK * a_run, rate="-")

        def advance(flights: int) -> None:
            speed = bar.tasks[0].speed
            bar.update(task, advance=flights, rate="-" if speed is None else f"{speed:.0f}")

        yield advance


def _merge(parts: Path, count: int, results: Path) -> None:
    """All parts as one file, in order; only one row group is in memory at a time."""
    whole = parts / RESULTS
    schema = pq.read_schema(_part(parts, 0))
    with pq.ParquetWriter(whole, schema, compression="zstd") as writer:
        a_group = max(1, ROW_GROUP // pq.read_metadata(_part(parts, 0)).num_rows)
        for first in range(0, count, a_group):
            tables = [pq.read_table(_part(parts, i), schema=schema) for i in range(first, min(first + a_group, count))]
            writer.write_table(pa.concat_tables(tables).unify_dictionaries().combine_chunks())
    with whole.open("rb") as stream:
        os.fsync(stream.fileno())
    whole.replace(results)
