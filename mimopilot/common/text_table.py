"""Tables as text: cells fold at spaces until the table fits, and no character is ever cut."""

from __future__ import annotations

import math
import re
import textwrap
from collections.abc import Sequence

#: Between two columns.
GAP = "   "
#: Below the heads.
RULE = "─"
#: A longer word, such as a path, may be broken to make a table fit.
UNBROKEN = 24
#: Indent of the values where a table is listed row by row.
INDENT = "    "


def plain_zero(text: str) -> str:
    """The text without the sign of rounded numbers that are zero: ``-0.00`` is ``0.00``."""
    return re.sub(r"(?<![\w.])-(0(?:\.0+)?)(?![\w.])", r"\1", text)


def with_deviation(value: float, deviation: float | None = None) -> str:
    """A number with the digits that its standard deviation justifies, and that deviation in brackets.

    Two digits of the deviation are shown, at most six decimals; without a deviation four decimals.

    Examples
    --------
    >>> with_deviation(4.99801, 0.0077)
    '4.9980 (0.0077)'
    >>> with_deviation(-12.3456, 0.31)
    '-12.35 (0.31)'
    >>> with_deviation(-0.00001)
    '0.0000'
    """
    if deviation is None or not deviation > 0:
        return plain_zero(f"{value:.4f}")
    decimals = min(max(1 - int(f"{deviation:.1e}".partition("e")[2]), 0), 6)
    return plain_zero(f"{value:.{decimals}f} ({deviation:.{decimals}f})")


def plus_minus(value: float, error: float, unit: str = "") -> str:
    """A number with the digits that its error (two standard deviations) justifies: two digits of the error.

    Four digits where no error is known.

    Examples
    --------
    >>> plus_minus(1.42913, 0.0043)
    '1.4291 +- 0.0043'
    >>> plus_minus(45.09, 3.2, " deg")
    '45.1 +- 3.2 deg'
    >>> plus_minus(-0.00004, float("nan"))
    '-4e-05'
    """
    if not (math.isfinite(error) and error > 0):
        return plain_zero(f"{value:.4g}") + unit
    decimals = min(max(1 - int(f"{error:.1e}".partition("e")[2]), 0), 8)
    return plain_zero(f"{value:.{decimals}f} +- {error:.{decimals}f}") + unit


def text_table(columns: Sequence[str], rows: Sequence[Sequence[str]], width: int | None) -> list[str]:
    """Lines of a table: first column left-aligned, the others right-aligned.

    Parameters
    ----------
    columns : sequence of str
        Heads.
    rows : sequence of sequences of str
        Cells; a short row ends in empty ones.
    width : int or None
        Columns of the terminal; None: unlimited, each row is one line. Where not even folded cells fit, the rows are
        listed one below the other, each with its own heads.
    """
    cells = [[plain_zero(cell) for cell in (*row, *[""] * (len(columns) - len(row)))] for row in rows]
    table = [list(columns), *cells]
    by_column = list(zip(*table, strict=True))
    natural = [max(len(line) for cell in column for line in cell.splitlines() or [""]) for column in by_column]
    words = [[word for cell in column for word in cell.split()] for column in by_column]
    least = [max((min(len(word), UNBROKEN) for word in column), default=0) for column in words]
    room = math.inf if width is None else width - 1 - len(GAP) * (len(columns) - 1)
    if width is None or sum(natural) <= room:
        widths = natural
    elif 0 < sum(least) <= room:
        widths = _shared(natural, least, int(room))
    else:
        return _listed(columns, cells, width)
    rule = " " + RULE * (sum(widths) + len(GAP) * (len(widths) - 1))
    return [*_folded(table[0], widths), rule, *(line for row in cells for line in _folded(row, widths))]


def folded(text: str, width: int | None) -> list[str]:
    """Lines of prose, folded at spaces, the rest of a line indented as it begins; zeros without a sign.

    Parameters
    ----------
    text : str
    width : int or None
        Columns of the terminal; None: unlimited. A longer word, such as a path, stays whole: it is to be copied.
    """
    lines: list[str] = []
    for line in plain_zero(text).splitlines():
        indent = line[: len(line) - len(line.lstrip())]
        wrapper = textwrap.TextWrapper(
            width=width or len(line) + 1,
            initial_indent=indent,
            subsequent_indent=indent,
            break_long_words=False,
            break_on_hyphens=False,
        )
        lines += wrapper.wrap(line.strip()) or [""]
    return lines


def _shared(natural: Sequence[int], least: Sequence[int], room: int) -> list[int]:
    """Widths between the least and the natural ones, together `room`: the column that folds most gets the next one."""
    widths = list(least)
    for _ in range(room - sum(widths)):
        folding = [
            whole / max(width, 1) if width < whole else 0.0 for whole, width in zip(natural, widths, strict=True)
        ]
        widths[folding.index(max(folding))] += 1
    return widths


def _wrapped(text: str, width: int) -> list[str]:
    wrapper = textwrap.TextWrapper(width=max(width, 1), break_on_hyphens=False)
    return [part for line in text.splitlines() for part in (wrapper.wrap(line) or [""])] or [""]


def _folded(row: Sequence[str], widths: Sequence[int]) -> list[str]:
    """Lines of one row."""
    parts = [_wrapped(cell, width) for cell, width in zip(row, widths, strict=True)]
    lines = []
    for k in range(max(map(len, parts))):
        texts = [part[k] if k < len(part) else "" for part in parts]
        first, *others = zip(texts, widths, strict=True)
        aligned = [first[0].ljust(first[1]), *(text.rjust(width) for text, width in others)]
        lines.append(" " + GAP.join(aligned).rstrip())
    return lines


def _listed(columns: Sequence[str], rows: Sequence[Sequence[str]], width: int) -> list[str]:
    """Each row as its first cell and a line for each of the others that is not empty."""
    lines = []
    for row in rows:
        head = f"{columns[0]}: {row[0]}" if columns[0] else row[0]
        lines += [f" {line}" for line in _wrapped(head, width - 1)]
        for column, cell in zip(columns[1:], row[1:], strict=True):
            if cell:
                text = f"{column}: {cell}" if column else cell
                lines += [INDENT + line for line in _wrapped(text, width - len(INDENT))]
    return lines
