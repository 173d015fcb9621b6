"""ArduPilot's JSON simulator protocol: servo packets in, one line of JSON out.

As in ArduPilot's SIM_JSON.h and SIM_JSON.cpp (master of March 2026). A packet is little endian: magic (uint16), frame
rate (uint16, Hz), frame count (uint32), and a pulse width (uint16, us) for each of 16 or 32 channels.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from typing import NamedTuple

from mimopilot.sitl.physics.rigid_body import MAX_ROTORS

#: Magic number -> its packet.
PACKETS = {18458: struct.Struct("<HHI16H"), 29569: struct.Struct("<HHI32H")}
#: Longest packet, bytes.
LONGEST = max(packet.size for packet in PACKETS.values())
#: us; MOT_PWM_MIN and MOT_PWM_MAX, and servo limits, of every default parameter set.
PULSE_OFF, PULSE_FULL = 1000, 2000
#: Frame rates that the plant accepts, Hz: as `mimopilot plant --rate`.
SLOWEST, FASTEST = 1, 10_000

#: ArduPilot looks for a line between two line feeds, and in it for `"key":`. It reads gyro and accelerometer in single
#: precision.
_LINE = (
    '\n{"timestamp":%.9f,"imu":{"gyro":[%.9g,%.9g,%.9g],"accel_body":[%.9g,%.9g,%.9g]},'
    '"position":[%.9g,%.9g,%.9g],"velocity":[%.9g,%.9g,%.9g],"quaternion":[%.9g,%.9g,%.9g,%.9g]}\n'
)


class ServoPacket(NamedTuple):
    """Outputs of one frame: frame rate (Hz), its number, and thrust fractions of motors 1 to 16."""

    rate: int
    number: int
    controls: list[float]


def parse_servos(data: bytes) -> ServoPacket | None:
    """Parse a packet; None when it is none. Motors are on channels 1 to 16, in this order."""
    packet = PACKETS.get(int.from_bytes(data[:2], "little"))
    if packet is None or len(data) != packet.size:
        return None
    _, rate, count, *pulses = packet.unpack(data)
    if not SLOWEST <= rate <= FASTEST:
        return None
    scale = 1.0 / (PULSE_FULL - PULSE_OFF)
    return ServoPacket(rate, count, [min(max((p - PULSE_OFF) * scale, 0.0), 1.0) for p in pulses[:MAX_ROTORS]])


def motion_line(seconds: float, readings: Sequence[float], state: Sequence[float]) -> bytes:
    """The line that answers a packet.

    Parameters
    ----------
    seconds : float, s
        Simulated time.
    readings : sequence of float
        Specific force (3, m/s^2), then body rates (3, rad/s); more is not used.
    state : sequence of float
        See `sitl.physics.rigid_body`.
    """
    return (_LINE % (seconds, *readings[3:6], *readings[:3], *state[:10])).encode()
