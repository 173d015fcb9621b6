"""MAVLink 2 over sockets: packing, and finding whole, sound and trusted frames in whatever arrives."""

from __future__ import annotations

import re
import socket
from collections.abc import Container, Iterator
from typing import Any

from mimopilot.sitl.errors import SitlError
from mimopilot.sitl.mavlink.wire.signing import SIGNATURE_BYTES, Signer
from pymavlink.dialects.v20 import common as mavlink

SYSTEM, COMPONENT = 1, 1
LOOPBACK = "127.0.0.1"
V1, V2 = mavlink.PROTOCOL_MARKER_V1, mavlink.PROTOCOL_MARKER_V2
HEADER_BYTES: dict[int, int] = {V1: mavlink.HEADER_LEN_V1, V2: mavlink.HEADER_LEN_V2}
SIGNED = mavlink.MAVLINK_IFLAG_SIGNED
CRC_BYTES = 2
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
        Signs what goes out; what comes in without its signature is then dropped.
    wanted : container of int
        Numbers of the messages to read; the others are passed over.

    Attributes
    ----------
    refused : int
        Sound frames that were dropped because their signature was missing, wrong or old.
    unasked : int
        Signed frames that were taken as they are, because there is no key here.
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
        return self.signer.sign(frame[:1] + body + _crc(body, message.crc_extra))

    def parse(self, data: bytes) -> Iterator[Any]:
        """Whole messages in the stream so far; damaged ones are dropped."""
        return (message for message in self.search(data) if message is not None)

    def search(self, data: bytes) -> Iterator[Any]:
        """The same, and None after each damaged one: who has little time can pause there.

        Every byte of a chunk may look like the beginning of a long frame, whose checksum must be looked at.
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
            if not _is_sound(frame):
                place += 1
                yield None
                continue
            place += length
            yield from self._read(frame)

    def parse_datagram(self, data: bytes) -> Iterator[Any]:
        """Messages of a datagram, which holds whole frames: nothing behind a broken one is looked at."""
        place = 0
        while place < len(data) and data[place] in HEADER_BYTES:
            frame = data[place : place + _frame_length(data, place)]
            if not _is_sound(frame):
                return
            place += len(frame)
            yield from self._read(frame)

    def _read(self, frame: bytes) -> Iterator[Any]:
        """The message of a sound frame; nothing when it is not trusted or not wanted."""
        signed = _is_signed(frame)
        if self.signer is None:
            self.unasked += signed
        elif not (signed and self.signer.accepts(frame, frame[5], frame[6])):
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
    """Number of the message in a frame."""
    return frame[5] if frame[0] == V1 else int.from_bytes(frame[7:10], "little")


def _frame_length(data: bytes, place: int) -> int:
    """Bytes of the frame that a marker begins; 0: it cannot be one. The shortest, while its header is not there yet."""
    size = HEADER_BYTES[data[place]]
    header, shortest = data[place : place + size], size + CRC_BYTES
    if len(header) < size:
        return shortest
    if _number(header) not in KINDS or (header[0] == V2 and header[2] & ~SIGNED):
        return 0
    return shortest + header[1] + (SIGNATURE_BYTES if _is_signed(header) else 0)


def _is_sound(frame: bytes) -> bool:
    """Whether what looks like a whole frame has the right checksum."""
    if not frame or len(frame) < _frame_length(frame, 0):
        return False
    end = len(frame) - (SIGNATURE_BYTES if _is_signed(frame) else 0)
    return _crc(frame[1 : end - CRC_BYTES], KINDS[_number(frame)].crc_extra) == frame[end - CRC_BYTES : end]


def _crc(body: bytes, extra: int) -> bytes:
    checksum: int = mavlink.x25crc(body + bytes([extra])).crc
    return checksum.to_bytes(CRC_BYTES, "little")


def listen(host: str, port: int, backlog: int = 1, option: str = "--port") -> socket.socket:
    """A listening TCP socket.

    Raises
    ------
    SitlError
        When the port is in use.
    """
    server = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    server.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        server.bind((host, port))
        server.listen(backlog)
    except OSError as error:
        server.close()
        raise SitlError(
            f"TCP port {port} on {host} cannot be used: {error.strerror or error}; is another simulator "
            f"running? Choose another port with {option}"
        ) from error
    return server


def udp_socket(
    host: str, port: int, advice: str = "is another vehicle running? Choose another port with --vehicle-port"
) -> socket.socket:
    """A non-blocking UDP socket bound to a local port.

    Raises
    ------
    SitlError
        When the port is in use.
    """
    link = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        link.bind((host, port))
    except OSError as error:
        link.close()
        raise SitlError(f"UDP port {port} on {host} cannot be used: {error.strerror or error}; {advice}") from error
    link.setblocking(False)
    return link
