"""The link to ground stations: telemetry out, requests in, over UDP."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from pymavlink.dialects.v20 import common as mavlink

from sitl.mavlink.link import COMPONENT, LOOPBACK, SYSTEM, Codec, udp_socket
from sitl.mavlink.parameter_server import ParameterServer

GROUND_PORT = 14550
VEHICLE_PORT = 18570
FTP_NAK, FTP_UNKNOWN_COMMAND = 129, 7
CAPABILITIES = (
    mavlink.MAV_PROTOCOL_CAPABILITY_MAVLINK2
    | mavlink.MAV_PROTOCOL_CAPABILITY_SET_ATTITUDE_TARGET
    | mavlink.MAV_PROTOCOL_CAPABILITY_PARAM_ENCODE_BYTEWISE
)
HEALTHY = (
    mavlink.MAV_SYS_STATUS_SENSOR_3D_GYRO
    | mavlink.MAV_SYS_STATUS_SENSOR_3D_ACCEL
    | mavlink.MAV_SYS_STATUS_SENSOR_ANGULAR_RATE_CONTROL
    | mavlink.MAV_SYS_STATUS_SENSOR_ATTITUDE_STABILIZATION
    | mavlink.MAV_SYS_STATUS_GEOFENCE
    | mavlink.MAV_SYS_STATUS_PREARM_CHECK
)
#: Message -> how many a second.
RATES = {"heartbeat": 1.0, "system": 1.0, "attitude": 20.0}


class Ground:
    """The vehicle as ground stations see it.

    Parameters
    ----------
    parameters : ParameterServer
        What they may read and write.
    ground_port : int
        UDP port on this machine where a ground station listens.
    vehicle_port : int
        Local UDP port; ground stations may also speak to it first.
    """

    def __init__(
        self, parameters: ParameterServer, ground_port: int = GROUND_PORT, vehicle_port: int = VEHICLE_PORT
    ) -> None:
        self.parameters = parameters
        self.socket = udp_socket(LOOPBACK, vehicle_port)
        self.stations: set[tuple[str, int]] = {(LOOPBACK, ground_port)}
        self.codec = Codec()
        self.incoming = Codec()
        self.setpoint = np.zeros(3, np.float32)
        self.due = dict.fromkeys(RATES, 0.0)
        self.answers: dict[str, Callable[[Any], list[Any]]] = {
            "PARAM_REQUEST_LIST": lambda m: list(self.parameters.listing()),
            "PARAM_REQUEST_READ": lambda m: self.parameters.read(_name(m.param_id), m.param_index),
            "PARAM_SET": lambda m: self.parameters.write(_name(m.param_id), m.param_value, m.param_type),
            "COMMAND_LONG": self._command,
            "COMMAND_INT": self._command,
            "FILE_TRANSFER_PROTOCOL": self._refuse_files,
            "MISSION_REQUEST_LIST": self._no_mission,
            "TIMESYNC": self._timesync,
            "PING": self._ping,
        }

    def close(self) -> None:
        """Release the port."""
        self.socket.close()

    def send(self, message: Any) -> None:
        """One message to every ground station; a station that is not there is no error."""
        data = self.codec.pack(message)
        for address in self.stations:
            try:
                self.socket.sendto(data, address)
            except OSError:
                continue

    def receive(self) -> None:
        """Answer what has arrived."""
        for _ in range(64):
            try:
                data, address = self.socket.recvfrom(2048)
            except (BlockingIOError, ConnectionError):
                return
            for message in self.incoming.parse(data):
                self.stations.add(address)
                if getattr(message, "target_system", SYSTEM) not in (0, SYSTEM):
                    continue
                if getattr(message, "target_component", COMPONENT) not in (0, COMPONENT):
                    continue
                for answer in self.answers.get(message.get_type(), lambda m: [])(message):
                    self.send(answer)

    def telemeter(self, now: float, stamp_us: int, row: Any) -> None:
        """Send what is due; `now` is a monotonic time in s, `row` the last control period."""
        due = [name for name, time_due in self.due.items() if now >= time_due]
        for name in due:
            self.due[name] = now + 1 / RATES[name]
        if "heartbeat" in due:
            self.send(
                mavlink.MAVLink_heartbeat_message(
                    mavlink.MAV_TYPE_QUADROTOR,
                    mavlink.MAV_AUTOPILOT_GENERIC,
                    mavlink.MAV_MODE_FLAG_SAFETY_ARMED | mavlink.MAV_MODE_FLAG_STABILIZE_ENABLED,
                    0,
                    mavlink.MAV_STATE_ACTIVE,
                    3,
                )
            )
        if "system" in due:
            self.send(mavlink.MAVLink_sys_status_message(HEALTHY, HEALTHY, HEALTHY, 0, 65535, -1, -1, 0, 0, 0, 0, 0, 0))
        if "attitude" in due and stamp_us > 0:
            milliseconds = stamp_us // 1000 % 2**32
            roll, pitch, yaw = (float(v) for v in row["attitude"])
            rates = [float(v) for v in row["rates"]]
            self.send(mavlink.MAVLink_attitude_message(milliseconds, roll, pitch, yaw, *rates))
            quaternion = [float(v) for v in row["quaternion"]]
            self.send(mavlink.MAVLink_attitude_quaternion_message(milliseconds, *quaternion, *rates))

    def _command(self, message: Any) -> list[Any]:
        def answer(result: int) -> Any:
            return mavlink.MAVLink_command_ack_message(
                message.command, result, 0, 0, message.get_srcSystem(), message.get_srcComponent()
            )

        wanted = message.param1 if math.isfinite(message.param1) else -1
        version = message.command == mavlink.MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES or (
            message.command == mavlink.MAV_CMD_REQUEST_MESSAGE and wanted == mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION
        )
        if not version:
            return [answer(mavlink.MAV_RESULT_UNSUPPORTED)]
        details = mavlink.MAVLink_autopilot_version_message(
            CAPABILITIES, 0, 0, 0, 0, bytes(8), bytes(8), bytes(8), 0, 0, 0
        )
        return [answer(mavlink.MAV_RESULT_ACCEPTED), details]

    @staticmethod
    def _refuse_files(message: Any) -> list[Any]:
        """NAK: there are no files here. Without an answer MAVProxy waits 11 s."""
        asked = bytes(message.payload)
        sequence = (int.from_bytes(asked[:2], "little") + 1) % 65536
        payload = bytearray(251)
        payload[:2] = sequence.to_bytes(2, "little")
        payload[2] = asked[2]
        payload[3], payload[4], payload[5], payload[12] = FTP_NAK, 1, asked[3], FTP_UNKNOWN_COMMAND
        return [
            mavlink.MAVLink_file_transfer_protocol_message(
                0, message.get_srcSystem(), message.get_srcComponent(), bytes(payload)
            )
        ]

    @staticmethod
    def _no_mission(message: Any) -> list[Any]:
        kind = getattr(message, "mission_type", 0)
        return [mavlink.MAVLink_mission_count_message(message.get_srcSystem(), message.get_srcComponent(), 0, kind)]

    @staticmethod
    def _timesync(message: Any) -> list[Any]:
        if message.tc1 != 0:
            return []
        return [mavlink.MAVLink_timesync_message(time.monotonic_ns(), message.ts1)]

    @staticmethod
    def _ping(message: Any) -> list[Any]:
        if message.target_system != 0:
            return []
        return [
            mavlink.MAVLink_ping_message(
                message.time_usec, message.seq, message.get_srcSystem(), message.get_srcComponent()
            )
        ]


def _name(raw: str | bytes) -> str:
    text = raw.decode("ascii", "replace") if isinstance(raw, bytes) else raw
    return text.split("\0", 1)[0]
