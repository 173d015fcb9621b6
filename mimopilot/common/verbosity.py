"""How much the command line says on standard error; results and errors are always shown."""

from __future__ import annotations

import sys
from collections.abc import Iterable
from enum import IntEnum
from pathlib import Path


class Verbosity(IntEnum):
    """What is shown besides results and errors."""

    QUIET = 0  # nothing
    NORMAL = 1  # warnings and progress
    VERBOSE = 2  # each step with its time, too


_level = Verbosity.NORMAL


def set_verbosity(level: Verbosity) -> None:
    """Choose the verbosity of this process."""
    global _level
    _level = level


def verbosity() -> Verbosity:
    """The chosen verbosity."""
    return _level


def warn(where: Path | str, warnings: Iterable[str]) -> None:
    """Warnings about a file, a line each, on standard error; none with ``--quiet``."""
    if _level is not Verbosity.QUIET:
        for warning in warnings:
            print(f"mimopilot: warning: {where}: {warning}", file=sys.stderr, flush=True)
