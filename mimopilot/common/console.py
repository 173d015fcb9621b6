"""Output of all commands: tables, one JSON object, progress bars."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from typing import Any

#: Columns of a table that is not printed on a terminal; chosen so that no table of ours is cut.
WIDTH = 160


def print_json(value: Mapping[str, Any]) -> None:
    """Print one JSON object on standard output; a number that is not finite becomes null."""
    print(json_text(value), end="")


def json_text(value: Mapping[str, Any]) -> str:
    """The text that `print_json` prints."""
    return json.dumps(_finite(value), indent=2) + "\n"


def _finite(value: Any) -> Any:
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {str(key): _finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    return value


def print_table(title: str, columns: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """Print a table on standard output: first column left-aligned, the others right-aligned."""
    from rich.box import SIMPLE_HEAD
    from rich.console import Console
    from rich.table import Table

    print(title)
    table = Table(box=SIMPLE_HEAD, pad_edge=False)
    for i, column in enumerate(columns):
        table.add_column(column, justify="left" if i == 0 else "right", no_wrap=True)
    for row in rows:
        table.add_row(*row)
    Console(width=None if _is_terminal() else WIDTH, highlight=False, markup=False).print(table)


def progress_console() -> Any:
    """Console for progress bars: standard error, silent unless it is a terminal."""
    import sys

    from rich.console import Console

    return Console(stderr=True, quiet=not sys.stderr.isatty())


def _is_terminal() -> bool:
    import sys

    return sys.stdout.isatty()
