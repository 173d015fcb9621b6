"""When ground stations are shown what: each message at its rate."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

from mimopilot.sitl.autopilot.flight_modes import Severity
from mimopilot.sitl.mavlink.vehicle.telemetry_messages import NO_STREAM, TELEMETRY_MESSAGES
from mimopilot.sitl.mavlink.vehicle.vehicle_state import VehicleState
from pymavlink.dialects.v20 import common as mavlink

MAX_RATE = 250.0  # Hz, of one message
TEXT = 50  # characters of one STATUSTEXT


class Telemetry:
    """When each message is due.

    Parameters
    ----------
    situation : VehicleState
        What they are made from.
    """

    def __init__(self, situation: VehicleState) -> None:
        self.situation = situation
        self.rates = {number: topic.rate for number, topic in TELEMETRY_MESSAGES.items()}
        self.due = {number: 0.0 for number, rate in self.rates.items() if rate > 0}
        self.next = 0.0

    def set_rate(self, number: int, rate: float) -> None:
        """Send a message so often, Hz; 0: never. More than `MAX_RATE` is that."""
        self.rates[number] = min(rate, MAX_RATE)
        self.due.pop(number, None)
        if rate > 0:
            self.due[number] = self.next = 0.0

    def hurry(self, number: int) -> None:
        """Send a message at once that is sent anyway: something has changed."""
        if number in self.due:
            self.due[number] = self.next = 0.0

    def set_stream(self, stream: int, rate: float) -> None:
        """The same for all messages of a data stream; stream 0 is all of them."""
        for number, topic in TELEMETRY_MESSAGES.items():
            if topic.stream != NO_STREAM and stream in (mavlink.MAV_DATA_STREAM_ALL, topic.stream):
                self.set_rate(number, rate if TELEMETRY_MESSAGES[number].rate > 0 else 0.0)

    def build(self, number: int) -> Any:
        """One message now; None when what it tells is not known."""
        topic = TELEMETRY_MESSAGES[number]
        if topic.needs and not getattr(self.situation, topic.needs):
            return None
        return topic.build(self.situation)

    def messages(self, now: float) -> Iterator[Any]:
        """What is due at a monotonic time (s), what waits longest first; what is not taken stays due."""
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
    """STATUSTEXT, in pieces when it is long; `number` tells one long text from another, 1 to 65535."""
    data = text.encode("ascii", "replace")
    pieces = [data[i : i + TEXT] for i in range(0, len(data), TEXT)] or [b""]
    mark = number if len(pieces) > 1 else 0
    return [mavlink.MAVLink_statustext_message(severity.value, piece, mark, i) for i, piece in enumerate(pieces)]
