"""TOML from and to users: read with bounds on its size and depth, written so that it reads back to the same."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Mapping
from datetime import date, time
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from pydantic import BaseModel, ValidationError

from mimopilot.common.errors import InputFileError
from mimopilot.common.files import read_text

#: Tables and lists within each other. Our own files have at most 6; Python's parser fails at some hundreds.
MAX_DEPTH = 16
#: Characters of a number or of a key without quotes. A double needs at most 24; `int` fails at 4300 digits.
MAX_WORD = 128
#: Characters of a value in a message: what is longer hides the message.
MAX_SHOWN = 80

# All quantifiers are possessive: linear in the length, whatever the text. A string that does not end is the parser's.
_STRING_OR_COMMENT = re.compile(
    r"""
      "{3} (?: [^"\\]++ | \\. | "{1,2}(?!") )*+ (?:"{3,5})?
    | '{3} (?: [^']++ | '{1,2}(?!') )*+ (?:'{3,5})?
    | " (?: [^"\\\n]++ | \\. )*+ "?
    | ' [^'\n]*+ '?
    | \# [^\n]*+
    """,
    re.DOTALL | re.VERBOSE,
)
_SPACES = re.compile(r"[ \t]+")
_WORD = re.compile(r"[^\s=,\[\]{}]+")
_BRACKET = re.compile(r"[\[\]{}]")
_BARE_KEY = re.compile(r"[A-Za-z0-9_-]{1,64}")

Model = TypeVar("Model", bound=BaseModel)


def read_toml(path: Path, what: str) -> dict[str, Any]:
    """The table of a TOML file that a user names.

    Parameters
    ----------
    path : Path
        The file.
    what : str
        What it should be, for messages: ``gains file``.

    Raises
    ------
    InputFileError
        When it cannot be read, see `mimopilot.common.files.read_bytes`, or parsed, see `parse_toml`.
    """
    return parse_toml(read_text(path, what), str(path))


def parse_toml(text: str, where: str) -> dict[str, Any]:
    """The table that a TOML text holds.

    The text is looked through before it is parsed: the time of the parser grows with the square of a key's length,
    and its depth of recursion with the nesting.

    Parameters
    ----------
    text : str
        Line ends of either kind.
    where : str
        Names the text in messages.

    Raises
    ------
    InputFileError
        When it is not TOML, nests deeper than `MAX_DEPTH`, or holds a word longer than `MAX_WORD`.
    """
    bare = _SPACES.sub(" ", _STRING_OR_COMMENT.sub("s", text)).replace(" .", ".").replace(". ", ".")
    depth = deepest = 0
    for bracket in _BRACKET.findall(bare):
        depth += 1 if bracket in "[{" else -1
        deepest = max(deepest, depth)
    for word in _WORD.findall(bare):
        if len(word) > MAX_WORD and word.count(".") < MAX_DEPTH:
            raise InputFileError(
                f"{where}: {shown(word)}: a number or key of {len(word)} characters, expected at most {MAX_WORD}"
            )
        deepest = max(deepest, word.count(".") + 1)
    if deepest > MAX_DEPTH:
        raise _too_deep(where)
    try:
        table = tomllib.loads(text)
    except ValueError as error:
        raise InputFileError(f"{where}: not a TOML file: {error}") from error
    if _depth(table) > MAX_DEPTH:
        raise _too_deep(where)
    return table


def _too_deep(where: str) -> InputFileError:
    return InputFileError(f"{where}: nested deeper than {MAX_DEPTH} tables and lists; is it the right file?")


def _depth(value: Any) -> int:
    """Levels of tables and lists; a list of tables is one with them, as ``[[name]]`` is."""
    if isinstance(value, Mapping):
        return 1 + max(map(_depth, value.values()), default=0)
    return 1 + max(map(_depth, value), default=0) if isinstance(value, list) else 0


def checked(model: type[Model], table: Mapping[str, Any], where: str) -> Model:
    """A table as one of pydantic's models.

    Raises
    ------
    InputFileError
        In one line: the first entry that is unknown or impossible.
    """
    try:
        return model.model_validate(table)
    except ValidationError as error:
        raise InputFileError(f"{where}: {complaint(error)}") from error


def complaint(error: ValidationError) -> str:
    """The first thing that pydantic found wrong, in one line."""
    first = error.errors()[0]
    field = ".".join(str(part) for part in first["loc"])
    message = first["msg"].removeprefix("Value error, ")
    if first["type"] == "missing":  # what pydantic calls its input is the table around it
        return f"{shown_text(field)}: {message}"
    return f"{shown_text(field)}: {message}, got {shown(first.get('input'))}" if field else message


def shown(value: Any) -> str:
    """A value that a user gave, for a message: at most `MAX_SHOWN` characters of it, in one line."""
    return shown_text(repr(value))


def shown_text(text: str) -> str:
    """Text for a message, as `shown` without quotes."""
    text = "".join(c if c.isprintable() else " " for c in text[: MAX_SHOWN + 1])
    return text if len(text) <= MAX_SHOWN else text[: MAX_SHOWN - 4] + " ..."


def toml_entries(table: Mapping[str, Any]) -> list[str]:
    """Lines ``key = value`` of a table of plain values; see `toml_value`."""
    return [f"{toml_key(key)} = {toml_value(value)}" for key, value in table.items()]


def toml_key(key: str) -> str:
    """A key, in quotes where TOML asks for them."""
    return key if _BARE_KEY.fullmatch(key) else toml_value(key)


def toml_value(value: Any) -> str:
    """A plain value (bool, number, text, date, list, mapping) as TOML text on one line."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, int):
        return str(value)
    if isinstance(value, float | np.floating):
        return repr(float(value))
    if isinstance(value, str):
        escaped = value.replace("\\", "\\\\").replace('"', '\\"')
        return '"' + "".join(c if c.isprintable() else _escape(c) for c in escaped) + '"'
    if isinstance(value, Mapping):
        return "{" + ", ".join(toml_entries(value)) + "}"
    if isinstance(value, date | time):
        return value.isoformat()
    return "[" + ", ".join(toml_value(item) for item in value) + "]"


def _escape(character: str) -> str:
    """A character that cannot be printed. Half of a surrogate pair is no character: a file's name may hold one."""
    code = ord(character)
    return "\ufffd" if 0xD800 <= code <= 0xDFFF else f"\\U{code:08x}"
