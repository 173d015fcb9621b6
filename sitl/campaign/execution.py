"""Flying a campaign: chunks to workers, parts to disk, parts to one table; begun again where it was left."""

from __future__ import annotations

import fcntl
import os
import shutil
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import CancelledError, Executor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
from mimopilot.sitl.campaign.flights import CHUNK, chunks, flight_runner, fly_chunk, label
from mimopilot.sitl.campaign.plan import LOCK, PARTS, REPORT, RESULTS, SUMMARY, CampaignPlan, write_plan_files
from mimopilot.sitl.errors import SitlError

from mimopilot.common.console import progress_console
from mimopilot.common.files import inside, unseal, write_atomically
from mimopilot.common.parallel import processes, run_all

ROW_GROUP = 1 << 14  # rows: what is in memory at a time
SHOWN = 3  # parts that one message names
AGAIN = "give the same command again to go on"


def run_campaign(plan: CampaignPlan, folder: Path, workers: int, scheduler: str | None = None) -> Path:
    """Fly all runs that are not flown yet, and merge them into one table.

    Parameters
    ----------
    plan : CampaignPlan
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
        When the folder holds another campaign, or one is being flown into it, when it was interrupted, or when
        workers are lost.
    OSError
        When a link lies where one of its files belongs, or a file cannot be written.
    """
    for name in (RESULTS, PARTS, SUMMARY, REPORT, *plan.files):
        inside(folder, name)
    results, parts = folder / RESULTS, folder / PARTS
    if not results.is_file():  # compiles before workers are forked, and finds what is wrong before the folder is taken
        list(flight_runner(tuple(plan.files.items())).flights(0))
    with _folder_lock(folder):
        write_plan_files(plan, folder)
        if not results.is_file():
            missing = _missing(plan, parts)
            if missing:
                _fly(plan, parts, missing, workers, scheduler)
            try:
                _merge(plan, parts, results)
            except _WrongPartError as error:  # whole a moment ago
                raise SitlError(f"{parts}: {error}; {AGAIN}", exit_code=1) from error
        shutil.rmtree(parts, ignore_errors=True)
    return results


@contextmanager
def _folder_lock(folder: Path) -> Iterator[None]:
    """Keep other campaigns out of a folder; the lock ends with this process, however that ends."""
    path = inside(folder, LOCK)
    folder.mkdir(parents=True, exist_ok=True)
    with path.open("ab") as stream:
        try:
            fcntl.lockf(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)  # of this process alone, not of the workers it forks
        except (BlockingIOError, PermissionError):
            raise SitlError(
                f"{folder}: another process is flying a campaign into it; wait until it ends, or give another --out"
            ) from None
        yield


def _part(parts: Path, chunk: int) -> Path:
    return inside(parts, f"{chunk:07d}.part")


def _missing(plan: CampaignPlan, parts: Path) -> list[int]:
    """Chunks that are to be flown: their parts are not there, or not what they should be, which is told."""
    missing, wrong = [], []
    for chunk in range(chunks(plan)):
        if not _part(parts, chunk).is_file():
            missing.append(chunk)
            continue
        try:
            _table(plan, parts, chunk)
        except _WrongPartError as error:
            missing.append(chunk)
            wrong.append(str(error))
    if wrong:
        more = f" and {len(wrong) - SHOWN} more" if len(wrong) > SHOWN else ""
        print(f"mimopilot: warning: {parts}: flown again: {'; '.join(wrong[:SHOWN])}{more}", file=sys.stderr)
    return missing


class _WrongPartError(SitlError):
    """A part that cannot be used."""


def _table(plan: CampaignPlan, parts: Path, chunk: int) -> pa.BufferReader:
    """The Parquet file in a part, checked: whole, of this campaign, and of the runs of its chunk."""
    path, wanted = _part(parts, chunk), label(plan, chunk)
    found = unseal(path.read_bytes())
    if found is None:
        raise _WrongPartError(f"{path.name} is damaged")
    table, is_of = found
    if is_of != wanted:
        campaign, _, runs = is_of.partition(" ")
        whose = f"is of {runs}" if wanted.startswith(campaign) else "is of another campaign"
        raise _WrongPartError(f"{path.name} {whose}")
    return pa.BufferReader(table)


def _fly(plan: CampaignPlan, parts: Path, missing: list[int], workers: int, scheduler: str | None) -> None:
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
def _progress(plan: CampaignPlan, flown: int) -> Iterator[Callable[[int], Any]]:
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


def _merge(plan: CampaignPlan, parts: Path, results: Path) -> None:
    """All parts as one file, in order; only one row group is in memory at a time."""
    whole, count = inside(parts, RESULTS), chunks(plan)
    begin = pq.read_table(_table(plan, parts, 0))
    schema, a_group = begin.schema, max(1, ROW_GROUP // begin.num_rows)
    with pq.ParquetWriter(whole, schema, compression="zstd", write_page_checksum=True) as writer:
        for first in range(0, count, a_group):
            chosen = range(first, min(first + a_group, count))
            tables = [pq.read_table(_table(plan, parts, chunk), schema=schema) for chunk in chosen]
            writer.write_table(pa.concat_tables(tables).unify_dictionaries().combine_chunks())
    with whole.open("rb") as stream:
        os.fsync(stream.fileno())
    whole.replace(results)
