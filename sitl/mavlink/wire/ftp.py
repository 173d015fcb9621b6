"""MAVLink FTP: the payload of FILE_TRANSFER_PROTOCOL, and its checksum; see mavlink.io/en/services/ftp.html."""

from __future__ import annotations

import os
import struct
import zlib
from enum import IntEnum
from typing import NamedTuple

#: Length of FILE_TRANSFER_PROTOCOL.payload, of its header, and of the data behind it, bytes.
PAYLOAD_BYTES = 251
_HEADER = struct.Struct("<HBBBBBxI")
DATA_BYTES = PAYLOAD_BYTES - _HEADER.size
#: Sequence numbers are uint16.
SEQUENCES = 1 << 16
#: Name of the folder of logs that the MAVLink guide defines for every vehicle.
LOG_FOLDER = "@MAV_LOG"


class Opcode(IntEnum):
    """Requests that are used here, and the two kinds of reply."""

    NONE = 0
    TERMINATE = 1
    RESET = 2
    LIST = 3
    OPEN = 4
    READ = 5
    CRC = 14
    BURST = 15
    ACK = 128
    NAK = 129


class Nak(IntEnum):
    """Error codes of a NAK."""

    FAIL = 1
    ERRNO = 2
    DATA_SIZE = 3
    SESSION = 4
    NO_SESSIONS = 5
    END = 6
    UNKNOWN_COMMAND = 7
    NOT_FOUND = 10


_REASONS = {
    Nak.FAIL: "it failed",
    Nak.DATA_SIZE: "invalid size",
    Nak.SESSION: "the file is not open",
    Nak.NO_SESSIONS: "too many files are open",
    Nak.END: "end of the file",
    Nak.UNKNOWN_COMMAND: "the command is not supported",
    Nak.NOT_FOUND: "not found",
}


class FtpPacket(NamedTuple):
    """One payload.

    Attributes
    ----------
    sequence : int
        That of a reply is one more than that of its request; in a burst it counts on.
    session : int
        Number of the open file.
    opcode : int
        A request's opcode, or `Opcode.ACK` or `Opcode.NAK`.
    request : int
        Reply: opcode of the request.
    complete : bool
        Reply: the last one of a burst.
    offset : int
        In the file, bytes; in a listing, entries.
    data : bytes
        Path, content, or error code.
    size : int
        Request to read: number of bytes; else the length of the data.
    """

    sequence: int
    session: int
    opcode: int
    request: int = 0
    complete: bool = False
    offset: int = 0
    data: bytes = b""
    size: int = 0

    def pack(self) -> bytes:
        """The payload."""
        head = _HEADER.pack(
            self.sequence,
            self.session,
            self.opcode,
            self.size or len(self.data),
            self.request,
            self.complete,
            self.offset,
        )
        return (head + self.data).ljust(PAYLOAD_BYTES, b"\0")

    @classmethod
    def unpack(cls, payload: bytes) -> FtpPacket:
        """Of a payload of `PAYLOAD_BYTES`."""
        sequence, session, opcode, size, request, complete, offset = _HEADER.unpack_from(payload)
        data = payload[_HEADER.size : _HEADER.size + size]
        return cls(sequence, session, opcode, request, bool(complete), offset, data, size)

    def reply(self, data: bytes = b"") -> FtpPacket:
        """ACK of this request."""
        following = (self.sequence + 1) % SEQUENCES
        return FtpPacket(following, self.session, Opcode.ACK, self.opcode, False, self.offset, data)

    def refuse(self, code: int, errno: int = 0) -> FtpPacket:
        """NAK of this request; `errno` belongs to `Nak.ERRNO`."""
        data = bytes([code, errno % 256]) if code == Nak.ERRNO else bytes([code])
        return self.reply(data)._replace(opcode=Opcode.NAK)

    @property
    def path(self) -> str:
        """Path in a request."""
        return self.data.split(b"\0")[0].decode("utf-8", "replace")

    @property
    def code(self) -> int:
        """Error code of a NAK; 0: none."""
        return self.data[0] if self.opcode == Opcode.NAK and self.data else 0

    @property
    def reason(self) -> str:
        """Text of a NAK."""
        if self.code == Nak.ERRNO:
            number = self.data[1] if len(self.data) > 1 else 0
            return f"error {number} ({os.strerror(number)})"
        return _REASONS.get(Nak(self.code), "") if self.code in _REASONS else f"error code {self.code}"


def crc32(data: bytes, before: int = 0) -> int:
    """Checksum of CalcFileCRC32, as PX4 and ArduPilot compute it: polynomial 0x04C11DB7 reflected, no inversions.

    Parameters
    ----------
    data : bytes
        To add.
    before : int
        Checksum of what precedes it; 0 at the start.
    """
    return zlib.crc32(data, before ^ 0xFFFFFFFF) ^ 0xFFFFFFFF
