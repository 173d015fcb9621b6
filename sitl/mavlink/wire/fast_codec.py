"""MAVLink 2 codec for the control rate: a message is a tuple of its fields in wire order.

The bytes, layouts and checksums are pymavlink's. Only its message objects are left out: they cost more than
everything else in a control period. For messages sent less often, see `sitl.mavlink.wire.codec.Codec`.
"""

from __future__ import annotations

import os
import socket
import struct
import time
from typing import Any

from pymavlink.dialects.v20 import common as mavlink

from mimopilot.sitl.mavlink.wire.codec import CRC_BYTES, SIGNED, checksum
from mimopilot.sitl.mavlink.wire.signing import SIGNATURE_BYTES

# Fields in wire order, arrays flattened:
SENSOR = mavlink.MAVLink_hil_sensor_message  # time_usec, acc 3, gyro 3, mag 3, 4 of pressure, fields_updated, id
STATE = mavlink.MAVLink_hil_state_quaternion_message  # time_usec, q 4, rates 3, lat lon alt, v 3, airspeeds 2, acc 3
GPS = mavlink.MAVLink_hil_gps_message  # time_usec, lat lon alt, eph epv vel, v 3, cog, fix_type, satellites, id, yaw
ACTUATORS = mavlink.MAVLink_hil_actuator_controls_message  # time_usec, flags, controls 16, mode

#: Bit of HIL_ACTUATOR_CONTROLS.mode, and of its flags.
ARMED: int = mavlink.MAV_MODE_FLAG_SAFETY_ARMED
LOCKSTEP: int = mavlink.HIL_ACTUATOR_CONTROLS_FLAGS_LOCKSTEP

MARK = bytes((mavlink.PROTOCOL_MARKER_V2,))
HEADER = struct.Struct("<BBBBBBHB")  # length, 2 x flags, sequence, system, component, 3 bytes of message id
HEADER_BYTES = len(MARK) + HEADER.size
OVERHEAD = HEADER_BYTES + CRC_BYTES
READ_BYTES = 65536  # read from a link at once; chosen
SPIN_S = 200e-6  # s; chosen longer than a peer at full speed takes to answer

Message = tuple[Any, tuple[Any, ...]]


class FastCodec:
    """Packs and parses messages of one peer.

    Parameters
    ----------
    system, component : int
        Identity in outgoing messages.

    Attributes
    ----------
    skipped : int
        Received bytes that belonged to no message.
    """

    def __init__(self, system: int, component: int) -> None:
        self.system, self.component, self.sequence = system, component, 0
        self.skipped = 0
        self._rest = b""

    def pack(self, kind: Any, *fields: Any) -> bytes:
        """Pack one message; `kind` is its class in pymavlink's dialect."""
        payload = kind.unpacker.pack(*fields).rstrip(b"\0") or b"\0"
        number = kind.id
        header = HEADER.pack(
            len(payload), 0, 0, self.sequence, self.system, self.component, number & 0xFFFF, number >> 16
        )
        self.sequence = (self.sequence + 1) % 256
        body = header + payload
        return MARK + body + checksum(body, kind.crc_extra)

    def parse(self, data: bytes) -> list[Message]:
        """Parse the complete messages in the stream so far, each as its kind and its fields.

        An incomplete frame never holds back a complete one behind it. Otherwise noise that looks like the start of
        a long message would block a peer in lockstep for ever.
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
        """End of the frame that may start at `at`."""
        if len(buffer) - at < OVERHEAD:
            return at + OVERHEAD + 1
        return at + OVERHEAD + buffer[at + 1] + (SIGNATURE_BYTES if buffer[at + 2] & SIGNED else 0)

    @staticmethod
    def _message(frame: bytes) -> Message | None:
        """Decode a complete frame; None when it is not valid."""
        length, flags, _, _, _, _, low, high = HEADER.unpack_from(frame, 1)
        kind = mavlink.mavlink_map.get(low + (high << 16))
        if kind is None or flags & ~SIGNED:
            return None
        stop = HEADER_BYTES + length
        if checksum(frame[1:stop], kind.crc_extra) != frame[stop : stop + CRC_BYTES]:
            return None
        size = kind.unpacker.size
        return kind, kind.unpacker.unpack(frame[HEADER_BYTES:stop][:size].ljust(size, b"\0"))


def receive(connection: socket.socket, spin: float = 0.0) -> bytes | None:
    """Read a non-blocking socket, polling for up to `spin` s; None when no data came, empty when the peer closed it.

    Waking from sleep takes longer than a peer at full speed needs to answer, so both ends poll for `SPIN_S` first.
    Polling yields the processor to other processes.
    """
    until = time.monotonic() + spin
    while True:
        try:
            return connection.recv(READ_BYTES)
        except BlockingIOError:
            if time.monotonic() >= until:
                return None
            os.sched_yield()
