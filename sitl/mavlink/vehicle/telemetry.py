"""Telemetry schedule: sends each message at its rate."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

from pymavlink.dialects.v20 import common as mavlink

from mimopilot.sitl.autopilot.flight_modes import Severity
from mimopilot.sitl.mavlink.vehicle.telemetry_messages import NO_STREAM, TELEMETRY_MESSAGES
from mimopilot.sitl.mavlink.vehicle.vehicle_state import VehicleState

MAX_RATE = 250.0  # Hz, of one message: the default control rate
STATUSTEXT_BYTES = 50  # length of STATUSTEXT.text


class Telemetry:
    """Schedules and builds the telemetry messages.

    Parameters
    ----------
    state : VehicleState
        What they are made from.
    """

    def __init__(self, state: VehicleState) -> None:
        self.state = state
        self.rates = {number: entry.rate for number, entry in TELEMETRY_MESSAGES.items()}
        self.due = {number: 0.0 for number, rate in self.rates.items() if rate > 0}
        self.next = 0.0

    def set_rate(self, number: int, rate: float) -> None:
        """Set the rate of a message, Hz, at most `MAX_RATE`; 0: never."""
        self.rates[number] = min(rate, MAX_RATE)
        self.due.pop(number, None)
        if rate > 0:
            self.due[number] = self.next = 0.0

    def hurry(self, number: int) -> None:
        """Send a scheduled message at once, because its content has changed."""
        if number in self.due:
            self.due[number] = self.next = 0.0

    def set_stream(self, stream: int, rate: float) -> None:
        """Set the rate of all messages of a data stream, Hz; stream 0 is all of them."""
        for number, entry in TELEMETRY_MESSAGES.items():
            if entry.stream != NO_STREAM and stream in (mavlink.MAV_DATA_STREAM_ALL, entry.stream):
                self.set_rate(number, rate if entry.rate > 0 else 0.0)

    def build(self, number: int) -> Any:
        """Build one message now; None when its content is not known yet."""
        entry = TELEMETRY_MESSAGES[number]
        if entry.needs and not getattr(self.state, entry.needs):
            return None
        return entry.build(self.state)

    def take_due(self, now: float) -> Iterator[Any]:
        """Build the messages due at a monotonic time (s), the longest overdue first; those not taken stay due."""
        if now < self.next:
            return
        for number in sorted((number for number, due in self.due.items() if now >= due), key=self.due.__getitem__):
            due, period = self.due[number], 1 / self.rates[number]
            self.due[number] = due + period if now < due + period else now + period
            message = self.build(number)
            if message is not None:
                yield message
        self.next = min(self.due.values(), default=math.inf)


def texts(severity: Severity, text: str, number: int) -> list[Any]:
    """Build STATUSTEXT, in chunks when it is long; `number` (1 to 65535) is the id that joins the chunks."""
    data = text.encode("ascii", "replace")
    pieces = [data[i : i + STATUSTEXT_BYTES] for i in range(0, len(data), STATUSTEXT_BYTES)] or [b""]
    mark = number if len(pieces) > 1 else 0
    return [mavlink.MAVLink_statustext_message(severity.value, piece, mark, i) for i, piece in enumerate(pieces)]
