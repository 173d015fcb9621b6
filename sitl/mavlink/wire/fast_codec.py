"""MAVLink 2 at full rate: a message is a tuple of its fields in the order of the wire.

The bytes, the layouts and the checks are pymavlink's; only the objects between bytes and numbers are left out,
which cost more than everything else in a control period. `Codec` in `sitl.mavlink.wire.link` is for everything that
is not sent hundreds of times a second.
"""

from __future__ import annotations

import os
import socket
import struct
import time
from typing import Any

from pymavlink.dialects.v20 import common as mavlink
from pymavlink.generator.mavcrc import x25crc

# Fields in wire order, arrays flattened:
SENSOR = mavlink.MAVLink_hil_sensor_message  # time_usec, acc 3, gyro 3, mag 3, 4 of pressure, fields_updated, id
STATE = mavlink.MAVLink_hil_state_quaternion_message  # time_usec, q 4, rates 3, lat lon alt, v 3, airspeeds 2, acc 3
GPS = mavlink.MAVLink_hil_gps_message  # time_usec, lat lon alt, eph epv vel, v 3, cog, fix_type, satellites, id, yaw
ACTUATORS = mavlink.MAVLink_hil_actuator_controls_message  # time_usec, flags, controls 16, mode

MARK = b"\xfd"
HEADER = struct.Struct("<BBBBBBHB")  # length, 2 x flags, sequence, system, component, 3 bytes of message id
OVERHEAD = 12  # mark, header, checksum
SIGNED, SIGNATURE = 1, 13
SPIN_S = 200e-6

Message = tuple[Any, tuple[Any, ...]]


def _checksum(data: bytes, extra: int) -> bytes:
    value: int = x25crc(data + bytes((extra,))).crc
    return value.to_bytes(2, "little")


class LeanCodec:
    """Packs and parses messages of one peer.

    Parameters
    ----------
    system, component : int
        Identity in outgoing messages.

    Attributes
    ----------
    skipped : int
        Bytes received so far that belonged to no message.
    """

    def __init__(self, system: int, component: int) -> None:
        self.system, self.component, self.sequence = system, component, 0
        self.skipped = 0
        self._rest = b""

    def pack(self, kind: Any, *fields: Any) -> bytes:
        """Bytes of one message; `kind` is its class in pymavlink's dialect."""
        payload = kind.unpacker.pack(*fields).rstrip(b"\0") or b"\0"
        number = kind.id
        header = HEADER.pack(
            len(payload), 0, 0, self.sequence, self.system, self.component, number & 0xFFFF, number >> 16
        )
        self.sequence = (self.sequence + 1) % 256
        body = header + payload
        return MARK + body + _checksum(body, kind.crc_extra)

    def parse(self, data: bytes) -> list[Message]:
        """Whole messages in the stream so far, each as its kind and its fields.

        A frame that has only begun never holds back a whole one behind it: noise that looks like the beginning
        of a long message would make a peer in lockstep wait for ever.
        """
        buffer = self._rest + data
        found: list[Message] = []
        done = at = 0
        begun = -1
        while (at := buffer.find(MARK, at)) >= 0:
            end = self._end(buffer, at)
            message = None if end > len(buffer) else self._message(buffer[at:end])
            if message is not None:
                found.append(message)
                self.skipped += at - done
                done = at = end
                begun = -1
                continue
            if end > len(buffer) and begun < 0:
                begun = at
            at += 1
        keep = begun if begun >= 0 else len(buffer)
        self.skipped += keep - done
        self._rest = buffer[keep:]
        return found

    @staticmethod
    def _end(buffer: bytes, at: int) -> int:
        """Where the frame that may begin at `at` ends."""
        if len(buffer) - at < OVERHEAD:
            return at + OVERHEAD + 1
        return at + OVERHEAD + buffer[at + 1] + (SIGNATURE if buffer[at + 2] & SIGNED else 0)

    @staticmethod
    def _message(frame: bytes) -> Message | None:
        """What a whole frame holds; None when it is none."""
        length, flags, _, _, _, _, low, high = HEADER.unpack_from(frame, 1)
        kind = mavlink.mavlink_map.get(low + (high << 16))
        if kind is None or flags & ~SIGNED:
            return None
        stop = 10 + length
        if _checksum(frame[1:stop], kind.crc_extra) != frame[stop : stop + 2]:
            return None
        size = kind.unpacker.size
        return kind, kind.unpacker.unpack(frame[10:stop][:size].ljust(size, b"\0"))


def receive(connection: socket.socket, spin: float = 0.0) -> bytes | None:
    """What has come to a non-blocking socket, or comes within `spin` s; None when nothing, empty when the peer left.

    A process that sleeps takes longer to wake than a peer at full speed takes to answer: both look for `SPIN_S`
    before they sleep. Whoever else wants the processor gets it.
    """
    until = time.monotonic() + spin
    while True:
        try:
            return connection.recv(65536)
        except BlockingIOError:
            if time.monotonic() >= until:
                return None
            os.sched_yield()
