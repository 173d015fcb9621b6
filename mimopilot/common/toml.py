"""TOML files of users: bounded reading, and writing that reads back to the same values."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Mapping, Sequence
from datetime import date, time
from difflib import get_close_matches
from pathlib import Path
from typing import Any, TypeVar, get_args

import numpy as np
from pydantic import BaseModel, ValidationError

from mimopilot.common.errors import InputFileError
from mimopilot.common.files import read_text

#: Largest nesting of tables and lists. Our own files have at most 6; Python's parser fails at some hundreds.
MAX_DEPTH = 16
#: Longest number or unquoted key, characters. A double needs at most 24; `int` fails at 4300 digits.
MAX_TOKEN = 128
#: Kind of the file that is most often given in place of another one, and entries that only that has.
GAINS_FILE, GAINS_ENTRIES = "gains file", {"schema", "roll_pitch"}
#: Longest value in a message, characters; chosen so that the message stays readable.
MAX_SHOWN = 80

# All quantifiers are possessive: linear time for any text. An unterminated string is left to the parser.
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
_TOKEN = re.compile(r"[^\s=,\[\]{}]+")
_BRACKET = re.compile(r"[\[\]{}]")
_BARE_KEY = re.compile(r"[A-Za-z0-9_-]{1,64}")

Model = TypeVar("Model", bound=BaseModel)


def read_toml(path: Path, what: str, instead: str = "") -> dict[str, Any]:
    """Read a TOML file that a user names.

    Parameters
    ----------
    path : Path
        The file.
    what : str
        Its kind, for messages: ``gains file``.
    instead : str
        What to do if it is a gains file and should not be: where that belongs.

    Raises
    ------
    InputFileError
        If it cannot be read, see `mimopilot.common.files.read_bytes`, or parsed, see `parse_toml`.
    """
    return parse_toml(read_text(path, what), str(path), what, instead)


def parse_toml(text: str, where: str, what: str = GAINS_FILE, instead: str = "") -> dict[str, Any]:
    """Parse a TOML text.

    The text is checked before parsing: the parser's time grows with the square of a key's length, and its recursion
    depth with the nesting.

    Parameters
    ----------
    text : str
        With line ends of either kind.
    where : str
        Names the text in messages.
    what, instead : str
        As in `read_toml`.

    Raises
    ------
    InputFileError
        If it is not TOML, is a gains file where another kind is wanted, is nested deeper than `MAX_DEPTH`, or holds a
        token longer than `MAX_TOKEN`.
    """
    bare = _SPACES.sub(" ", _STRING_OR_COMMENT.sub("s", text)).replace(" .", ".").replace(". ", ".")
    depth = deepest = 0
    for bracket in _BRACKET.findall(bare):
        depth += 1 if bracket in "[{" else -1
        deepest = max(deepest, depth)
    for token in _TOKEN.findall(bare):
        if len(token) > MAX_TOKEN and token.count(".") < MAX_DEPTH:
            raise InputFileError(
                f"{where}: {shown(token)}: a number or key of {len(token)} characters, expected at most {MAX_TOKEN}"
            )
        deepest = max(deepest, token.count(".") + 1)
    if deepest > MAX_DEPTH:
        raise _too_deep(where)
    try:
        table = tomllib.loads(text)
    except ValueError as error:
        raise InputFileError(f"{where}: not a TOML file: {error}") from error
    if _depth(table) > MAX_DEPTH:
        raise _too_deep(where)
    if what != GAINS_FILE and table.keys() >= GAINS_ENTRIES:
        article = "an" if what[0] in "aeiou" else "a"
        raise InputFileError(
            f"{where}: is a gains file, expected {article} {what}" + (f"; {instead}" if instead else "")
        )
    return table


def _too_deep(where: str) -> InputFileError:
    return InputFileError(f"{where}: nested deeper than {MAX_DEPTH} tables and lists; is it the right file?")


def _depth(value: Any) -> int:
    """Nesting of tables and lists; a list of tables counts as one level, as ``[[name]]`` does."""
    if isinstance(value, Mapping):
        return 1 + max(map(_depth, value.values()), default=0)
    return 1 + max(map(_depth, value), default=0) if isinstance(value, list) else 0


def checked(model: type[Model], table: Mapping[str, Any], where: str) -> Model:
    """Validate a table with a pydantic model.

    Raises
    ------
    InputFileError
        Names the first unknown or invalid entry, in one line.
    """
    try:
        return model.model_validate(table)
    except ValidationError as error:
        raise InputFileError(f"{where}: {complaint(error, model)}") from error


def complaint(error: ValidationError, model: type[BaseModel]) -> str:
    """The first error that pydantic found in a table for `model`, in one line; for an unknown entry a similar one."""
    first = error.errors()[0]
    field = ".".join(str(part) for part in first["loc"])
    message = "missing" if first["type"] == "missing" else first["msg"].removeprefix("Value error, ")
    if first["type"] == "extra_forbidden":
        return f"{shown_text(field)}: unknown entry; {_meant(first['loc'], model)}"
    if first["type"] == "missing":  # its input is then the table, not a value
        return f"{shown_text(field)}: {message}"
    if not field:
        return message
    value = shown(first.get("input"))
    if (wanted := message.removeprefix("Input should be ")) != message:
        wanted = wanted.replace("'", "") if first["type"] == "literal_error" else wanted
        return f"{shown_text(field)}: got {value}, expected {wanted}"
    return f"{shown_text(field)}: {message}" + ("" if "got " in message else f", got {value}")


def _meant(place: Sequence[str | int], model: type[BaseModel]) -> str:
    """Which entry was perhaps meant instead of an unknown one, else all that are known there."""
    known: Sequence[str] = ()
    holder: Any = model
    for step in place[:-1]:  # to the model of the table that holds the entry
        field = getattr(holder, "model_fields", {}).get(step)
        parts = () if field is None else (field.annotation, *get_args(field.annotation))
        holder = next((part for part in parts if hasattr(part, "model_fields")), None)
    if holder is not None:
        known = sorted(holder.model_fields)
    # Without regard to case: close names differ in it, too.
    by_lower = {name.lower(): name for name in known}
    close = get_close_matches(str(place[-1]).lower(), by_lower, n=1)
    if close:
        return f"did you mean {by_lower[close[0]]}?"
    return f"known: {', '.join(known)}" if known else "leave it out"


def shown(value: Any) -> str:
    """A user's value for a message: at most `MAX_SHOWN` characters, in one line."""
    return shown_text(repr(value))


def shown_text(text: str) -> str:
    """A user's text for a message: as `shown`, without quotes."""
    text = "".join(c if c.isprintable() else " " for c in text[: MAX_SHOWN + 1])
    return text if len(text) <= MAX_SHOWN else text[: MAX_SHOWN - 4] + " ..."


def toml_entries(table: Mapping[str, Any]) -> list[str]:
    """Lines ``key = value`` of a table of plain values; see `toml_value`."""
    return [f"{toml_key(key)} = {toml_value(value)}" for key, value in table.items()]


def toml_key(key: str) -> str:
    """A key, in quotes if TOML requires them."""
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
    """Escape of an unprintable character. Half a surrogate pair, as in a file name, has none: U+FFFD."""
    code = ord(character)
    return "\ufffd" if 0xD800 <= code <= 0xDFFF else f"\\U{code:08x}"
