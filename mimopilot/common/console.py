"""Output of all commands: tables, one JSON object, progress bars."""

from __future__ import annotations

import json
import math
import os
import shutil
import sys
import textwrap
from collections.abc import Mapping, Sequence
from typing import Any

from mimopilot.common.text_table import RULE, folded, text_table
from mimopilot.common.verbosity import Verbosity, verbosity


def print_json(value: Mapping[str, Any]) -> None:
    """Print one JSON object on standard output; a number that is not finite becomes null, and a zero has no sign."""
    print(json_text(value), end="")


def json_text(value: Mapping[str, Any]) -> str:
    """The text that `print_json` prints."""
    return json.dumps(_finite(value), indent=2) + "\n"


def _finite(value: Any) -> Any:
    if isinstance(value, float):
        return value + 0.0 if math.isfinite(value) else None  # a zero has no sign
    if isinstance(value, Mapping):
        return {str(key): _finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    return value


def print_table(title: str, columns: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """Print a table on standard output, folded to the terminal's width; piped, each row is one line."""
    width = _width()
    lines = [part for line in title.splitlines() for part in textwrap.wrap(line, width or len(line) + 1)]
    text = "\n".join([*lines, "", *text_table(columns, rows, width), ""])
    # A terminal of another encoding has no line to draw.
    encoding = sys.stdout.encoding or "utf-8"
    print(text if encoding.lower().replace("-", "") == "utf8" else text.replace(RULE, "-"))


def print_text(text: str) -> None:
    """Print prose on standard output, folded to the terminal's width; piped, each of its lines is one line."""
    print("\n".join(folded(text, _width())))


def _width() -> int | None:
    """Columns of the terminal; None if standard output is none and COLUMNS does not say."""
    if not (sys.stdout.isatty() or os.environ.get("COLUMNS", "").isdecimal()):
        return None
    return max(shutil.get_terminal_size().columns, 20)


def progress_console() -> Any:
    """Console for progress bars: standard error, silent unless it is a terminal, and with ``--quiet``."""
    from rich.console import Console

    return Console(stderr=True, quiet=not sys.stderr.isatty() or verbosity() is Verbosity.QUIET)
