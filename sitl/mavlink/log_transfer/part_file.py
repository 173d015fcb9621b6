"""A download that is not finished: its bytes so far, and beside them a record of which are missing.

NAME.part.json says which log NAME.part is a part of and what is missing. It is written after the bytes that it does not
list are on the disk, so that a download can go on after any interruption.
"""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

from mimopilot.common.files import inside, write_atomically
from mimopilot.sitl.errors import SitlError
from mimopilot.sitl.mavlink.log_transfer.missing_bytes import MissingBytes
from mimopilot.sitl.mavlink.wire.ftp import crc32

#: Bytes received between two writings of the record; chosen: a killed download repeats no more than that.
RECORD_EVERY = 1 << 18
#: Bytes read at once.
BLOCK = 1 << 20


class PartFile:
    """The bytes of one log that have arrived.

    Parameters
    ----------
    folder : Path
        Where the log goes; it is created.
    name : str
        File name of the log.
    source : str
        Which log of which vehicle it is.
    size : int
        Of the log, bytes.
    grows : bool
        A part of the same source that is shorter is its beginning.

    Attributes
    ----------
    missing : MissingBytes
    resumed : int
        Bytes that were there at the start.

    Raises
    ------
    SitlError
        If there is a part of another log, or no space on the disk.
    """

    def __init__(self, folder: Path, name: str, source: str, size: int, grows: bool = False) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self.target = inside(folder, name)
        self.path, self.record = inside(folder, f"{name}.part"), inside(folder, f"{name}.part.json")
        self.source, self.size = source, size
        self.missing = self._load(grows) if self.path.exists() else MissingBytes([(0, size)])
        self.resumed = self.held
        free = shutil.disk_usage(folder).free
        if free < self.missing.total:
            raise SitlError(
                f"{folder}: {free / 1e6:.1f} MB are free, the log needs {self.missing.total / 1e6:.1f} MB more; make "
                "space, or give another --out",
                exit_code=1,
            )
        self._unrecorded = 0
        self._save()
        self._file = os.open(self.path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW, 0o666)

    def _load(self, grows: bool) -> MissingBytes:
        remove = f"remove it and {self.record.name}, or give another --out"
        try:
            known = json.loads(self.record.read_text())
            source, size, ranges = known["source"], int(known["size"]), [(int(a), int(b)) for a, b in known["missing"]]
            if any(b > size for _, b in ranges):
                raise ValueError("beyond the end")
            missing = MissingBytes(ranges)
        except (OSError, ValueError, TypeError, KeyError) as error:
            raise SitlError(f"{self.path}: nothing says which bytes it holds ({error}); {remove}") from error
        if source != self.source or size > self.size or (size < self.size and not grows):
            raise SitlError(
                f"{self.path}: is a part of another log ({source}, {size} bytes; this one is {self.source}, "
                f"{self.size} bytes); {remove}"
            )
        if size < self.size:
            missing = MissingBytes([*missing.ranges(), (size, self.size)])
        held = self.path.stat().st_size
        # Bytes behind the end of a file that was cut are zeros, not content.
        cut = [(max(a, held), b) for a, b in _present(missing, self.size) if b > held]
        return MissingBytes([*missing.ranges(), *cut])

    def write(self, offset: int, data: bytes) -> int:
        """Write bytes at an offset; returns how many of them were missing.

        Raises
        ------
        SitlError
            If the disk is full, or cannot be written.
        """
        data = data[: max(0, self.size - offset)]
        new = self.missing.remove(offset, offset + len(data))
        if not new:
            return 0
        place = 0
        try:
            while place < len(data):
                place += os.pwrite(self._file, data[place:], offset + place)
            self._unrecorded += new
            if self._unrecorded >= RECORD_EVERY:
                os.fdatasync(self._file)
                self._save()
        except OSError as error:
            self.missing = MissingBytes([*_outside(self.missing.ranges(), offset, offset + len(data))])
            raise SitlError(f"{self.path}: cannot be written: {error.strerror}", exit_code=1) from error
        return new

    def _save(self) -> None:
        text = {"source": self.source, "size": self.size, "missing": self.missing.ranges()}
        write_atomically(self.record, json.dumps(text) + "\n")
        self._unrecorded = 0

    @property
    def held(self) -> int:
        """Number of bytes that are there."""
        return self.size - self.missing.total

    @property
    def progress(self) -> str:
        """How much is there, for messages."""
        return f"{self.path.name} holds {self.held} of {self.size} bytes"

    def close(self) -> None:
        """Keep the part for another time."""
        with suppress(OSError):  # on a full disk the older record is right, too: it lists more as missing
            os.fsync(self._file)
            self._save()
        os.close(self._file)

    def checksum(self) -> int:
        """`wire.ftp.crc32` of the part."""
        return file_crc32(self.path)

    def discard(self) -> None:
        """Remove the closed part: its bytes are wrong, or needed no more."""
        self.path.unlink()
        self.record.unlink()

    def finish(self) -> bool:
        """Give the closed, complete part its name; returns False if a file with the same content had it already.

        Raises
        ------
        SitlError
            If a file with another content has it.
        """
        if self.target.exists():
            if not _same(self.target, self.path):
                raise different(self.target)
            self.discard()
            return False
        self.path.replace(self.target)
        self.record.unlink()
        return True


def different(path: Path) -> SitlError:
    """The error that a file exists, but has another content."""
    return SitlError(f"{path}: exists and has another content than the vehicle's log; rename it, or give another --out")


def file_crc32(path: Path) -> int:
    """`wire.ftp.crc32` of a file."""
    checksum = 0
    for block in _blocks(path):
        checksum = crc32(block, checksum)
    return checksum


def _blocks(path: Path) -> Iterator[bytes]:
    with path.open("rb") as stream:
        while block := stream.read(BLOCK):
            yield block


def _same(one: Path, other: Path) -> bool:
    return one.stat().st_size == other.stat().st_size and all(
        a == b for a, b in zip(_blocks(one), _blocks(other), strict=True)
    )


def _present(missing: MissingBytes, size: int) -> Iterator[tuple[int, int]]:
    """Ranges that are not missing."""
    place = 0
    for start, end in [*missing.ranges(), (size, size)]:
        if place < start:
            yield place, start
        place = end


def _outside(ranges: list[tuple[int, int]], start: int, end: int) -> Iterator[tuple[int, int]]:
    """Ranges, and the one from start to end, without overlap."""
    for low, high in ranges:
        if low < start:
            yield low, min(high, start)
        if high > end:
            yield max(low, end), high
    yield start, end
