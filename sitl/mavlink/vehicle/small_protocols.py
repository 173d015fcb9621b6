"""Small protocols that ground stations wait for: files, missions, time, echo."""

from __future__ import annotations

import time
from typing import Any

from pymavlink.dialects.v20 import common as mavlink

FTP_NAK, FTP_UNKNOWN_COMMAND = 129, 7


def refuse_files(message: Any) -> list[Any]:
    """NAK: there are no files here. Without an answer MAVProxy waits 11 s."""
    asked = bytes(message.payload)
    sequence = (int.from_bytes(asked[:2], "little") + 1) % 65536
    payload = bytearray(251)
    payload[:2] = sequence.to_bytes(2, "little")
    payload[2] = asked[2]
    payload[3], payload[4], payload[5], payload[12] = FTP_NAK, 1, asked[3], FTP_UNKNOWN_COMMAND
    sender = message.get_srcSystem(), message.get_srcComponent()
    return [mavlink.MAVLink_file_transfer_protocol_message(0, *sender, bytes(payload))]


def no_mission(message: Any) -> list[Any]:
    """A mission, fence or rally list of no items."""
    sender = message.get_srcSystem(), message.get_srcComponent()
    return [mavlink.MAVLink_mission_count_message(*sender, 0, message.mission_type)]


def refuse_mission(message: Any) -> list[Any]:
    """A mission is not flown."""
    sender = message.get_srcSystem(), message.get_srcComponent()
    return [mavlink.MAVLink_mission_ack_message(*sender, mavlink.MAV_MISSION_UNSUPPORTED, message.mission_type)]


def mission_cleared(message: Any) -> list[Any]:
    """There is none anyway."""
    sender = message.get_srcSystem(), message.get_srcComponent()
    return [mavlink.MAVLink_mission_ack_message(*sender, mavlink.MAV_MISSION_ACCEPTED, message.mission_type)]


def timesync(message: Any) -> list[Any]:
    """Our time to theirs; what is itself an answer is left alone."""
    if message.tc1 != 0:
        return []
    return [mavlink.MAVLink_timesync_message(time.monotonic_ns(), message.ts1)]


def ping(message: Any) -> list[Any]:
    """Echo to a request; what is itself an answer is left alone."""
    if message.target_system != 0:
        return []
    sender = message.get_srcSystem(), message.get_srcComponent()
    return [mavlink.MAVLink_ping_message(message.time_usec, message.seq, *sender)]


#: Message -> its answers.
PROTOCOLS = {
    "FILE_TRANSFER_PROTOCOL": refuse_files,
    "MISSION_REQUEST_LIST": no_mission,
    "MISSION_COUNT": refuse_mission,
    "MISSION_CLEAR_ALL": mission_cleared,
    "TIMESYNC": timesync,
    "PING": ping,
}
