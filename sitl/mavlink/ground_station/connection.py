"""A link to a vehicle, opened from its URL: MAVLink 2 over UDP, TCP or a serial port, signed if a key is given."""

from __future__ import annotations

import select
import socket
import struct
import time
from collections.abc import Sequence
from typing import Any

from pymavlink.dialects.v20 import common as mavlink

from mimopilot.sitl.errors import SitlError
from mimopilot.sitl.mavlink.ground_station.events import (
    ARDUPILOT,
    SOLE_PEER,
    Address,
    AltitudeReport,
    AttitudeReport,
    AttitudeTarget,
    CommandAck,
    EndLogs,
    FileReply,
    FileRequest,
    GroundHeartbeat,
    Heartbeat,
    Incoming,
    InjectorState,
    LandedState,
    LogData,
    LogEntry,
    Outgoing,
    ParameterRefusal,
    ParameterValue,
    PowerReport,
    ReadParameter,
    Received,
    RequestLogData,
    RequestLogs,
    RequestMessage,
    SendCommand,
    SetMessageInterval,
    SetParameter,
    StatusText,
    StorageReport,
    ThrustReport,
)
from mimopilot.sitl.mavlink.wire.codec import Codec
from mimopilot.sitl.mavlink.wire.float32 import INT32
from mimopilot.sitl.mavlink.wire.ftp import FtpPacket
from mimopilot.sitl.mavlink.wire.serial_ports import open_serial
from mimopilot.sitl.mavlink.wire.signing import Signer
from mimopilot.sitl.mavlink.wire.sockets import udp_socket
from mimopilot.sitl.physics.state_estimate import quaternion_of

#: System and component number that ground stations use.
GROUND_SYSTEM, GROUND_COMPONENT = 255, mavlink.MAV_COMP_ID_MISSIONPLANNER
#: Default baud rate: that of a SiK telemetry radio.
BAUD = 57600
#: Bit of SYS_STATUS for logging.
LOGGING = mavlink.MAV_SYS_STATUS_LOGGING
#: Names of the DEBUG_VECT in which the vehicle reports its injector's state, and the phases as z.
EXCITATION, PHASES = ("MIMO_EXC", "MIMO_EXY"), (-1, 0, 1, 2, 3)
#: SET_ATTITUDE_TARGET.type_mask: ignore the body rates.
RATES_IGNORED = 7
FORMS = (
    "expected udpin:HOST:PORT, udpout:HOST:PORT, tcp:HOST:PORT, DEVICE,BAUD such as /dev/ttyACM0,57600, or for a "
    "Crazyflie radio://0/80/2M or usb://0"
)
#: Timeout of connecting and of a blocking write, s; chosen.
CONNECT_S = 5.0
#: Addresses remembered on a UDP link; chosen above the size of any network of vehicles and routers.
MAX_PEERS = 64


def from_mavlink(message: Any, cast: bool = False) -> Incoming | None:
    """Event of a parsed message; None if an exchange does not use it.

    `cast`: integer parameters are sent as floats, as by ArduPilot; False: the float holds their bits.
    """
    kind = message.get_type()
    sender = message.get_srcSystem(), message.get_srcComponent()
    if kind == "HEARTBEAT":
        if message.type == mavlink.MAV_TYPE_GCS or message.autopilot == mavlink.MAV_AUTOPILOT_INVALID:
            return None
        armed = bool(message.base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED)
        simulated = bool(message.base_mode & mavlink.MAV_MODE_FLAG_HIL_ENABLED)
        return Heartbeat(*sender, message.autopilot, armed, message.custom_mode, message.type, simulated)
    if kind == "PARAM_VALUE":
        value = message.param_value
        coded = message.param_type == INT32 and not cast
        whole = struct.unpack("<i", struct.pack("<f", value))[0] if coded else value
        return ParameterValue(*sender, message.param_id, whole + 0.0, message.param_type, message.param_index)
    if kind == "PARAM_ERROR":
        return ParameterRefusal(*sender, message.param_id, message.error)
    if kind == "COMMAND_ACK":
        return CommandAck(*sender, message.command, message.result, message.progress)
    if kind == "ATTITUDE":
        rates = message.rollspeed, message.pitchspeed, message.yawspeed
        return AttitudeReport(*sender, message.roll, message.pitch, 1e-3 * message.time_boot_ms, rates, message.yaw)
    if kind == "EXTENDED_SYS_STATE":
        return LandedState(*sender, message.landed_state)
    if kind == "STORAGE_INFORMATION" and message.status == mavlink.STORAGE_STATUS_READY:
        return StorageReport(*sender, message.available_capacity)
    if kind == "DEBUG_VECT" and message.name in EXCITATION and message.z in PHASES:
        return InjectorState(*sender, int(message.z), message.time_usec)
    if kind == "VFR_HUD":
        return AltitudeReport(*sender, message.alt, message.climb)
    if kind == "ATTITUDE_TARGET":
        return ThrustReport(*sender, message.thrust)
    if kind == "SYS_STATUS":
        known = message.onboard_control_sensors_present & message.onboard_control_sensors_enabled & LOGGING
        works = bool(message.onboard_control_sensors_health & LOGGING) if known else None
        return PowerReport(*sender, message.battery_remaining, works)
    if kind == "STATUSTEXT":
        return StatusText(*sender, message.text, message.chunk_seq)
    if kind == "FILE_TRANSFER_PROTOCOL":
        ours = message.target_system in (0, GROUND_SYSTEM) and message.target_component in (0, GROUND_COMPONENT)
        return FileReply(*sender, FtpPacket.unpack(bytes(message.payload))) if ours else None
    if kind == "LOG_ENTRY":
        return LogEntry(*sender, message.id, message.num_logs, message.size, message.time_utc)
    if kind == "LOG_DATA":
        return LogData(*sender, message.id, message.ofs, bytes(message.data[: message.count]))
    return None


def to_mavlink(order: Outgoing, cast: bool = False) -> Any:
    """MAVLink message that encodes an outgoing message; `cast` as in `from_mavlink`."""
    if isinstance(order, GroundHeartbeat):
        return mavlink.MAVLink_heartbeat_message(
            mavlink.MAV_TYPE_GCS, mavlink.MAV_AUTOPILOT_INVALID, 0, 0, mavlink.MAV_STATE_ACTIVE, 3
        )
    if isinstance(order, ReadParameter):
        name = order.name.encode()
        return mavlink.MAVLink_param_request_read_message(order.system, order.component, name, -1)
    if isinstance(order, SetParameter):
        name = order.name.encode()
        value = order.value
        bits = order.kind == INT32 and not cast
        coded = struct.unpack("<f", struct.pack("<i", round(value)))[0] if bits else value
        return mavlink.MAVLink_param_set_message(order.system, order.component, name, coded, order.kind)
    if isinstance(order, FileRequest):
        return mavlink.MAVLink_file_transfer_protocol_message(0, order.system, order.component, order.packet.pack())
    if isinstance(order, RequestLogs):
        return mavlink.MAVLink_log_request_list_message(order.system, order.component, order.first, order.last)
    if isinstance(order, RequestLogData):
        place = order.id, order.offset, order.length
        return mavlink.MAVLink_log_request_data_message(order.system, order.component, *place)
    if isinstance(order, EndLogs):
        return mavlink.MAVLink_log_request_end_message(order.system, order.component)
    if isinstance(order, AttitudeTarget):
        q = [float(part) for part in quaternion_of.py_func(order.roll, order.pitch, order.yaw)]
        return mavlink.MAVLink_set_attitude_target_message(
            0, order.system, order.component, RATES_IGNORED, q, 0.0, 0.0, 0.0, order.thrust
        )
    parameters: tuple[float, ...]
    if isinstance(order, SetMessageInterval):
        command, parameters = mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, (order.message, order.interval)
    elif isinstance(order, RequestMessage):
        command, parameters = mavlink.MAV_CMD_REQUEST_MESSAGE, (order.message,)
    elif isinstance(order, SendCommand):
        command, parameters = order.command, order.params
    else:
        command, parameters = mavlink.MAV_CMD_PREFLIGHT_STORAGE, (1,)
    filled = [*parameters, *[0.0] * (7 - len(parameters))]
    return mavlink.MAVLink_command_long_message(order.system, order.component, command, 0, *filled)


class Connection:
    """A link to a vehicle over a socket or a serial port; see `sitl.mavlink.ground_station.events.Link`.

    Parameters
    ----------
    url : str
        ``udpin:HOST:PORT`` (listen), ``udpout:HOST:PORT`` (send first), ``tcp:HOST:PORT`` or ``DEVICE,BAUD``.
    key : bytes, optional
        Signs outgoing messages; incoming messages not signed with it are ignored.

    Raises
    ------
    SitlError
        If the URL has another form, or cannot be opened.
    """

    def __init__(self, url: str, key: bytes | None = None) -> None:
        self.closed = False
        self.signer = None if key is None else Signer(key)
        #: Systems with ArduPilot, which sends integer parameters as floats.
        self.ardupilots: set[int] = set()
        self.kind, _, rest = url.partition(":")
        #: Senders on the link. Each has its own codec, so that frames of two senders are never mixed.
        self.peers: dict[Address, Codec] = {}
        if self.kind in ("udp", "udpin", "udpout", "tcp"):
            self.port: Any = self._open_socket(url, rest)
        else:
            self.port = self._open_serial(url)
        if self.kind not in ("udp", "udpin", "udpout"):
            self._peer(SOLE_PEER)

    def _peer(self, address: Address) -> Codec:
        """Codec of an address, created if new. Beyond `MAX_PEERS` the oldest is dropped: anybody can send datagrams."""
        if address not in self.peers and len(self.peers) >= MAX_PEERS:
            del self.peers[next(iter(self.peers))]
        return self.peers.setdefault(address, Codec(GROUND_SYSTEM, GROUND_COMPONENT, self.signer))

    def _open_socket(self, url: str, rest: str) -> socket.socket:
        host, _, number = rest.rpartition(":")
        if not host or not number.isascii() or not number.isdigit() or not 0 < int(number) < 65536:
            raise SitlError(f"--connect {url}: {FORMS}")
        address = host, int(number)
        try:
            if self.kind == "tcp":
                port = socket.create_connection(address, timeout=CONNECT_S)
                port.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                port.settimeout(CONNECT_S)
                return port
            if self.kind == "udpout":
                self._peer((socket.gethostbyname(host), address[1]))
                return udp_socket("", 0)
            return udp_socket(*address, "is another ground station listening there?")
        except OSError as error:
            raise SitlError(f"--connect {url}: cannot be opened: {error.strerror or error}", exit_code=1) from error

    @staticmethod
    def _open_serial(url: str) -> Any:
        device, _, baud = url.partition(",")
        if not device.startswith(("/", "COM")) or not (baud or str(BAUD)).isdigit():
            raise SitlError(f"--connect {url}: {FORMS}")
        return open_serial("--connect", url, device, int(baud or BAUD), CONNECT_S)

    @property
    def hint(self) -> str:
        """Why messages may have been ignored, according to their signatures; empty if no reason is known."""
        if any(codec.unasked for codec in self.peers.values()):
            return "; messages on this link are signed: give --signing-key"
        if self.signer is None or self.signer.heard:
            return ""
        if self.signer.behind:
            return (
                f"; received messages are signed with this key, {self.signer.behind:.0f} s behind this computer's "
                "clock: set the clock that is wrong"
            )
        return "; received messages are not signed with this key" * any(c.refused for c in self.peers.values())

    def close(self) -> None:
        """Close the port."""
        self.port.close()

    def now(self) -> float:
        """Monotonic time, s."""
        return time.monotonic()

    def send(self, messages: Sequence[Outgoing], to: Address | None = None) -> None:
        """Send to one address or to all; a message that cannot be sent is lost, as on a radio."""
        for address in [*self.peers] if to is None else [to]:
            for message in messages:
                cast = isinstance(message, SetParameter) and message.system in self.ardupilots
                self._transmit(self._peer(address).pack(to_mavlink(message, cast)), address)

    def _transmit(self, data: bytes, address: Address) -> None:
        try:
            if self.kind == "tcp":
                self.port.sendall(data)
            elif self.kind.startswith("udp"):
                self.port.sendto(data, address)
            else:
                self.port.write(data)
        except OSError:
            self.closed = self.closed or not self.kind.startswith("udp")

    def receive(self, until: float) -> list[Received]:
        """Messages received; waits for one until a time (s)."""
        wait = max(0.0, until - self.now())
        if self.closed or not select.select([self.port], [], [], wait)[0]:
            return []
        data, origin = self._receive_bytes()
        messages = map(self._event, self._peer(origin).parse(data)) if data else ()
        return [Received(origin, message) for message in messages if message is not None]

    def _event(self, message: Any) -> Incoming | None:
        event = from_mavlink(message, message.get_srcSystem() in self.ardupilots)
        if isinstance(event, Heartbeat) and event.autopilot == ARDUPILOT:
            self.ardupilots.add(event.system)
        return event

    def discard(self) -> None:
        """Discard all messages that are waiting."""
        while not self.closed and select.select([self.port], [], [], 0)[0]:
            self._receive_bytes()

    def _receive_bytes(self) -> tuple[bytes, Address]:
        """Bytes received, and the sender's address."""
        try:
            if self.kind.startswith("udp"):
                data, origin = self.port.recvfrom(65536)
                return bytes(data), origin
            if self.kind != "tcp":
                # A serial port that select reports as readable may return nothing; a closed one raises.
                return bytes(self.port.read(65536)), SOLE_PEER
            data = self.port.recv(65536)
        except (BlockingIOError, ConnectionRefusedError):
            return b"", SOLE_PEER
        except OSError:
            data = b""
        # A TCP stream that is readable and returns nothing has ended.
        self.closed = not data
        return bytes(data), SOLE_PEER
