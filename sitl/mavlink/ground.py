"""The link to ground stations: who is there, what they ask and what they are answered."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import Any

from pymavlink.dialects.v20 import common as mavlink

from sitl.mavlink.link import COMPONENT, LOOPBACK, SYSTEM, Codec, udp_socket
from sitl.mavlink.parameter_server import ParameterServer
from sitl.mavlink.protocols import PROTOCOLS
from sitl.mavlink.steering import Steering
from sitl.mavlink.telemetry import Telemetry, texts
from sitl.mavlink.vehicle_commands import VehicleCommands
from sitl.modes import Severity

GROUND_PORT = 14550
VEHICLE_PORT = 18570
GROUND_LOST_S = 5.0
SHARE = 8  # messages taken, and sent, in one turn: a period waits for no more than these
WAITING = 1000  # answers that may wait to be sent; more are dropped

Answers = Callable[[Any], list[Any]]


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
    ground_port : int
        UDP port on this machine where a ground station listens.
    vehicle_port : int
        Local UDP port; ground stations may also speak to it first.
    """

    def __init__(
        self,
        parameters: ParameterServer,
        commands: VehicleCommands,
        telemetry: Telemetry,
        ground_port: int = GROUND_PORT,
        vehicle_port: int = VEHICLE_PORT,
    ) -> None:
        self.telemetry, self.vehicle = telemetry, commands.vehicle
        self.socket = udp_socket(LOOPBACK, vehicle_port)
        self.stations: set[tuple[str, int]] = {(LOOPBACK, ground_port)}
        self.codec = Codec()
        self.incoming = Codec()
        self.outgoing: deque[Any] = deque(maxlen=WAITING)
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
        }

    def close(self) -> None:
        """Release the port."""
        self.socket.close()

    def receive(self, now: float) -> None:
        """Take a few of the messages that have arrived; `now` is a monotonic time in s."""
        for _ in range(SHARE):
            try:
                data, address = self.socket.recvfrom(2048)
            except (BlockingIOError, ConnectionError):
                return
            for message in self.incoming.parse(data):
                self.stations.add(address)
                self._take(message, now)

    def _take(self, message: Any, now: float) -> None:
        kind = message.get_type()
        if kind == "HEARTBEAT" and message.type == mavlink.MAV_TYPE_GCS:
            self.heard = now
        if getattr(message, "target_system", SYSTEM) not in (0, SYSTEM):
            return
        if getattr(message, "target_component", COMPONENT) not in (0, COMPONENT):
            return
        answer = self.answers.get(kind)
        if answer is not None and len(self.outgoing) < WAITING:
            self.outgoing.extend(answer(message))

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
            self._broadcast(self.outgoing.popleft())
        for message in self.telemetry.messages(now):
            self._broadcast(message)

    def _broadcast(self, message: Any) -> None:
        """One message to every ground station; a station that is not there is no error."""
        data = self.codec.pack(message)
        for address in self.stations:
            try:
                self.socket.sendto(data, address)
            except OSError:
                continue

    def _data_stream(self, message: Any) -> list[Any]:
        self.telemetry.set_stream(message.req_stream_id, message.req_message_rate if message.start_stop else 0.0)
        return []


def _name(raw: str | bytes) -> str:
    text = raw.decode("ascii", "replace") if isinstance(raw, bytes) else raw
    return text.split("\0", 1)[0]
