"""The vehicle's link to ground stations: dispatches their messages, and sends answers, telemetry and texts."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from pymavlink.dialects.v20 import common as mavlink

from mimopilot.sitl.autopilot.flight_modes import Denied, Failed, Refused, Severity
from mimopilot.sitl.mavlink.vehicle.log_server import LogServer
from mimopilot.sitl.mavlink.vehicle.parameter_server import ParameterServer
from mimopilot.sitl.mavlink.vehicle.px4_parameter_server import Px4ParameterServer
from mimopilot.sitl.mavlink.vehicle.setpoint_messages import SetpointReceiver
from mimopilot.sitl.mavlink.vehicle.small_protocols import PROTOCOLS
from mimopilot.sitl.mavlink.vehicle.stations import BUDGET_S, Stations
from mimopilot.sitl.mavlink.vehicle.telemetry import Telemetry, texts
from mimopilot.sitl.mavlink.vehicle.vehicle_commands import Command, VehicleCommands

HEARTBEAT_TIMEOUT_S = 5.0  # s without a ground station's heartbeat before it is reported; chosen: five heartbeats
MAX_TEXT_ID = 65535  # STATUSTEXT.id is a uint16; 0: a text of one chunk

MessageHandler = Callable[[Any], list[Any]]


class GroundStationLink:
    """Serves ground stations.

    Parameters
    ----------
    parameters : ParameterServer or Px4ParameterServer
        Answers the parameter protocol.
    commands : VehicleCommands
        Executes commands.
    telemetry : Telemetry
        Schedules the telemetry.
    stations : Stations
        The connections.
    logs : LogServer
        Serves the logs.
    """

    def __init__(
        self,
        parameters: ParameterServer | Px4ParameterServer,
        commands: VehicleCommands,
        telemetry: Telemetry,
        stations: Stations,
        logs: LogServer,
    ) -> None:
        self.parameters, self.telemetry, self.vehicle, self.stations = parameters, telemetry, commands.vehicle, stations
        self.logs = logs
        self.now = 0.0
        self.heard: float | None = None
        self._text_id = 0
        setpoints = SetpointReceiver(self.vehicle)
        self.handlers: dict[str, MessageHandler] = {
            **PROTOCOLS,
            **dict.fromkeys(setpoints.handlers, setpoints.receive),
            "PARAM_REQUEST_LIST": lambda m: parameters.listing(),
            "PARAM_REQUEST_READ": lambda m: parameters.read(m.param_id, m.param_index),
            "PARAM_SET": lambda m: parameters.write(m.param_id, m.param_value, m.param_type),
            "COMMAND_LONG": commands.execute,
            "COMMAND_INT": commands.execute,
            "SET_MODE": commands.set_mode,
            "REQUEST_DATA_STREAM": self._data_stream,
            "HEARTBEAT": self._heartbeat,
        }
        stations.subscribe(*self.handlers, *logs.handlers)
        commands.handlers[mavlink.MAV_CMD_PREFLIGHT_STORAGE] = self._store

    def receive(self, now: float) -> None:
        """Handle messages that have arrived, within the time budget; `now` is a monotonic time in s."""
        self.now = now
        for message, station in self.stations.receive():
            kind = message.get_type()
            serve = self.logs.handlers.get(kind)
            for answer in serve(message, station) if serve else self.handlers[kind](message):
                # Every station must learn of a changed parameter.
                for_all = kind == "PARAM_SET" and answer.get_type() == "PARAM_VALUE"
                self.stations.post(answer, None if for_all else station)

    def send_text(self, severity: Severity, text: str) -> None:
        """Send STATUSTEXT to all stations, and a heartbeat: its content has often changed, too."""
        self.telemetry.hurry(mavlink.MAVLINK_MSG_ID_HEARTBEAT)
        self._text_id = self._text_id % MAX_TEXT_ID + 1
        for piece in texts(severity, text, self._text_id):
            self.stations.post(piece)

    def send(self, now: float) -> None:
        """Send due telemetry and queued answers, within the time budget; `now` is a monotonic time in s."""
        if self.heard is not None and now > self.heard + HEARTBEAT_TIMEOUT_S:
            self.heard = None
            self.vehicle.say(Severity.WARNING, f"no heartbeat from a ground station for {HEARTBEAT_TIMEOUT_S:g} s")
        write_error = self.parameters.take_write_error()
        if write_error:
            self.vehicle.say(Severity.CRITICAL, write_error)
        end = time.perf_counter() + BUDGET_S
        for message in self.telemetry.take_due(now):
            self.stations.send(message)
            if time.perf_counter() > end:
                break
        self.stations.deliver()

    def _heartbeat(self, message: Any) -> list[Any]:
        if message.type == mavlink.MAV_TYPE_GCS:
            self.heard = self.now
        return []

    def _store(self, command: Command) -> list[Any]:
        """Wait until the parameters are written; each change is written anyway."""
        if command.whole(1) not in (0, 1):
            raise Denied("storage: param1 must be 1, to store the parameters")
        if self.vehicle.armed:
            raise Refused("storage: not while armed; changes are stored anyway")
        if not self.parameters.flush():
            raise Failed(self.parameters.take_write_error())
        return []

    def _data_stream(self, message: Any) -> list[Any]:
        self.telemetry.set_stream(message.req_stream_id, message.req_message_rate if message.start_stop else 0.0)
        return []
