"""Files with a Crazyflie's log variables: cfclient's CSV of one log block, and the binary log of the uSD deck.

Both name the variables ``group.name``. What they mean is in `tuning.logs.crazyflie`.
"""

from __future__ import annotations

import re
import struct
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mimopilot.tuning.errors import TuningError
from mimopilot.tuning.logs.recording import INCOMPLETE

#: Header line of cfclient (src/cfclient/utils/logdatawriter.py): "Timestamp", then the variables of the block. A
#: spreadsheet that saves the file again may change the order, the marks between the cells, and the decimal point.
_TIME, _CSV_NAME, _SEPARATORS = "Timestamp", re.compile(r"\w+\.\w+"), ",;\t"
#: Time stamps over the radio are of 24 bits (crazyflie-firmware, src/modules/src/log.c): they begin again after 4.7 h.
_WRAP_MS, _MINUTE_MS = 2.0**24, 60e3
#: First byte of a uSD log (crazyflie-firmware, src/deck/drivers/src/usddeck.c and tools/usdlog/cfusdlog.py).
_MAGIC = 0xBC
#: Version of the uSD log -> struct format of an event's number and time stamp, and the unit of that, s.
_VERSIONS = {1: ("<HI", 1e-3), 2: ("<HQ", 1e-6)}
#: Header: magic byte, version, number of event types. A checksum (CRC-32 of all before it) ends the file.
_HEAD, _CHECKSUM = struct.Struct("<BHH"), struct.Struct("<I")
#: Variables are named ``group.name(T)`` with the letter of a type of `struct`: integers, float, half float.
_VARIABLE = re.compile(r"(.+)\(([BbHhIife])\)")
#: Most event types of a log (MAX_USD_LOG_EVENTS); tells a uSD log from other files that begin with the same byte.
_MOST_EVENTS = 20
#: The firmware's event of the variables that are logged at a fixed frequency.
FIXED_FREQUENCY = "fixedFrequency"

Values = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class LogBlock:
    """Variables that were logged together.

    Attributes
    ----------
    name : str
        The file, or the event of a uSD log.
    time : (N,) array, s
        Since the vehicle was switched on.
    variables : mapping
        ``group.name`` -> values (N,), in the firmware's unit.
    """

    name: str
    time: Values
    variables: Mapping[str, Values]


def is_cfclient_csv(head: bytes) -> bool:
    """Whether a file begins as cfclient's CSV."""
    line, end, _ = head.partition(b"\n")
    names = set(_cells(line.decode("utf-8-sig", "replace").strip())[0])
    return bool(end and _TIME in names and len(names) > 1 and all(map(_CSV_NAME.fullmatch, names - {_TIME})))


def _cells(line: str) -> tuple[list[str], str]:
    """The cells of a line, and the mark between them."""
    mark = max(_SEPARATORS, key=line.count)
    return [cell.strip(' "') for cell in line.split(mark)], mark


def is_usd_log(head: bytes) -> bool:
    """Whether a file begins as a uSD log of any version."""
    if len(head) < _HEAD.size:
        return False
    magic, version, events = _HEAD.unpack_from(head)
    return bool(magic == _MAGIC and 0 < version < 256 and 0 < events <= _MOST_EVENTS)


def read_cfclient_csv(path: Path) -> tuple[LogBlock, str]:
    """Read the CSV file of one log block.

    Returns
    -------
    block : LogBlock
    damage : str
        What is wrong with a file that can still be used; empty: nothing.

    Raises
    ------
    TuningError
        When a line does not hold one number for each name of the header, but for the last line.
    """
    try:
        header, *lines = path.read_text("utf-8-sig").splitlines()
    except UnicodeDecodeError as error:
        raise TuningError(f"{path}: not a text: byte {error.start + 1} is damaged; copy it again") from error
    names, mark = _cells(header)
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise TuningError(f"{path}: {', '.join(twice)} appears twice in the header; log each variable once")
    rows, damage = [], ""
    for number, line in enumerate(lines, 2):
        if not line.strip():
            continue
        try:
            row = [float(cell.strip(' "').replace(",", ".")) for cell in line.split(mark)]
        except ValueError:
            row = []
        if len(row) == len(names):
            rows.append(row)
        elif number == len(lines) + 1:
            damage = INCOMPLETE
        elif _TIME in line:
            raise TuningError(f"{path}: another log begins at line {number}; give each log in a file of its own")
        elif line.count(mark) >= 2 * len(names) - 2:
            raise TuningError(
                f"{path}, line {number}: its numbers have a decimal comma, the mark that separates them, too; give the "
                "file that cfclient wrote"
            )
        else:
            raise TuningError(
                f"{path}, line {number}: expected {len(names)} numbers, one for each name of the header; the file is "
                "damaged: copy it again"
            )
    if not rows:
        raise TuningError(f"{path}: no samples below the header line; write the log block to a file while you fly")
    columns = dict(zip(names, np.array(rows).T, strict=True))
    time = columns.pop(_TIME)
    wraps = (time[:-1] > _WRAP_MS - _MINUTE_MS) & (time[1:] < _MINUTE_MS)
    time[1:] += _WRAP_MS * np.cumsum(wraps)
    return LogBlock(path.name, 1e-3 * time, columns), damage


def read_usd_log(path: Path) -> tuple[LogBlock, ...]:
    """Read the log of a uSD deck, version 1 (times in ms) or 2 (in us).

    Returns
    -------
    tuple of LogBlock
        One for each event that occurred.

    Raises
    ------
    TuningError
        When the file is of another version or damaged: its events have no marks by which the next could be found.
    """
    data = path.read_bytes()
    if len(data) < _HEAD.size:
        raise TuningError(f"{path}: {len(data)} bytes are no uSD log; copy it again")
    _, version, count = _HEAD.unpack_from(data)
    if version not in _VERSIONS:
        known = " and ".join(map(str, _VERSIONS))
        raise TuningError(
            f"{path}: a uSD log of version {version}, known are {known}; convert it to CSV with the cfusdlog.py of "
            "its firmware and name the columns with --columns"
        )
    end = len(data) - _CHECKSUM.size
    if end < _HEAD.size or _CHECKSUM.unpack_from(data, end)[0] != zlib.crc32(data[:end]):
        raise TuningError(
            f"{path}: the checksum at its end is wrong: a byte is damaged, or the end is missing because logging was "
            "not stopped (usd.logging 0) before the power was; copy it again, or fly again"
        )
    try:
        return _events(data[:end], version, count)
    except (struct.error, IndexError, KeyError, ValueError) as error:
        raise TuningError(f"{path}: not as the uSD deck writes it: {error or type(error).__name__}") from error


@dataclass(frozen=True)
class _Event:
    name: str
    layout: np.dtype[np.void]


def _text(data: bytes, start: int) -> tuple[str, int]:
    """A text that ends with a zero byte, and the place behind it."""
    end = data.find(b"\0", start)
    if end < 0:
        raise ValueError("its header is cut")
    return data[start:end].decode("ascii"), end + 1


def _events(data: bytes, version: int, count: int) -> tuple[LogBlock, ...]:
    """The events of a log without its checksum."""
    place, kinds = _HEAD.size, dict[int, _Event]()
    stamp, unit = _VERSIONS[version]
    for _ in range(count):
        (number,) = struct.unpack_from("<H", data, place)
        name, place = _text(data, place + 2)
        (variables,) = struct.unpack_from("<H", data, place)
        place += 2
        fields = [("event", "<u2"), ("time", f"<u{struct.calcsize(stamp) - 2}")]
        for _ in range(variables):
            text, place = _text(data, place)
            match = _VARIABLE.fullmatch(text)
            if match is None:
                raise ValueError(f"variable {text!r} has no known type")
            fields.append((match[1], np.dtype(match[2]).newbyteorder("<").str))
        kinds[number] = _Event(name, np.dtype(fields))
    places: dict[int, list[int]] = {number: [] for number in kinds}
    while place < len(data):
        (number,) = struct.unpack_from("<H", data, place)
        if number not in kinds:
            raise ValueError(f"event {number} at byte {place} is not in the header")
        places[number].append(place)
        place += kinds[number].layout.itemsize
    if place > len(data):
        raise ValueError("the last event is cut")
    raw, blocks = np.frombuffer(data, np.uint8), []
    for number, event in kinds.items():
        size = event.layout.itemsize
        rows = np.array(places[number], np.int64)[:, None] + np.arange(size)
        table = np.ascontiguousarray(raw[rows]).view(event.layout)[:, 0] if len(rows) else None
        if table is not None:
            names = (event.layout.names or ())[2:]
            values = {name: table[name].astype(np.float64) for name in names}
            time = table["time"].astype(np.float64)
            span = 2.0 ** (8 * table["time"].dtype.itemsize)  # after which the time stamps begin again
            time[1:] += span * np.cumsum(np.diff(time) < -span / 2)
            blocks.append(LogBlock(event.name, unit * time, values))
    if not blocks:
        raise ValueError("it holds no samples: start logging (usd.logging 1) before the flight")
    return tuple(blocks)
