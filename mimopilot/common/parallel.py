"""Many independent tasks on all cores of this machine, or on a cluster."""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Executor, Future, ProcessPoolExecutor, wait
from contextlib import contextmanager
from typing import Any, TypeVar

Argument = TypeVar("Argument")
Result = TypeVar("Result")


def cores() -> int:
    """Processors that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@contextmanager
def processes(count: int) -> Iterator[Executor]:
    """Worker processes that end with this one, however it ends, and leave Ctrl-C to it.

    On Linux they are forked: what is loaded and compiled here is at hand there.

    Parameters
    ----------
    count : int
        How many.
    """
    context = multiprocessing.get_context("fork" if sys.platform == "linux" else "spawn")
    with ProcessPoolExecutor(count, context, initializer=_follow_parent) as executor:
        executor.submit(int).result()  # forks them now, before a progress bar has threads
        yield executor


def _follow_parent() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = multiprocessing.parent_process()
    assert parent is not None

    def end_with_it() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=end_with_it, daemon=True).start()


def run_all(
    executor: Executor,
    ahead: int,
    function: Callable[..., Result],
    arguments: Iterable[Argument],
    done: Callable[[Argument, Result], Any],
) -> None:
    """Call a function for each argument on an executor's workers, in any order.

    At a `KeyboardInterrupt` no more are begun, and those under way are waited for and counted.

    Parameters
    ----------
    executor : Executor
        Where.
    ahead : int
        How many are handed over at a time: memory is bounded by it.
    function : callable
        Of one argument.
    arguments : iterable
    done : callable
        Called here with each argument and its result.

    Raises
    ------
    Exception
        What a call raised; BrokenProcessPool when a worker process was killed.
    """
    source = iter(arguments)
    waiting: dict[Future[Result], Argument] = {}

    def collect(finished: Iterable[Future[Result]]) -> None:
        for future in finished:
            done(waiting.pop(future), future.result())

    try:
        for argument in source:
            waiting[executor.submit(function, argument)] = argument
            if len(waiting) >= ahead:
                collect(wait(waiting, return_when=FIRST_COMPLETED).done)
        while waiting:
            collect(wait(waiting, return_when=FIRST_COMPLETED).done)
    except KeyboardInterrupt:
        for future in list(waiting):
            if future.cancel():
                del waiting[future]
        collect(wait(waiting).done)
        raise
