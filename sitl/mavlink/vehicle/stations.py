"""Connections to ground stations: several at once, over UDP and TCP, none of which can delay the flight.

The sender of an intact frame becomes a station. The time of one call and the bytes queued for a slow reader are
bounded. Only frames to this vehicle are handled and, with a key, only signed ones.
"""

from __future__ import annotations

import ipaddress
import socket
import time
from collections import deque
from collections.abc import Iterator, Sequence
from typing import Any, TypeVar

from mimopilot.sitl.mavlink.wire.codec import COMPONENT, KINDS, SYSTEM, Codec
from mimopilot.sitl.mavlink.wire.signing import Signer
from mimopilot.sitl.mavlink.wire.sockets import LOOPBACK, listen, udp_socket

# All chosen:
#: Time budget of one `Stations.receive` and one `Stations.deliver`, s: an eighth of a control period at 250 Hz.
BUDGET_S = 0.0005
#: Messages sent to a station in one call; answers queued for it before its requests are ignored.
ANSWERS_PER_CALL, MAX_ANSWERS = 8, 100
#: Most stations per transport; silence (s) after which a new station may replace one.
MAX_STATIONS, SILENCE_S = 8, 10.0
#: Unsent bytes after which a TCP station is disconnected.
MAX_UNSENT = 1 << 16
#: Bytes read at once: more than any datagram of one Ethernet frame.
CHUNK = 2048

Address = tuple[str, int]
Received = tuple[Any, "Station"]
#: Yields the messages of each step; None: no data now.
Reader = Iterator["list[Received] | None"]
S = TypeVar("S", bound="Station")


class Station:
    """One ground station, with its own sequence numbers, so that it sees no gaps from messages to other stations.

    Parameters
    ----------
    codec : Codec
        Packs messages to it and parses its messages.

    Attributes
    ----------
    answers : deque
        Messages to send soon.
    stream : iterator or None
        Messages to send when no answer is waiting: pieces of a log.
    """

    def __init__(self, codec: Codec) -> None:
        self.codec = codec
        self.heard = time.monotonic()
        self.answers: deque[Any] = deque(maxlen=2 * MAX_ANSWERS)
        self.stream: Iterator[Any] | None = None

    @property
    def busy(self) -> bool:
        """Whether so many answers are queued for it that its requests are ignored."""
        return len(self.answers) >= MAX_ANSWERS

    @property
    def ready(self) -> bool:
        """Whether what was sent before has left."""
        return True

    def take(self) -> Any | None:
        """The next message to send; None: there is none now."""
        if self.answers:
            return self.answers.popleft()
        if self.stream is None or not self.ready:
            return None
        message = next(self.stream, None)
        if message is None:
            self.stream = None
        return message

    def send(self, message: Any) -> None:
        """Send one message; an unreachable station is no error."""
        self.transmit(self.codec.pack(message))

    def transmit(self, data: bytes) -> None:
        """Send the bytes of one message."""
        raise NotImplementedError


class UdpStation(Station):
    """A station at a UDP address."""

    def __init__(self, codec: Codec, link: socket.socket, address: Address) -> None:
        super().__init__(codec)
        self.link, self.address = link, address

    def transmit(self, data: bytes) -> None:  # noqa: D102
        try:
            self.link.sendto(data, self.address)
        except OSError:
            return


class TcpStation(Station):
    """A station on a TCP connection that it opened."""

    def __init__(self, codec: Codec, link: socket.socket) -> None:
        super().__init__(codec)
        self.link, self.open = link, True
        self.unsent = b""
        self.reader = self._read()
        link.setblocking(False)
        link.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    def transmit(self, data: bytes) -> None:  # noqa: D102
        if not self.open:
            return
        self.unsent += data
        try:
            self.unsent = self.unsent[self.link.send(self.unsent) :]
        except BlockingIOError:
            pass
        except OSError:
            self.close()
        if len(self.unsent) > MAX_UNSENT:
            self.close()

    @property
    def ready(self) -> bool:  # noqa: D102
        if self.unsent:
            self.transmit(b"")
        return self.open and not self.unsent

    def close(self) -> None:
        """Disconnect it."""
        self.open = False
        self.link.close()

    def _read(self) -> Reader:
        while True:
            try:
                data = self.link.recv(CHUNK)
            except BlockingIOError:
                yield None
                continue
            except OSError:
                data = b""
            if not data:
                self.close()
                yield None
                continue
            for message in self.codec.search(data):
                yield [(message, self)] if message is not None and _is_for_us(message) else []
            yield []


class Stations:
    """All ground stations.

    Parameters
    ----------
    ground_port : int
        UDP port on this machine where a station listens; messages go there from the start.
    udp_port, tcp_port : int
        Local ports for stations that send first; 0: any free one.
    bind : str
        Local address of both.
    signer : Signer, optional
        Signs all messages; unsigned ones from stations are then ignored.

    Raises
    ------
    SitlError
        When a port or the address cannot be used.
    """

    def __init__(
        self,
        ground_port: int,
        udp_port: int,
        tcp_port: int = 0,
        bind: str = LOOPBACK,
        signer: Signer | None = None,
    ) -> None:
        self.signer = signer
        self.wanted: set[int] = set()
        self.udp = udp_socket(bind, udp_port)
        try:
            self.tcp = listen(bind, tcp_port, MAX_STATIONS, "--tcp-port")
        except BaseException:
            self.udp.close()
            raise
        self.tcp.setblocking(False)
        self.datagrams = self._codec()
        self.first = LOOPBACK, ground_port
        self.by_address: dict[Address, UdpStation] = {self.first: UdpStation(self._codec(), self.udp, self.first)}
        self.connected: list[TcpStation] = []
        self.from_udp = self._read_udp()

    def _codec(self) -> Codec:
        return Codec(signer=self.signer, wanted=self.wanted)

    @property
    def exposed(self) -> bool:
        """Whether other machines can reach the ports without a key."""
        address = ipaddress.ip_address(self.udp.getsockname()[0])
        return self.signer is None and not address.is_loopback

    def __str__(self) -> str:
        """Addresses of the vehicle, for the console."""
        host, udp = self.udp.getsockname()
        others = f"others on {host}, UDP {udp} and TCP {self.tcp.getsockname()[1]}"
        return f"ground station on UDP {self.first[1]}, {others}{', signed' if self.signer else ''}"

    def close(self) -> None:
        """Release the ports."""
        for station in self.connected:
            station.close()
        self.udp.close()
        self.tcp.close()

    def subscribe(self, *kinds: str) -> None:
        """Decode messages of these names, too; others are ignored."""
        self.wanted.update(number for number, kind in KINDS.items() if kind.msgname in kinds)

    @property
    def _all(self) -> tuple[Station, ...]:
        return (*self.by_address.values(), *self.connected)

    def send(self, message: Any) -> None:
        """Send one message to every station, now."""
        for station in self._all:
            station.send(message)

    def post(self, message: Any, station: Station | None = None) -> None:
        """Queue one message for a station, or for all; `deliver` sends it."""
        for receiver in self._all if station is None else (station,):
            receiver.answers.append(message)

    def deliver(self) -> None:
        """Send queued messages, to each station in turn, within the time budget."""
        end = time.perf_counter() + BUDGET_S
        for _ in range(ANSWERS_PER_CALL):
            waiting = [(station, station.take()) for station in self._all if station.answers or station.stream]
            for station, message in waiting:
                if message is not None:
                    station.send(message)
            if not waiting or time.perf_counter() > end:
                return

    def receive(self) -> Iterator[Received]:
        """Read messages to this vehicle, one of each station in turn, within the time budget."""
        end = time.perf_counter() + BUDGET_S
        self._accept_connection()
        readers = [self.from_udp, *(station.reader for station in self.connected)]
        while readers:
            for reader in tuple(readers):
                found = next(reader)
                if found is None:
                    readers.remove(reader)
                    continue
                for message, station in found:
                    station.heard = time.monotonic()
                    if not station.busy:
                        yield message, station
                if time.perf_counter() > end:
                    readers.clear()
                    break
        self.connected = [station for station in self.connected if station.open]

    def _accept_connection(self) -> None:
        """Accept one connection; when full, it replaces a silent station or is refused."""
        try:
            link, _ = self.tcp.accept()
        except OSError:
            return
        if len(self.connected) >= MAX_STATIONS:
            silent = _silent_station(self.connected)
            if silent is None:
                link.close()
                return
            silent.close()
            self.connected.remove(silent)
        self.connected.append(TcpStation(self._codec(), link))

    def _read_udp(self) -> Reader:
        while True:
            try:
                data, address = self.udp.recvfrom(CHUNK)
            except OSError:
                yield None
                continue
            for message in self.datagrams.parse_datagram(data):
                station = self._station_at(address) if _is_for_us(message) else None
                yield [] if station is None else [(message, station)]
            yield []

    def _station_at(self, address: Address) -> UdpStation | None:
        """Find or add the station at an address; None when there are too many."""
        station = self.by_address.get(address)
        if station is None:
            learned = [other for other in self.by_address.values() if other.address != self.first]
            if len(learned) >= MAX_STATIONS:
                silent = _silent_station(learned)
                if silent is None:
                    return None
                del self.by_address[silent.address]
            station = self.by_address[address] = UdpStation(self._codec(), self.udp, address)
        return station


def _is_for_us(message: Any) -> bool:
    """Whether a message is for this vehicle, and not one of its own that was echoed."""
    return (
        (message.get_srcSystem(), message.get_srcComponent()) != (SYSTEM, COMPONENT)
        and getattr(message, "target_system", 0) in (0, SYSTEM)
        and getattr(message, "target_component", 0) in (0, COMPONENT)
    )


def _silent_station(stations: Sequence[S]) -> S | None:
    """The station silent for longest, if longer than `SILENCE_S`."""
    oldest = min(stations, key=lambda station: station.heard)
    return oldest if time.monotonic() - oldest.heard > SILENCE_S else None
