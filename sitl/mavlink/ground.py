"""The link to ground stations: who is there, what they ask and what they are answered."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Container
from typing import Any

from pymavlink.dialects.v20 import common as mavlink

from sitl.mavlink.parameter_server import ParameterServer
from sitl.mavlink.protocols import PROTOCOLS
from sitl.mavlink.stations import Stations
from sitl.mavlink.steering import Steering
from sitl.mavlink.telemetry import Telemetry, texts
from sitl.mavlink.vehicle_commands import VehicleCommands
from sitl.modes import Severity

GROUND_LOST_S = 5.0
SHARE = 8  # answers sent in one turn: a period waits for no more than these
WAITING = 1000  # answers that may wait to be sent; more are dropped

Answers = Callable[[Any], list[Any]]
Connect = Callable[[Container[int]], Stations]


class Ground:
    """The vehicle as ground stations see it.

    Parameters
    ----------
    parameters : ParameterServer
        What they may read and write.
    commands : VehicleCommands
        What they may command.
    telemetry : Telemetry
        What they are shown.
    connect : callable
        Opens the links; called with the numbers of the messages that mean anything to the vehicle.
    """

    def __init__(
        self, parameters: ParameterServer, commands: VehicleCommands, telemetry: Telemetry, connect: Connect
    ) -> None:
        self.telemetry, self.vehicle = telemetry, commands.vehicle
        self.outgoing: deque[Any] = deque(maxlen=WAITING)
        self.now = 0.0
        self.heard: float | None = None
        self._texts = 0
        steering = Steering(self.vehicle)
        self.answers: dict[str, Answers] = {
            **PROTOCOLS,
            **dict.fromkeys(steering.takers, steering.take),
            "PARAM_REQUEST_LIST": lambda m: list(parameters.listing()),
            "PARAM_REQUEST_READ": lambda m: parameters.read(_name(m.param_id), m.param_index),
            "PARAM_SET": lambda m: parameters.write(_name(m.param_id), m.param_value, m.param_type),
            "COMMAND_LONG": commands.answer,
            "COMMAND_INT": commands.answer,
            "SET_MODE": commands.set_mode,
            "REQUEST_DATA_STREAM": self._data_stream,
            "HEARTBEAT": self._heartbeat,
        }
        numbers = {kind.msgname: number for number, kind in mavlink.mavlink_map.items()}
        self.stations = connect({numbers[name] for name in self.answers})

    def close(self) -> None:
        """Release the ports."""
        self.stations.close()

    def receive(self, now: float) -> None:
        """Take a few of the messages that have arrived; `now` is a monotonic time in s."""
        self.now = now
        for message, _ in self.stations.receive():
            answers = self.answers[message.get_type()](message)
            if len(self.outgoing) < WAITING:
                self.outgoing.extend(answers)

    def say(self, severity: Severity, text: str) -> None:
        """STATUSTEXT to all."""
        self._texts = self._texts % 65535 + 1
        self.outgoing.extend(texts(severity, text, self._texts))

    def send(self, now: float) -> None:
        """Send a few of the answers, and the telemetry that is due; `now` is a monotonic time in s."""
        if self.heard is not None and now > self.heard + GROUND_LOST_S:
            self.heard = None
            self.vehicle.say(Severity.WARNING, f"no ground station for {GROUND_LOST_S:g} s")
        for _ in range(min(SHARE, len(self.outgoing))):
            self.stations.send(self.outgoing.popleft())
        for message in self.telemetry.messages(now):
            self.stations.send(message)

    def _heartbeat(self, message: Any) -> list[Any]:
        if message.type == mavlink.MAV_TYPE_GCS:
            self.heard = self.now
        return []

    def _data_stream(self, message: Any) -> list[Any]:
        self.telemetry.set_stream(message.req_stream_id, message.req_message_rate if message.start_stop else 0.0)
        return []


def _name(raw: str | bytes) -> str:
    text = raw.decode("ascii", "replace") if isinstance(raw, bytes) else raw
    return text.split("\0", 1)[0]
