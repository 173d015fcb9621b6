"""Independent tasks on all cores of this machine, or on a cluster."""

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
    """Worker processes that end with this one, however it ends, and ignore Ctrl-C.

    On Linux they are forked, so loaded modules and compiled code are shared. If a `KeyboardInterrupt` leaves the
    block, they are killed: the caller decides which running calls are worth waiting for.

    Parameters
    ----------
    count : int
        Number of processes.
    """
    context = multiprocessing.get_context("fork" if sys.platform == "linux" else "spawn")
    others = multiprocessing.active_children()
    with ProcessPoolExecutor(count, context, initializer=_follow_parent) as executor:
        try:
            executor.submit(int).result()  # fork now, before a progress bar starts threads
            yield executor
        except KeyboardInterrupt:
            for worker in multiprocessing.active_children():
                if worker not in others:
                    worker.kill()
            raise


def _follow_parent() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = multiprocessing.parent_process()
    assert parent is not None

    def exit_after_parent() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=exit_after_parent, daemon=True).start()


def run_all(
    executor: Executor,
    ahead: int,
    function: Callable[..., Result],
    arguments: Iterable[Argument],
    done: Callable[[Argument, Result], Any],
) -> None:
    """Call a function for each argument on an executor's workers, in any order.

    After a `KeyboardInterrupt` no call is started; running calls are completed and passed to `done`.

    Parameters
    ----------
    executor : Executor
        Of the workers.
    ahead : int
        Largest number of submitted calls; bounds the memory.
    function : callable
        Of one argument.
    arguments : iterable
        One for each call.
    done : callable
        Called in this process with each argument and its result.

    Raises
    ------
    Exception
        Raised by a call; BrokenProcessPool if a worker process was killed.
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
