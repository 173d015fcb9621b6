"""Replies to small protocols that ground stations wait for: missions, time synchronisation, ping."""

from __future__ import annotations

import time
from typing import Any

from pymavlink.dialects.v20 import common as mavlink


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
    "MISSION_REQUEST_LIST": no_mission,
    "MISSION_COUNT": refuse_mission,
    "MISSION_CLEAR_ALL": clear_mission,
    "TIMESYNC": timesync,
    "PING": ping,
}
