"""The messages in an ArduPilot dataflash file (.bin): where they are, and the values of their fields."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from mimopilot.tuning.logs.recording import listed
from numpy.typing import NDArray

HEAD = b"\xa3\x95"
FMT, FMT_LENGTH = 0x80, 89  # the message that defines the others, itself as AP_Logger's LogStructure.h defines it
PADDING = b"\x00\xff"  # what block devices leave behind the last message

#: DataflashFormat letter of AP_Logger -> type in the file, and what the value is multiplied by.
LETTERS = dict(
    zip("bBhHiIqQfdgM", ("i1", "u1", "<i2", "<u2", "<i4", "<u4", "<i8", "<u8", "<f4", "<f8", "<f2", "u1"), strict=True)
)
LETTERS |= {"c": "<i2", "C": "<u2", "e": "<i4", "E": "<u4", "L": "<i4", "n": "S4", "N": "S16", "Z": "S64", "a": "S64"}
FACTORS = {"c": 0.01, "C": 0.01, "e": 0.01, "E": 0.01, "L": 1e-7}


@dataclass(frozen=True, eq=False)
class DataflashFormat:
    """How a message is laid out: its length in bytes, head included, and the letter of each field."""

    name: str
    length: int
    letters: dict[str, str]

    @property
    def record(self) -> np.dtype[Any] | None:
        """The fields behind the head; None when they do not fill the message, which is damage."""
        kinds = [(name, LETTERS.get(letter, "")) for name, letter in self.letters.items()]
        if not kinds or not all(kind for _, kind in kinds):
            return None
        record = np.dtype(kinds)
        return record if record.itemsize + 3 == self.length else None


@dataclass(frozen=True, eq=False)
class DataflashFile:
    """A file with the places of its messages.

    Attributes
    ----------
    content : bytes
        All of it.
    formats : dict
        Message -> its layout.
    offsets : dict
        Message -> where each begins.
    damage : str
        What could not be read; empty when all could.
    """

    content: bytes
    formats: dict[str, DataflashFormat]
    offsets: dict[str, NDArray[np.int64]]
    damage: str

    def names(self) -> list[str]:
        """The messages that are there."""
        return sorted(name for name, offsets in self.offsets.items() if len(offsets))

    def fields(self, message: str, names: Sequence[str]) -> list[NDArray[Any]] | None:
        """Values of fields, one a message, in the unit of the format; None when there are none with these fields."""
        layout = self.formats.get(message)
        record = layout.record if layout else None
        if layout is None or record is None or not set(names) <= set(layout.letters):
            return None
        stop = layout.length
        rows = np.frombuffer(b"".join(self.content[o + 3 : o + stop] for o in self.offsets[message].tolist()), record)
        factors = [FACTORS.get(layout.letters[name]) for name in names]
        return [rows[name] * factor if factor else rows[name] for name, factor in zip(names, factors, strict=True)]

    def texts(self, message: str, field: str) -> list[str]:
        """Values of a text field; none when the message is not logged with it."""
        columns = self.fields(message, (field,))
        if columns is None or columns[0].dtype.kind != "S":
            return []
        return [_text(text) for text in columns[0].tolist()]


def open_dataflash(path: Path) -> DataflashFile:
    """Find the messages of a file; where bytes make no message, the next one that does is sought.

    A message counts when its type is known and another one, or the end of the file, follows it. So a damaged byte
    costs the message that it is in.
    """
    content = path.read_bytes()
    lengths = [0] * 256
    lengths[FMT] = FMT_LENGTH
    names: dict[int, DataflashFormat] = {}
    places: dict[int, list[int]] = {FMT: []}
    at, end, lost, gaps = 0, len(content), 0, 0
    solid = len(content.rstrip(PADDING))
    while at < end:
        following = _following(content, lengths, at)
        if not following or not _continues(content, solid, following):
            resumed = _resume(content, lengths, solid, at + 1)
            # Whole all the same where just the head of the next message is damaged.
            if not following or following + _length(content, lengths, following) != resumed:
                if resumed == end and _cut(content, lengths, at):
                    break
                if at < solid:
                    lost, gaps = lost + resumed - at, gaps + 1
                at = resumed
                continue
        kind = content[at + 2]
        places[kind].append(at)
        if kind == FMT:
            number, layout = _format(content[at + 3 : at + FMT_LENGTH])
            if number != FMT and number not in names and layout.length >= 3:
                names[number], lengths[number], places[number] = layout, layout.length, []
        at = following
    # A damaged definition may give a second type the name of another: the one that is used counts.
    used = sorted(names, key=lambda number: len(places[number]))
    damage = []
    if lost:
        damage.append(f"damaged: {lost} of {end} bytes, in {gaps} place{'s'[: gaps > 1]}, are no message and left out")
    unread = sorted(names[n].name for n in used if places[n] and names[n].length > 3 and names[n].record is None)
    if unread:
        damage.append(f"the format of {listed(unread)} is not known or damaged, none of them is read")
    if at < end:
        damage.append("it ends in the middle of a message: not downloaded completely, or the power was cut")
    return DataflashFile(
        content,
        {names[number].name: names[number] for number in used},
        {names[number].name: np.array(places[number], np.int64) for number in used},
        "; ".join(damage),
    )


def _continues(content: bytes, solid: int, at: int) -> bool:
    """Whether a message or nothing but padding follows here."""
    return at >= solid or content.startswith(HEAD, at)


def _length(content: bytes, lengths: list[int], at: int) -> int:
    """Length of the message whose type stands here; 0 when it is not known."""
    return lengths[content[at + 2]] if at + 2 < len(content) else 0


def _cut(content: bytes, lengths: list[int], at: int) -> bool:
    """Whether the file ends before the message that begins here does."""
    tail = content[at : at + 3]
    return (HEAD.startswith(tail[:2]) and len(tail) < 3) or (
        tail.startswith(HEAD) and at + _length(content, lengths, at) > len(content)
    )


def _following(content: bytes, lengths: list[int], at: int) -> int:
    """Where the message that begins here ends; 0 when none does, or not within the file."""
    length = _length(content, lengths, at) if content.startswith(HEAD, at) else 0
    return at + length if length and at + length <= len(content) else 0


def _resume(content: bytes, lengths: list[int], solid: int, start: int) -> int:
    """Where the next message begins that another one or the end of the file follows; the end if there is none."""
    while (start := content.find(HEAD, start)) >= 0:
        following = _following(content, lengths, start)
        if following and _continues(content, solid, following):
            return start
        start += 1
    return len(content)


def _format(payload: bytes) -> tuple[int, DataflashFormat]:
    """Type and layout that an FMT message defines."""
    number, length, name, letters, columns = struct.unpack("<BB4s16s64s", payload)
    name, letters, columns = (_text(text) for text in (name, letters, columns))
    fields = columns.split(",") if columns else []
    whole = len(fields) == len(letters) == len(set(fields))
    return number, DataflashFormat(name, length, dict(zip(fields, letters, strict=True)) if whole else {})


def _text(field: bytes) -> str:
    """A text field; damage does not bring control characters into messages."""
    text = field.partition(b"\0")[0].decode("ascii", "replace")
    return "".join(letter if letter.isprintable() else "?" for letter in text)
