"""The link to ground stations: who is there, what they ask and what they are answered."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from mimopilot.sitl.autopilot.flight_modes import Denied, Failed, Refused, Severity
from mimopilot.sitl.mavlink.vehicle.parameter_server import ParameterServer
from mimopilot.sitl.mavlink.vehicle.setpoint_messages import SetpointReceiver
from mimopilot.sitl.mavlink.vehicle.small_protocols import PROTOCOLS
from mimopilot.sitl.mavlink.vehicle.stations import BUDGET_S, Stations
from mimopilot.sitl.mavlink.vehicle.telemetry import Telemetry, texts
from mimopilot.sitl.mavlink.vehicle.vehicle_commands import Command, VehicleCommands
from pymavlink.dialects.v20 import common as mavlink

GROUND_LOST_S = 5.0

Answers = Callable[[Any], list[Any]]


class GroundStationLink:
    """The vehicle as ground stations see it.

    Parameters
    ----------
    parameters : ParameterServer
        What they may read and write.
    commands : VehicleCommands
        What they may command.
    telemetry : Telemetry
        What they are shown.
    stations : Stations
        Who they are.
    """

    def __init__(
        self, parameters: ParameterServer, commands: VehicleCommands, telemetry: Telemetry, stations: Stations
    ) -> None:
        self.parameters, self.telemetry, self.vehicle, self.stations = parameters, telemetry, commands.vehicle, stations
        self.now = 0.0
        self.heard: float | None = None
        self._texts = 0
        steering = SetpointReceiver(self.vehicle)
        self.answers: dict[str, Answers] = {
            **PROTOCOLS,
            **dict.fromkeys(steering.takers, steering.take),
            "PARAM_REQUEST_LIST": lambda m: parameters.listing(),
            "PARAM_REQUEST_READ": lambda m: parameters.read(m.param_id, m.param_index),
            "PARAM_SET": lambda m: parameters.write(m.param_id, m.param_value, m.param_type),
            "COMMAND_LONG": commands.answer,
            "COMMAND_INT": commands.answer,
            "SET_MODE": commands.set_mode,
            "REQUEST_DATA_STREAM": self._data_stream,
            "HEARTBEAT": self._heartbeat,
        }
        stations.hear(*self.answers)
        commands.handlers[mavlink.MAV_CMD_PREFLIGHT_STORAGE] = self._store

    def receive(self, now: float) -> None:
        """Take some of the messages that have arrived; `now` is a monotonic time in s."""
        self.now = now
        for message, station in self.stations.receive():
            kind = message.get_type()
            for answer in self.answers[kind](message):
                # A new value is of interest to all.
                for_all = kind == "PARAM_SET" and answer.get_type() == "PARAM_VALUE"
                self.stations.post(answer, None if for_all else station)

    def say(self, severity: Severity, text: str) -> None:
        """STATUSTEXT to all; what is worth a word has most often changed the heartbeat, too."""
        self.telemetry.hurry(mavlink.MAVLINK_MSG_ID_HEARTBEAT)
        self._texts = self._texts % 65535 + 1
        for piece in texts(severity, text, self._texts):
            self.stations.post(piece)

    def send(self, now: float) -> None:
        """Send a few of the answers, and the telemetry that is due; `now` is a monotonic time in s."""
        if self.heard is not None and now > self.heard + GROUND_LOST_S:
            self.heard = None
            self.vehicle.say(Severity.WARNING, f"no ground station for {GROUND_LOST_S:g} s")
        complaint = self.parameters.complaint()
        if complaint:
            self.vehicle.say(Severity.CRITICAL, complaint)
        end = time.perf_counter() + BUDGET_S
        for message in self.telemetry.messages(now):
            self.stations.send(message)
            if time.perf_counter() > end:
                break
        self.stations.deliver()

    def _heartbeat(self, message: Any) -> list[Any]:
        if message.type == mavlink.MAV_TYPE_GCS:
            self.heard = self.now
        return []

    def _store(self, command: Command) -> list[Any]:
        """Parameters are kept as they change; here it is awaited."""
        if command.whole(1) not in (0, 1):
            raise Denied("storage: param1 must be 1, to keep the parameters")
        if self.vehicle.armed:
            raise Refused("storage: not while armed; what changes is kept anyway")
        if not self.parameters.flush():
            raise Failed(self.parameters.complaint())
        return []

    def _data_stream(self, message: Any) -> list[Any]:
        self.telemetry.set_stream(message.req_stream_id, message.req_message_rate if message.start_stop else 0.0)
        return []
