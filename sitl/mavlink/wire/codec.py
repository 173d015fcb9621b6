"""MAVLink 2 codec: packs messages, and finds intact, trusted frames in any received bytes."""

from __future__ import annotations

import re
from collections.abc import Container, Iterator
from typing import Any

from pymavlink.dialects.v20 import common as mavlink

from mimopilot.sitl.mavlink.wire.signing import SIGNATURE_BYTES, Signer

#: Identity of the simulated vehicle: the first system, component MAV_COMP_ID_AUTOPILOT1.
SYSTEM, COMPONENT = 1, 1
V1, V2 = mavlink.PROTOCOL_MARKER_V1, mavlink.PROTOCOL_MARKER_V2
HEADER_BYTES: dict[int, int] = {V1: mavlink.HEADER_LEN_V1, V2: mavlink.HEADER_LEN_V2}
SIGNED = mavlink.MAVLINK_IFLAG_SIGNED
CRC_BYTES = 2  # CRC-16/MCRF4XX
MAVLINK_VERSION = 3  # HEARTBEAT.mavlink_version of MAVLink 2
MARKER = re.compile(b"[\xfd\xfe]")
KINDS: dict[int, Any] = mavlink.mavlink_map
EVERY = frozenset(KINDS)


class Codec:
    """Packs and parses messages of one peer.

    Parameters
    ----------
    system, component : int
        Identity in outgoing messages.
    signer : Signer, optional
        Signs outgoing frames; incoming frames without a valid signature are then dropped.
    wanted : container of int
        Message numbers to decode; others are ignored.

    Attributes
    ----------
    refused : int
        Intact frames dropped because their signature was missing, wrong or old.
    unasked : int
        Signed frames accepted unchecked, because this end has no key.
    """

    def __init__(
        self,
        system: int = SYSTEM,
        component: int = COMPONENT,
        signer: Signer | None = None,
        wanted: Container[int] = EVERY,
    ) -> None:
        self.signer, self.wanted = signer, wanted
        self.refused = self.unasked = 0
        self._rest = b""
        self._mav = mavlink.MAVLink(None, srcSystem=system, srcComponent=component)

    def pack(self, message: Any) -> bytes:
        """Bytes of one message, with this peer's sequence number."""
        frame: bytes = message.pack(self._mav)
        self._mav.seq = (self._mav.seq + 1) % 256
        if self.signer is None:
            return frame
        body = frame[1:2] + bytes([frame[2] | SIGNED]) + frame[3:-CRC_BYTES]
        return self.signer.sign(frame[:1] + body + checksum(body, message.crc_extra))

    def parse(self, data: bytes) -> Iterator[Any]:
        """Yield the complete messages in the stream so far; damaged ones are dropped."""
        return (message for message in self.search(data) if message is not None)

    def search(self, data: bytes) -> Iterator[Any]:
        """Yield as `parse`, and None after each damaged frame, so that a caller short of time can pause.

        Every byte may look like the start of a long frame, whose checksum must then be computed.
        """
        data = self._rest + data
        self._rest = b""
        place = 0
        while found := MARKER.search(data, place):
            place = found.start()
            length = _frame_length(data, place)
            if place + length > len(data):
                self._rest = data[place:]
                return
            frame = data[place : place + length]
            if not _is_intact(frame):
                place += 1
                yield None
                continue
            place += length
            yield from self._read(frame)

    def parse_datagram(self, data: bytes) -> Iterator[Any]:
        """Yield the messages of one datagram, which holds whole frames; stop at the first broken one."""
        place = 0
        while place < len(data) and data[place] in HEADER_BYTES:
            frame = data[place : place + _frame_length(data, place)]
            if not _is_intact(frame):
                return
            place += len(frame)
            yield from self._read(frame)

    def _read(self, frame: bytes) -> Iterator[Any]:
        """Yield the message of an intact frame, unless it is not trusted or not wanted."""
        signed = _is_signed(frame)
        if self.signer is None:
            self.unasked += signed
        elif not (signed and self.signer.accept(frame, frame[5], frame[6])):
            self.refused += 1
            return
        if _number(frame) not in self.wanted:
            return
        try:
            message = self._mav.decode(bytearray(frame))
        except mavlink.MAVError:
            return
        yield message


def _is_signed(frame: bytes) -> bool:
    return frame[0] == V2 and bool(frame[2] & SIGNED)


def _number(frame: bytes) -> int:
    """Message number of a frame."""
    return frame[5] if frame[0] == V1 else int.from_bytes(frame[7:10], "little")


def _frame_length(data: bytes, place: int) -> int:
    """Length of the frame at a marker, bytes; 0: not a frame.

    While the header is incomplete: the length of the shortest frame.
    """
    size = HEADER_BYTES[data[place]]
    header, shortest = data[place : place + size], size + CRC_BYTES
    if len(header) < size:
        return shortest
    if _number(header) not in KINDS or (header[0] == V2 and header[2] & ~SIGNED):
        return 0
    return shortest + header[1] + (SIGNATURE_BYTES if _is_signed(header) else 0)


def _is_intact(frame: bytes) -> bool:
    """Whether the bytes are a complete frame with the right checksum."""
    if not frame or len(frame) < _frame_length(frame, 0):
        return False
    end = len(frame) - (SIGNATURE_BYTES if _is_signed(frame) else 0)
    return checksum(frame[1 : end - CRC_BYTES], KINDS[_number(frame)].crc_extra) == frame[end - CRC_BYTES : end]


def checksum(body: bytes, extra: int) -> bytes:
    """MAVLink checksum over header and payload; `extra` is the message's CRC_EXTRA."""
    crc: int = mavlink.x25crc(body + bytes([extra])).crc
    return crc.to_bytes(CRC_BYTES, "little")
