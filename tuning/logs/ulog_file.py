"""Parser of ULog files: topics, parameters and damage.

Format: docs.px4.io/main/en/dev_log/ulog_file_format.
"""

from __future__ import annotations

import re
import struct
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mimopilot.tuning.errors import TuningError
from mimopilot.tuning.logs.recording import INCOMPLETE, listed

FIRST = 16  # bytes of the file header; the first message follows
KINDS = b"ABCDFILMOPQRS"
SYNC = b"\x2f\x73\x13\x20\x25\x0c\xbb\x12"
IS_KIND = np.isin(np.arange(256), list(KINDS))
CHUNK = 1 << 16  # bytes searched at a time
MAX_MESSAGE = 65535  # bytes: the size field has 16 bit
UNKNOWN = 1 << 40  # bytes: stands for the size of an undefined type
APPENDED = 1  # the only incompatible flag defined: data appended after a crash

TYPES = {"int8_t": "i1", "uint8_t": "u1", "int16_t": "<i2", "uint16_t": "<u2", "int32_t": "<i4", "uint32_t": "<u4"}
TYPES |= {"int64_t": "<i8", "uint64_t": "<u8", "float": "<f4", "double": "<f8", "bool": "i1", "char": "i1"}
LEVELS = b"01234567"  # of text messages
_NAME, _KEY = re.compile(rb"[A-Za-z0-9_/]+:"), re.compile(rb"[A-Za-z0-9_\[\]]+ [ -~]+")
_FIELD = re.compile(r"([A-Za-z0-9_/]+)(?:\[(\d{1,5})\])? ([A-Za-z0-9_]+)")

#: Fields of a format: (type, length of the array or 0, name).
Fields = list[tuple[str, int, str]]


@dataclass(frozen=True, eq=False)
class UlogTopic:
    """One subscription: instance 0, 1, ... of a topic, and the offsets of its messages (bytes).

    `smallest` and `largest` are the sizes of a message without and with trailing padding, bytes.
    """

    name: str
    instance: int
    fields: Fields
    smallest: int
    largest: int
    offsets: list[int] = field(default_factory=list)


@dataclass(eq=False)
class UlogFile:
    """A ULog file and its topics.

    Attributes
    ----------
    path : Path
    content : bytes
        The whole file.
    formats : dict
        Type -> its fields.
    topics : dict
        Subscription id -> topic.
    information : dict
        Key -> text or integer.
    parameters : dict
        Name -> value when logging began.
    changes : list of (time s, name, value)
        Parameters set later.
    damage : str
        What could not be read; empty when everything could.
    """

    path: Path
    content: bytes
    formats: dict[str, Fields] = field(default_factory=dict)
    topics: dict[int, UlogTopic] = field(default_factory=dict)
    information: dict[str, str | int] = field(default_factory=dict)
    parameters: dict[str, float] = field(default_factory=dict)
    changes: list[tuple[float, str, float]] = field(default_factory=list)
    damage: str = ""
    _sizes: dict[str, int] = field(default_factory=dict)
    _undefined: set[str] = field(default_factory=set)
    _started: bool = False
    _stamp: tuple[UlogTopic, int] | None = None

    def names(self) -> list[str]:
        """The topics that were logged."""
        return sorted({topic.name for topic in self.topics.values() if topic.offsets})

    def fields(self, name: str) -> dict[str, NDArray[Any]]:
        """Field (``field[i]`` of an array) -> values of the first instance of a topic; empty when not logged."""
        topic = next((t for t in self.topics.values() if t.name == name and not t.instance and t.offsets), None)
        if topic is None:
            return {}
        layout: list[Any] = []
        for kind, length, label in _unpadded(topic.fields):
            single = TYPES.get(kind) or f"V{self._size_of_type(kind)}"
            layout.append((label, single, (length,)) if length else (label, single))
        stop = 5 + topic.smallest
        rows = np.frombuffer(b"".join(self.content[o + 5 : o + stop] for o in topic.offsets), np.dtype(layout))
        found: dict[str, NDArray[Any]] = {}
        for kind, length, label in _unpadded(topic.fields):
            if kind in TYPES:
                found |= {f"{label}[{i}]": rows[label][:, i] for i in range(length)} if length else {label: rows[label]}
        return found

    def read(self) -> None:
        """Parse all messages; after damaged bytes, continue at the next valid message."""
        at, end, lost, gaps = FIRST, len(self.content), 0, 0
        while at < end:
            end_of_message = self._message_end(at)
            if end_of_message and self.content[at + 2] in b"AF":
                self._store(at, end_of_message)
            if end_of_message and (self._message_end(end_of_message) or self._is_truncated(end_of_message)):
                pass
            elif not end_of_message and self._is_truncated(at):
                break
            else:
                resumed = self._next_valid(at + 1, end_of_message)
                # This message is complete if only the next one is damaged.
                if not end_of_message or resumed < end_of_message:
                    lost, gaps, at = lost + resumed - at, gaps + 1, resumed
                    continue
            if self.content[at + 2] not in b"AF":
                self._store(at, end_of_message)
            at = end_of_message
        damage = []
        if lost:
            places = f"{gaps} place{'s'[: gaps > 1]}"
            damage.append(f"damaged: {lost} of {end} bytes, in {places}, are not valid messages and ignored")
        if self._undefined:
            damage.append(
                f"damaged: the format of {listed(sorted(self._undefined))} is not defined; these topics are not read"
            )
        if at < end:
            damage.append(INCOMPLETE)
        self.damage = "; ".join(damage)

    def _message_end(self, at: int) -> int:
        """End of the valid message that begins at `at`; 0 when there is none."""
        if at + 3 > len(self.content):
            return 0
        size, kind = int.from_bytes(self.content[at : at + 2], "little"), self.content[at + 2]
        end_of_message = at + 3 + size
        if kind not in KINDS or not size or end_of_message > len(self.content):
            return 0
        return end_of_message if self._is_valid(chr(kind), at + 3, end_of_message) else 0

    def _is_valid(self, kind: str, start: int, stop: int) -> bool:
        """Whether the bytes can be the contents of a message of this kind."""
        content, size = self.content, stop - start
        if kind == "D":
            topic = self.topics.get(int.from_bytes(content[start : start + 2], "little"))
            return topic is not None and topic.smallest <= size - 2 <= topic.largest
        if kind == "A":
            return self._text(start + 3, stop) in self.formats
        if kind == "F":
            return _NAME.match(content, start, stop) is not None
        if kind in "IPMQ":  # key: its length, then type and name; M and Q have one byte before it
            start += kind in "MQ"
            return _KEY.fullmatch(content, start + 1, min(start + 1 + content[start], stop)) is not None
        if kind in "LC":
            return content[start] in LEVELS
        return size == 8 and content[start:stop] == SYNC if kind == "S" else size == 2 or kind == "B"

    def _is_truncated(self, at: int) -> bool:
        """Whether the file ends at `at`, or before the end of the message that begins there."""
        if at + 3 > len(self.content):
            return True
        size, kind = struct.unpack_from("<HB", self.content, at)
        return kind in KINDS and at + 3 + size > len(self.content)

    def _next_valid(self, start: int, likely: int) -> int:
        """Offset of the next valid message that is followed by another; `likely` is tried first."""
        content, end = self.content, len(self.content)
        for base in (likely, *range(start, end, CHUNK)):
            kinds = np.frombuffer(content[base + 2 : base + 2 + (CHUNK if base != likely else 1)], np.uint8)
            for at in (base + np.flatnonzero(IS_KIND[kinds])).tolist():
                end_of_message = self._message_end(at)
                if end_of_message and (end_of_message == end or self._message_end(end_of_message)):
                    return int(at)
        return end

    def _store(self, at: int, end_of_message: int) -> None:
        kind, start = chr(self.content[at + 2]), at + 3
        self._started |= kind in "ALC"
        if kind == "D":
            topic = self.topics[struct.unpack_from("<H", self.content, start)[0]]
            topic.offsets.append(at)
            self._stamp = topic, at
        elif kind == "F":
            name, _, layout = self._text(start, end_of_message).partition(":")
            parts = [_FIELD.fullmatch(part) for part in layout.split(";") if part]
            if parts and all(parts) and name not in self.formats:
                self.formats[name] = [(p[1], int(p[2] or 0), p[3]) for p in parts if p]
        elif kind == "A":
            instance, number = struct.unpack_from("<BH", self.content, start)
            name = self._text(start + 3, end_of_message)
            fields = self.formats[name]
            largest, smallest = self._size_of_fields(fields), self._size_of_fields(_unpadded(fields))
            if largest <= MAX_MESSAGE and len({label for _, _, label in fields}) == len(fields):
                self.topics[number] = UlogTopic(name, instance, fields, smallest, largest)
            elif largest < UNKNOWN:
                raise TuningError(
                    f"{self.path}: damaged ULog file: messages of {name} would have more than {MAX_MESSAGE} bytes or a "
                    "repeated field; download the log again"
                )
            else:
                self._undefined.add(name)
        elif kind in "IP":
            self._store_keyed(kind, start, end_of_message)

    def _store_keyed(self, kind: str, start: int, end_of_message: int) -> None:
        """Store an information or parameter message; ignore one that is malformed."""
        stop = start + 1 + self.content[start]
        declared, _, name = self._text(start + 1, min(stop, end_of_message)).partition(" ")
        number = TYPES.get(declared)
        value: str | float
        if declared.startswith("char["):
            value = self._text(stop, end_of_message)
        elif number and np.dtype(number).itemsize == end_of_message - stop:
            value = np.frombuffer(self.content, number, 1, stop)[0].item()
        else:
            return
        if kind == "I":
            self.information[name] = value if isinstance(value, str) else int(value)
        elif not isinstance(value, str) and not self._started:
            self.parameters[name] = float(value)
        elif not isinstance(value, str):
            self.changes.append((self._time(), name, float(value)))

    def _time(self) -> float:
        """Time (s) of the last data message; of the file header before the first."""
        place = 8
        if self._stamp is not None:
            topic, at = self._stamp
            labels = [label for _, _, label in topic.fields]
            if ("uint64_t", 0, "timestamp") in topic.fields:
                place = at + 5 + self._size_of_fields(topic.fields[: labels.index("timestamp")])
        return float(struct.unpack_from("<Q", self.content, place)[0]) * 1e-6

    def _size_of_fields(self, fields: Fields) -> int:
        """Size of fields, bytes; above `MAX_MESSAGE` when nested too deeply, `UNKNOWN` when a type is not defined."""
        total = 0
        for kind, length, _ in fields:
            total += (length or 1) * self._size_of_type(kind)
            if total > MAX_MESSAGE:
                return UNKNOWN if total >= UNKNOWN else MAX_MESSAGE + 1
        return total

    def _size_of_type(self, kind: str) -> int:
        if kind in TYPES:
            return np.dtype(TYPES[kind]).itemsize
        if kind not in self._sizes:
            self._sizes[kind] = MAX_MESSAGE + 1  # stops the recursion of a type that contains itself
            self._sizes[kind] = self._size_of_fields(self.formats[kind]) if kind in self.formats else UNKNOWN
        return self._sizes[kind]

    def _text(self, start: int, stop: int) -> str:
        return self.content[start:stop].decode("utf-8", "replace")


def open_ulog(path: Path) -> UlogFile:
    """Read a file.

    Raises
    ------
    TuningError
        When the header is damaged or of a later format version, or a topic is larger than a message can be.
    """
    log = UlogFile(path, path.read_bytes())
    flags = log.content[FIRST + 11 : FIRST + 19] if log.content[FIRST + 2 : FIRST + 3] == b"B" else b""
    if len(log.content) < FIRST or any(flags[1:]) or (flags and flags[0] & ~APPENDED):
        raise TuningError(f"{path}: damaged ULog file, or a format version later than 1; download it again")
    log.read()
    return log


def _unpadded(fields: Fields) -> Fields:
    """Fields without the trailing padding, which is not logged."""
    stop = len(fields)
    while stop and fields[stop - 1][2].startswith("_padding"):
        stop -= 1
    return fields[:stop]
