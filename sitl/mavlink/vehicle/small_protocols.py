"""Replies to small protocols that ground stations wait for: FTP, missions, time synchronisation, ping."""

from __future__ import annotations

import time
from typing import Any

from pymavlink.dialects.v20 import common as mavlink

FTP_NAK, FTP_UNKNOWN_COMMAND = 129, 7  # opcode and error code, mavlink.io/en/services/ftp.html
FTP_BYTES = 251  # length of FILE_TRANSFER_PROTOCOL.payload


def refuse_files(message: Any) -> list[Any]:
    """NAK to any FTP request: the vehicle has no files. Without an answer MAVProxy waits 11 s."""
    request = bytes(message.payload)
    sequence = (int.from_bytes(request[:2], "little") + 1) % 65536
    payload = bytearray(FTP_BYTES)
    payload[:2] = sequence.to_bytes(2, "little")
    payload[2] = request[2]  # session
    # Opcode, size, the request's opcode, data: the error code.
    payload[3], payload[4], payload[5], payload[12] = FTP_NAK, 1, request[3], FTP_UNKNOWN_COMMAND
    sender = message.get_srcSystem(), message.get_srcComponent()
    return [mavlink.MAVLink_file_transfer_protocol_message(0, *sender, bytes(payload))]


def no_mission(message: Any) -> list[Any]:
    """Report an empty mission, fence or rally list."""
    sender = message.get_srcSystem(), message.get_srcComponent()
    return [mavlink.MAVLink_mission_count_message(*sender, 0, message.mission_type)]


def refuse_mission(message: Any) -> list[Any]:
    """Refuse an upload: missions are not supported."""
    sender = message.get_srcSystem(), message.get_srcComponent()
    return [mavlink.MAVLink_mission_ack_message(*sender, mavlink.MAV_MISSION_UNSUPPORTED, message.mission_type)]


def clear_mission(message: Any) -> list[Any]:
    """Accept clearing the mission, which is always empty."""
    sender = message.get_srcSystem(), message.get_srcComponent()
    return [mavlink.MAVLink_mission_ack_message(*sender, mavlink.MAV_MISSION_ACCEPTED, message.mission_type)]


def timesync(message: Any) -> list[Any]:
    """Answer a request with our time; answers (tc1 set) are ignored."""
    if message.tc1 != 0:
        return []
    return [mavlink.MAVLink_timesync_message(time.monotonic_ns(), message.ts1)]


def ping(message: Any) -> list[Any]:
    """Answer a request; answers (with a target) are ignored."""
    if message.target_system != 0:
        return []
    sender = message.get_srcSystem(), message.get_srcComponent()
    return [mavlink.MAVLink_ping_message(message.time_usec, message.seq, *sender)]


#: Message name -> function that returns the answers.
PROTOCOLS = {
    "FILE_TRANSFER_PROTOCOL": refuse_files,
    "MISSION_REQUEST_LIST": no_mission,
    "MISSION_COUNT": refuse_mission,
    "MISSION_CLEAR_ALL": clear_mission,
    "TIMESYNC": timesync,
    "PING": ping,
}
