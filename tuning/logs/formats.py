"""The log formats that can be read, one row each. A new format is one module with a reader, and one row here."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from mimopilot.tuning.errors import TuningError
from mimopilot.tuning.logs.crazyflie_file import is_cfclient_csv, is_usd_log

#: Bytes at the beginning of a file from which its format is detected: enough for the header line of a CSV file.
HEAD_BYTES = 4096


@dataclass(frozen=True)
class LogFormat:
    """One log format.

    Attributes
    ----------
    name : str
        As in messages, in the help text and in docs/logs.md.
    suffixes : tuple of str
        Usual endings of file names. The content decides, not the name.
    matches : callable
        Whether the first `HEAD_BYTES` bytes of a file are of this format.
    reader : str
        ``module:function`` that returns a `tuning.logs.recording.Recording`; imported when first used.
    takes_columns : bool
        Whether the user gives the names of the columns: the reader takes a path and `Columns`, else a path only.
    source : str
        Where the format is described.
    """

    name: str
    suffixes: tuple[str, ...]
    matches: Callable[[bytes], bool]
    reader: str
    takes_columns: bool
    source: str


def _begins_with(magic: bytes) -> Callable[[bytes], bool]:
    def matches(head: bytes) -> bool:
        return head.startswith(magic)

    return matches


def _is_delimited_text(head: bytes) -> bool:
    """Whether the first line of a text has more than one cell."""
    return b"\0" not in head and any(mark in head.partition(b"\n")[0] for mark in (b",", b";", b"\t"))


def _is_blackbox_csv(head: bytes) -> bool:
    """Whether a text has the first column of a decoded blackbox log, or Blackbox Explorer's settings above it."""
    # The log itself begins with such lines, too, perhaps behind bytes of erased memory.
    return b"H Product:" not in head and any(mark in head for mark in (b"loopIteration", b"Blackbox flight data"))


#: The first row that matches reads the file.
FORMATS = (
    LogFormat(
        "PX4 ULog",
        (".ulg",),
        _begins_with(b"ULog\x01\x12\x35"),
        "mimopilot.tuning.logs.ulog:record_ulog",
        False,
        "docs.px4.io/main/en/dev_log/ulog_file_format",
    ),
    LogFormat(
        "ArduPilot dataflash",
        (".bin",),
        _begins_with(b"\xa3\x95"),
        "mimopilot.tuning.logs.dataflash:record_dataflash",
        False,
        "ArduPilot, libraries/AP_Logger/LogStructure.h",
    ),
    LogFormat(
        "MATLAB",
        (".mat",),
        _begins_with(b"MATLAB 5.0 MAT-file"),
        "mimopilot.tuning.logs.tables:record_matlab",
        True,
        "MathWorks, MAT-File Format (R2019b), level 5: versions 5 to 7",
    ),
    LogFormat(
        "Betaflight blackbox",
        (".csv",),
        _is_blackbox_csv,
        "mimopilot.tuning.logs.blackbox:record_blackbox",
        False,
        "betaflight/blackbox-tools, src/blackbox_decode.c; betaflight/blackbox-log-viewer, src/csv-exporter.js",
    ),
    LogFormat(
        "Crazyflie uSD",
        (),  # the deck names its files log00, log01, ...
        is_usd_log,
        "mimopilot.tuning.logs.crazyflie:record_usd",
        False,
        "crazyflie-firmware, src/deck/drivers/src/usddeck.c: versions 1 and 2",
    ),
    LogFormat(
        "Crazyflie CSV",
        (".csv",),
        is_cfclient_csv,
        "mimopilot.tuning.logs.crazyflie:record_cfclient_csv",
        False,
        "cfclient, docs/userguides/userguide_client/logblocks_tab.md",
    ),
    LogFormat(
        "CSV",
        (".csv",),
        _is_delimited_text,
        "mimopilot.tuning.logs.tables:record_csv",
        True,
        "RFC 4180; semicolons and tabs may separate the cells, too",
    ),
)

#: Beginnings of files that are recognised but not read -> what to do instead.
UNSUPPORTED = {
    b"MATLAB 7.3 MAT-file": "a MATLAB 7.3 (HDF5) file; save it with save(..., '-v7')",
    b"\x89HDF\r\n\x1a\n": "a MATLAB 7.3 (HDF5) file; save it with save(..., '-v7')",
    b"FMT,": "an ArduPilot log as text; give the .bin file that it was made from",
    b"H Product:Blackbox": "a Betaflight log; make a CSV file with blackbox_decode --save-headers",
    b"time (us), GPS_": "the positions of a blackbox log; give the CSV file of the same name without .gps",
    b'{"name":"': "the events of a blackbox log; give the CSV file of the same name",
}

SUFFIXES = tuple(dict.fromkeys(suffix for row in FORMATS for suffix in row.suffixes))


def known_formats() -> str:
    """All formats with their file endings, for messages and help texts."""
    return ", ".join(f"{row.name} ({', '.join(row.suffixes) or 'no ending'})" for row in FORMATS)


def log_format(path: Path) -> tuple[LogFormat | None, bytes]:
    """Format of a file, by its content, and its beginning; None: not a flight log.

    Raises
    ------
    TuningError
        When it is a log of a format that cannot be read.
    """
    with path.open("rb") as stream:
        head = stream.read(HEAD_BYTES)
    written = head.lstrip(b"\xff")  # erased flash memory before a blackbox log
    for beginning, advice in UNSUPPORTED.items():
        if written.startswith(beginning):
            raise TuningError(f"{path}: {advice}")
    return next((row for row in FORMATS if row.matches(head)), None), head
