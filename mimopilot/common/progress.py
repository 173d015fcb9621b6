"""Progress on standard error.

Long work: a bar on a terminal, else a line at once and every minute. A step without a known length: a sign on a
terminal while it lasts; with ``--verbose`` a line with its time.
"""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from mimopilot.common.verbosity import Verbosity, verbosity

#: s between two lines when standard error is not a terminal.
INTERVAL_S = 60.0


@contextmanager
def progress(what: str, total: int, done: int = 0) -> Iterator[Callable[[], None]]:
    """Show how much of a number of tasks is done.

    Parameters
    ----------
    what : str
        The work, as the beginning of each line.
    total, done : int
        Number of tasks, and of those that were done before.

    Yields
    ------
    callable
        To be called after each task.
    """
    if verbosity() is Verbosity.QUIET:
        yield lambda: None
        return
    if sys.stderr.isatty():
        from rich.console import Console
        from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

        columns = (TextColumn(what), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
        with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
            task = bar.add_task("", total=total, completed=done)
            yield lambda: bar.advance(task)
        return
    begin, finished, ended = time.monotonic(), done, threading.Event()

    def line() -> None:
        seconds = time.monotonic() - begin
        print(f"{what}: {finished} of {total} done, {seconds:.0f} s", file=sys.stderr, flush=True)

    def every_interval() -> None:
        while not ended.wait(INTERVAL_S):
            line()

    def advance() -> None:
        nonlocal finished
        finished += 1

    line()
    threading.Thread(target=every_interval, daemon=True).start()
    try:
        yield advance
    finally:
        ended.set()


@contextmanager
def step(what: str) -> Iterator[None]:
    """Show what is being done while it lasts; steps do not nest.

    Parameters
    ----------
    what : str
        The work, as "reading flight.ulg".
    """
    begin = time.monotonic()
    if verbosity() is Verbosity.NORMAL and sys.stderr.isatty():
        from rich.console import Console
        from rich.markup import escape

        with Console(stderr=True).status(escape(what)):
            yield
    else:
        yield
    if verbosity() is Verbosity.VERBOSE:
        print(f"mimopilot: {what}: {time.monotonic() - begin:.2f} s", file=sys.stderr, flush=True)
