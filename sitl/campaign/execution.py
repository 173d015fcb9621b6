"""Execution of a campaign: workers fly chunks of runs into part files, which are merged; resumes after a stop."""

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

from mimopilot.common.console import progress_console
from mimopilot.common.extras import CLUSTER
from mimopilot.common.files import inside
from mimopilot.common.parallel import processes, run_all
from mimopilot.common.part_folder import RESUME, PartFolder, UnusablePartError, folder_lock
from mimopilot.sitl.campaign.flights import CHUNK, chunk_count, flight_runner, fly_chunk, label
from mimopilot.sitl.campaign.plan import LOCK, PARTS, REPORT, RESULTS, SUMMARY, CampaignPlan, write_plan_files
from mimopilot.sitl.errors import SitlError

ROW_GROUP = 1 << 14  # rows of a Parquet row group: a few MB in memory at a time


def run_campaign(plan: CampaignPlan, folder: Path, workers: int, scheduler: str | None = None) -> Path:
    """Fly all missing runs, and merge all runs into one table.

    Parameters
    ----------
    plan : CampaignPlan
        The campaign.
    folder : Path
        For its files and results; may hold the parts of an earlier, unfinished execution.
    workers : int
        Processes on this machine.
    scheduler : str, optional
        Address of a dask.distributed scheduler; its workers are used instead of local processes.

    Returns
    -------
    Path
        The results: one Parquet file. Its bytes do not depend on the workers or on interruptions.

    Raises
    ------
    Error
        When the folder holds another campaign or is in use, the execution was interrupted, or workers were lost.
    OSError
        When a file would be written through a symbolic link, or cannot be written.
    """
    for name in (RESULTS, PARTS, SUMMARY, REPORT, *plan.files):
        inside(folder, name)
    results, parts = folder / RESULTS, PartFolder(folder / PARTS, "campaign")
    if not results.is_file():  # compile before forking; find bad input before writing into the folder
        list(flight_runner(tuple(plan.files.items())).flights(0))
    with folder_lock(folder, LOCK, "campaign"):
        write_plan_files(plan, folder)
        if not results.is_file():
            missing = [int(name) for name in parts.missing(_label_of(plan, i) for i in range(chunk_count(plan)))]
            if missing:
                _fly_chunks(plan, parts, missing, workers, scheduler)
            try:
                _merge_parts(plan, parts, results)
            except UnusablePartError as error:  # changed since it was checked
                raise SitlError(f"{parts.folder}: {error}; {RESUME}", exit_code=1) from error
        shutil.rmtree(parts.folder, ignore_errors=True)
    return results


def _label_of(plan: CampaignPlan, chunk: int) -> tuple[str, str]:
    """Name of a chunk's part, and its label."""
    return f"{chunk:07d}", label(plan, chunk)


def _fly_chunks(plan: CampaignPlan, parts: PartFolder, missing: list[int], workers: int, scheduler: str | None) -> None:
    flights = len(plan.gains) * len(plan.scenarios)
    flown = chunk_count(plan) - len(missing)
    with _executor(workers, scheduler) as (executor, ahead), _progress(plan, flown) as advance:

        def keep(chunk: int, part: bytes) -> None:
            nonlocal flown
            parts.write(_label_of(plan, chunk)[0], part)
            flown += 1
            advance(min(CHUNK, plan.description.runs - chunk * CHUNK) * flights)

        try:
            run_all(executor, ahead, partial(fly_chunk, plan.files), missing, keep)
        except KeyboardInterrupt:
            runs = min(flown * CHUNK, plan.description.runs)
            raise SitlError(
                f"interrupted after {runs} of {plan.description.runs} runs; {RESUME}", exit_code=130
            ) from None
        except BrokenProcessPool:
            raise SitlError(f"a worker process was killed, perhaps for lack of memory; {RESUME}", exit_code=1) from None


@contextmanager
def _executor(workers: int, scheduler: str | None) -> Iterator[tuple[Executor, int]]:
    """The executor, and the number of chunks to queue in it."""
    if scheduler is None:
        with processes(workers) as executor:
            yield executor, 2 * workers
        return
    CLUSTER.need()
    from distributed import Client, KilledWorker
    from distributed.comm import CommClosedError

    try:
        client = Client(scheduler, timeout=5)
    except (OSError, ValueError) as error:
        raise SitlError(
            f"--scheduler {scheduler}: no scheduler answers ({error}); check the address", exit_code=1
        ) from error
    with client:
        threads = sum(client.ncores().values())
        if not threads:
            raise SitlError(f"--scheduler {scheduler}: it has no workers; start some with dask worker", exit_code=1)
        try:
            yield client.get_executor(pure=False), 2 * threads
        except (KilledWorker, CancelledError, CommClosedError) as error:
            raise SitlError(f"--scheduler {scheduler}: the cluster failed ({error}); {RESUME}", exit_code=1) from error


@contextmanager
def _progress(plan: CampaignPlan, flown: int) -> Iterator[Callable[[int], Any]]:
    """A progress bar on a terminal; yields a function that advances it by a number of flights."""
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    per_run = len(plan.gains) * len(plan.scenarios)
    columns = (
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("flights, {task.fields[rate]}/s, left"),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=progress_console(), transient=True) as bar:
        task = bar.add_task("", total=plan.description.runs * per_run, completed=flown * CHUNK * per_run, rate="-")

        def advance(flights: int) -> None:
            speed = bar.tasks[0].speed
            bar.update(task, advance=flights, rate="-" if speed is None else f"{speed:.0f}")

        yield advance


def _table(plan: CampaignPlan, parts: PartFolder, chunk: int) -> pa.BufferReader:
    """The table in a chunk's part."""
    return pa.BufferReader(parts.read(*_label_of(plan, chunk)))


def _merge_parts(plan: CampaignPlan, parts: PartFolder, results: Path) -> None:
    """Merge all parts into one file, in order, with one row group in memory at a time."""
    whole, count = inside(parts.folder, RESULTS), chunk_count(plan)
    begin = pq.read_table(_table(plan, parts, 0))
    schema, per_group = begin.schema, max(1, ROW_GROUP // begin.num_rows)
    with pq.ParquetWriter(whole, schema, compression="zstd", write_page_checksum=True) as writer:
        for first in range(0, count, per_group):
            chosen = range(first, min(first + per_group, count))
            tables = [pq.read_table(_table(plan, parts, chunk), schema=schema) for chunk in chosen]
            writer.write_table(pa.concat_tables(tables).unify_dictionaries().combine_chunks())
    with whole.open("rb") as stream:
        os.fsync(stream.fileno())
    whole.replace(results)
