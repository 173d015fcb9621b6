"""Parser of ArduPilot dataflash files (.bin): message formats, fields and damage."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mimopilot.tuning.logs.recording import INCOMPLETE, listed

HEAD = b"\xa3\x95"
FMT, FMT_LENGTH = 0x80, 89  # message that defines the others; its own layout is in AP_Logger's LogStructure.h
PADDING = b"\x00\xff"  # block devices leave these bytes after the last message

#: Format letter of AP_Logger -> type in the file.
LETTERS = dict(
    zip("bBhHiIqQfdgM", ("i1", "u1", "<i2", "<u2", "<i4", "<u4", "<i8", "<u8", "<f4", "<f8", "<f2", "u1"), strict=True)
)
LETTERS |= {"c": "<i2", "C": "<u2", "e": "<i4", "E": "<u4", "L": "<i4", "n": "S4", "N": "S16", "Z": "S64", "a": "S64"}
#: Format letter -> factor to the unit of the field.
FACTORS = {"c": 0.01, "C": 0.01, "e": 0.01, "E": 0.01, "L": 1e-7}


@dataclass(frozen=True, eq=False)
class DataflashFormat:
    """Layout of a message: name, length in bytes with the 3-byte header, and field -> format letter."""

    name: str
    length: int
    letters: dict[str, str]

    @property
    def record(self) -> np.dtype[Any] | None:
        """Type of the fields after the header; None when they do not fill the message, a sign of damage."""
        kinds = [(name, LETTERS.get(letter, "")) for name, letter in self.letters.items()]
        if not kinds or not all(kind for _, kind in kinds):
            return None
        record = np.dtype(kinds)
        return record if record.itemsize + 3 == self.length else None


@dataclass(frozen=True, eq=False)
class DataflashFile:
    """A dataflash file and the offsets of its messages.

    Attributes
    ----------
    content : bytes
        The whole file.
    formats : dict
        Message name -> layout.
    offsets : dict
        Message name -> offset of each message, bytes.
    damage : str
        What could not be read; empty when everything could.
    """

    content: bytes
    formats: dict[str, DataflashFormat]
    offsets: dict[str, NDArray[np.int64]]
    damage: str

    def names(self) -> list[str]:
        """Names of the messages that were logged."""
        return sorted(name for name, offsets in self.offsets.items() if len(offsets))

    def fields(self, message: str, names: Sequence[str]) -> list[NDArray[Any]] | None:
        """Values of fields, one per message, in the unit of the format; None when not logged with these fields."""
        layout = self.formats.get(message)
        record = layout.record if layout else None
        if layout is None or record is None or not set(names) <= set(layout.letters):
            return None
        stop = layout.length
        rows = np.frombuffer(b"".join(self.content[o + 3 : o + stop] for o in self.offsets[message].tolist()), record)
        factors = [FACTORS.get(layout.letters[name]) for name in names]
        return [rows[name] * factor if factor else rows[name] for name, factor in zip(names, factors, strict=True)]

    def texts(self, message: str, field: str) -> list[str]:
        """Values of a text field; empty when not logged."""
        columns = self.fields(message, (field,))
        if columns is None or columns[0].dtype.kind != "S":
            return []
        return [_text(text) for text in columns[0].tolist()]


def open_dataflash(path: Path) -> DataflashFile:
    """Parse a file; after damaged bytes, continue at the next valid message.

    A message is valid when its type is defined and another message or the end of the file follows. So a damaged
    byte costs only the message that it is in.
    """
    content = path.read_bytes()
    lengths = [0] * 256
    lengths[FMT] = FMT_LENGTH
    names: dict[int, DataflashFormat] = {}
    places: dict[int, list[int]] = {FMT: []}
    at, end, lost, gaps = 0, len(content), 0, 0
    data_end = len(content.rstrip(PADDING))
    while at < end:
        end_of_message = _message_end(content, lengths, at)
        if not end_of_message or not _is_followed(content, data_end, end_of_message):
            resumed = _next_valid(content, lengths, data_end, at + 1)
            # This message is complete if only the header of the next one is damaged.
            if not end_of_message or end_of_message + _length(content, lengths, end_of_message) != resumed:
                if resumed == end and _is_truncated(content, lengths, at):
                    break
                if at < data_end:
                    lost, gaps = lost + resumed - at, gaps + 1
                at = resumed
                continue
        kind = content[at + 2]
        places[kind].append(at)
        if kind == FMT:
            number, layout = _format(content[at + 3 : at + FMT_LENGTH])
            if number != FMT and number not in names and layout.length >= 3:
                names[number], lengths[number], places[number] = layout, layout.length, []
        at = end_of_message
    # A damaged FMT message may give two types one name: the type with more messages counts.
    used = sorted(names, key=lambda number: len(places[number]))
    damage = []
    if lost:
        damage.append(
            f"damaged: {lost} of {end} bytes, in {gaps} place{'s'[: gaps > 1]}, are not valid messages and ignored"
        )
    unread = sorted(names[n].name for n in used if places[n] and names[n].length > 3 and names[n].record is None)
    if unread:
        damage.append(f"the format of {listed(unread)} is unknown or damaged; these messages are not read")
    if at < end:
        damage.append(INCOMPLETE)
    return DataflashFile(
        content,
        {names[number].name: names[number] for number in used},
        {names[number].name: np.array(places[number], np.int64) for number in used},
        "; ".join(damage),
    )


def _is_followed(content: bytes, data_end: int, at: int) -> bool:
    """Whether a message or only padding begins at `at`."""
    return at >= data_end or content.startswith(HEAD, at)


def _length(content: bytes, lengths: list[int], at: int) -> int:
    """Length of the message at `at`, bytes; 0 when its type is not defined."""
    return lengths[content[at + 2]] if at + 2 < len(content) else 0


def _is_truncated(content: bytes, lengths: list[int], at: int) -> bool:
    """Whether the file ends before the end of the message that begins at `at`."""
    tail = content[at : at + 3]
    return (HEAD.startswith(tail[:2]) and len(tail) < 3) or (
        tail.startswith(HEAD) and at + _length(content, lengths, at) > len(content)
    )


def _message_end(content: bytes, lengths: list[int], at: int) -> int:
    """End of the message that begins at `at`; 0 when there is none, or it exceeds the file."""
    length = _length(content, lengths, at) if content.startswith(HEAD, at) else 0
    return at + length if length and at + length <= len(content) else 0


def _next_valid(content: bytes, lengths: list[int], data_end: int, start: int) -> int:
    """Offset of the next message that is followed by another or by the end of the file; the end if there is none."""
    while (start := content.find(HEAD, start)) >= 0:
        end_of_message = _message_end(content, lengths, start)
        if end_of_message and _is_followed(content, data_end, end_of_message):
            return start
        start += 1
    return len(content)


def _format(payload: bytes) -> tuple[int, DataflashFormat]:
    """Type number and layout defined by an FMT message."""
    number, length, name, letters, columns = struct.unpack("<BB4s16s64s", payload)
    name, letters, columns = (_text(text) for text in (name, letters, columns))
    fields = columns.split(",") if columns else []
    whole = len(fields) == len(letters) == len(set(fields))
    return number, DataflashFormat(name, length, dict(zip(fields, letters, strict=True)) if whole else {})


def _text(field: bytes) -> str:
    """A text field; replaces unprintable characters, which damage may cause."""
    text = field.partition(b"\0")[0].decode("ascii", "replace")
    return "".join(letter if letter.isprintable() else "?" for letter in text)
