"""A link to a vehicle, from its URL: MAVLink 2 over UDP, TCP or a serial port, signed where a key is given."""

from __future__ import annotations

import select
import socket
import struct
import time
from collections.abc import Sequence
from typing import Any

from mimopilot.sitl.errors import SitlError
from mimopilot.sitl.mavlink.ground_station.events import (
    INT32,
    THE_PEER,
    Ack,
    Address,
    Attitude,
    Beat,
    Excited,
    Heard,
    Heartbeat,
    Incoming,
    Landed,
    Outgoing,
    Read,
    Refusal,
    Request,
    RequestOnce,
    Text,
    Value,
    Write,
)
from mimopilot.sitl.mavlink.wire.codec import Codec
from mimopilot.sitl.mavlink.wire.signing import Signer
from mimopilot.sitl.mavlink.wire.sockets import udp_socket
from pymavlink.dialects.v20 import common as mavlink

#: How ground stations call themselves.
GROUND_SYSTEM, GROUND_COMPONENT = 255, mavlink.MAV_COMP_ID_MISSIONPLANNER
BAUD = 57600
#: Name under which the vehicle tells what its injector does.
EXCITATION = "MIMO_EXC"
FORMS = "expected udpin:HOST:PORT, udpout:HOST:PORT, tcp:HOST:PORT or DEVICE,BAUD such as /dev/ttyACM0,57600"
CONNECT_S = 5.0
#: Addresses of a UDP link that are remembered: more than any network of vehicles and routers has.
MAX_PEERS = 64


def understand(message: Any) -> Incoming | None:
    """What a parsed message means to an exchange of parameters; None when nothing."""
    kind = message.get_type()
    speaker = message.get_srcSystem(), message.get_srcComponent()
    if kind == "HEARTBEAT":
        if message.type == mavlink.MAV_TYPE_GCS or message.autopilot == mavlink.MAV_AUTOPILOT_INVALID:
            return None
        armed = bool(message.base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED)
        return Heartbeat(*speaker, message.autopilot, armed, message.custom_mode, message.type)
    if kind == "PARAM_VALUE":
        value = message.param_value
        whole = struct.unpack("<i", struct.pack("<f", value))[0] if message.param_type == INT32 else value
        return Value(*speaker, message.param_id, whole + 0.0, message.param_type)
    if kind == "PARAM_ERROR":
        return Refusal(*speaker, message.param_id, message.error)
    if kind == "COMMAND_ACK":
        return Ack(*speaker, message.command, message.result)
    if kind == "ATTITUDE":
        return Attitude(*speaker, message.roll, message.pitch)
    if kind == "EXTENDED_SYS_STATE":
        return Landed(*speaker, message.landed_state)
    if kind == "DEBUG_VECT" and message.name == EXCITATION and message.z in (-1, 0, 1, 2):
        return Excited(*speaker, int(message.z), message.time_usec)
    if kind == "STATUSTEXT":
        return Text(*speaker, message.text)
    return None


def express(order: Outgoing) -> Any:
    """The message that carries an order."""
    if isinstance(order, Beat):
        return mavlink.MAVLink_heartbeat_message(
            mavlink.MAV_TYPE_GCS, mavlink.MAV_AUTOPILOT_INVALID, 0, 0, mavlink.MAV_STATE_ACTIVE, 3
        )
    if isinstance(order, Read):
        name = order.name.encode()
        return mavlink.MAVLink_param_request_read_message(order.system, order.component, name, -1)
    if isinstance(order, Write):
        name = order.name.encode()
        value = order.value
        coded = struct.unpack("<f", struct.pack("<i", round(value)))[0] if order.kind == INT32 else value
        return mavlink.MAVLink_param_set_message(order.system, order.component, name, coded, order.kind)
    if isinstance(order, Request):
        command, parameters = mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, (order.message, order.interval)
    elif isinstance(order, RequestOnce):
        command, parameters = mavlink.MAV_CMD_REQUEST_MESSAGE, (order.message, 0)
    else:
        command, parameters = mavlink.MAV_CMD_PREFLIGHT_STORAGE, (1, 0)
    return mavlink.MAVLink_command_long_message(order.system, order.component, command, 0, *parameters, 0, 0, 0, 0, 0)


class Connection:
    """A link to a vehicle over a socket or a serial port; see `sitl.mavlink.ground_station.events.Link`.

    Parameters
    ----------
    url : str
        ``udpin:HOST:PORT`` (listen), ``udpout:HOST:PORT`` (speak first), ``tcp:HOST:PORT`` or ``DEVICE,BAUD``.
    key : bytes, optional
        Signs what is sent; what is not signed with it is then ignored.

    Raises
    ------
    SitlError
        When the URL is none of these, or cannot be opened.
    """

    def __init__(self, url: str, key: bytes | None = None) -> None:
        self.closed = False
        self.signer = None if key is None else Signer(key)
        self.kind, _, rest = url.partition(":")
        #: Who is there, each with what packs and parses its messages: two half frames of two speakers make none.
        self.peers: dict[Address, Codec] = {}
        if self.kind in ("udp", "udpin", "udpout", "tcp"):
            self.port: Any = self._open_socket(url, rest)
        else:
            self.port = self._open_serial(url)
        if self.kind not in ("udp", "udpin", "udpout"):
            self._peer(THE_PEER)

    def _peer(self, address: Address) -> Codec:
        """What speaks with an address. Beyond so many the oldest is forgotten: anybody can send a datagram."""
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
        import serial

        device, _, baud = url.partition(",")
        if not device.startswith(("/", "COM")) or not (baud or str(BAUD)).isdigit():
            raise SitlError(f"--connect {url}: {FORMS}")
        try:
            return serial.Serial(device, int(baud or BAUD), timeout=0, write_timeout=CONNECT_S)
        except (serial.SerialException, ValueError) as error:
            raise SitlError(f"--connect {url}: cannot be opened: {error}", exit_code=1) from error

    @property
    def hint(self) -> str:
        """What signatures tell about a silence; empty when nothing."""
        if any(codec.unasked for codec in self.peers.values()):
            return "; messages on this link are signed: give --signing-key"
        if self.signer is None or self.signer.heard:
            return ""
        if self.signer.behind:
            return (
                f"; messages came that are signed with this key, {self.signer.behind:.0f} s behind this computer's "
                "clock: set the clock of whichever is wrong"
            )
        return "; messages came that are not signed with this key" * any(c.refused for c in self.peers.values())

    def close(self) -> None:
        """Release the port."""
        self.port.close()

    def now(self) -> float:
        """Monotonic time, s."""
        return time.monotonic()

    def send(self, messages: Sequence[Outgoing], to: Address | None = None) -> None:
        """Send to one address or to all; what cannot be sent is lost, as on any radio."""
        for address in [*self.peers] if to is None else [to]:
            for message in messages:
                self._transmit(self._peer(address).pack(express(message)), address)

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

    def receive(self, until: float) -> list[Heard]:
        """What has been heard; waits for it until a time (s)."""
        wait = max(0.0, until - self.now())
        if self.closed or not select.select([self.port], [], [], wait)[0]:
            return []
        data, origin = self._bytes()
        meanings = map(understand, self._peer(origin).parse(data)) if data else ()
        return [Heard(origin, meaning) for meaning in meanings if meaning is not None]

    def discard(self) -> None:
        """Throw away what has piled up."""
        while not self.closed and select.select([self.port], [], [], 0)[0]:
            self._bytes()

    def _bytes(self) -> tuple[bytes, Address]:
        """What has arrived, and from where."""
        try:
            if self.kind.startswith("udp"):
                data, origin = self.port.recvfrom(65536)
                return bytes(data), origin
            if self.kind != "tcp":
                # Nothing, now and then, although it was ready; its end is an error.
                return bytes(self.port.read(65536)), THE_PEER
            data = self.port.recv(65536)
        except (BlockingIOError, ConnectionRefusedError):
            return b"", THE_PEER
        except OSError:
            data = b""
        # A stream that is ready and has nothing to say has ended.
        self.closed = not data
        return bytes(data), THE_PEER
