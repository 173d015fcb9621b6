"""Ground stations of one vehicle: several at once, by UDP and by TCP, none of which can hold up the flight.

Whoever sends a sound frame is a station from then on. What is read in one call is bounded in time, what waits for a
slow reader is bounded in size, and a frame is only read when it is for this vehicle and, with a key, signed.
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

#: Time that one call of `Stations.receive` may take, and one of `Stations.deliver`, s: an eighth of a control period.
BUDGET_S = 0.0005
#: Answers that a station is sent in one call, and how many may wait: what it asks then is not heard.
SHARE, MAX_ANSWERS = 8, 100
#: Most stations of one kind, and the silence (s) after which one of them gives way to another.
MAX_STATIONS, SILENCE_S = 8, 10.0
#: A TCP station that lets more wait than this is cut off, bytes.
MAX_WAITING = 1 << 16
CHUNK = 2048

Address = tuple[str, int]
Heard = tuple[Any, "Station"]
#: Yields what was said by one message or none at all; None: nothing is there now.
Reader = Iterator["list[Heard] | None"]
S = TypeVar("S", bound="Station")


class Station:
    """One ground station: counts its own messages, so that it does not take those of another for lost ones.

    Parameters
    ----------
    codec : Codec
        Packs for it and parses what it says.
    """

    def __init__(self, codec: Codec) -> None:
        self.codec = codec
        self.heard = time.monotonic()
        self.answers: deque[Any] = deque(maxlen=2 * MAX_ANSWERS)

    @property
    def busy(self) -> bool:
        """True while so many answers wait for it that no further question of it is taken."""
        return len(self.answers) >= MAX_ANSWERS

    def send(self, message: Any) -> None:
        """One message; a station that is not there is no error."""
        self.transmit(self.codec.pack(message))

    def transmit(self, data: bytes) -> None:
        """Bytes of one message."""
        raise NotImplementedError


class UdpStation(Station):
    """Behind an address."""

    def __init__(self, codec: Codec, link: socket.socket, address: Address) -> None:
        super().__init__(codec)
        self.link, self.address = link, address

    def transmit(self, data: bytes) -> None:  # noqa: D102
        try:
            self.link.sendto(data, self.address)
        except OSError:
            return


class TcpStation(Station):
    """Behind a connection that it made."""

    def __init__(self, codec: Codec, link: socket.socket) -> None:
        super().__init__(codec)
        self.link, self.open = link, True
        self.waiting = b""
        self.reader = self._read()
        link.setblocking(False)
        link.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    def transmit(self, data: bytes) -> None:  # noqa: D102
        if not self.open:
            return
        self.waiting += data
        try:
            self.waiting = self.waiting[self.link.send(self.waiting) :]
        except BlockingIOError:
            pass
        except OSError:
            self.close()
        if len(self.waiting) > MAX_WAITING:
            self.close()

    def close(self) -> None:
        """Cut it off."""
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
                yield [(message, self)] if message is not None and _is_ours(message) else []
            yield []


class Stations:
    """All ground stations.

    Parameters
    ----------
    ground_port : int
        UDP port on this machine where a station listens; it is spoken to from the start.
    udp_port, tcp_port : int
        Local ports where stations may speak first; 0: any free one.
    bind : str
        Local address of both.
    signer : Signer, optional
        Signs all that is sent; nothing unsigned is then heard.

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
        """Whether other machines can reach them, and nothing asks who they are."""
        address = ipaddress.ip_address(self.udp.getsockname()[0])
        return self.signer is None and not address.is_loopback

    def __str__(self) -> str:
        """Where they find the vehicle."""
        host, udp = self.udp.getsockname()
        others = f"others on {host}, UDP {udp} and TCP {self.tcp.getsockname()[1]}"
        return f"ground station on UDP {self.first[1]}, {others}{', signed' if self.signer else ''}"

    def close(self) -> None:
        """Release the ports."""
        for station in self.connected:
            station.close()
        self.udp.close()
        self.tcp.close()

    def hear(self, *kinds: str) -> None:
        """Messages of these kinds mean something to the vehicle; others are passed over."""
        self.wanted.update(number for number, kind in KINDS.items() if kind.msgname in kinds)

    @property
    def _all(self) -> tuple[Station, ...]:
        return (*self.by_address.values(), *self.connected)

    def send(self, message: Any) -> None:
        """One message to every station, now."""
        for station in self._all:
            station.send(message)

    def post(self, message: Any, station: Station | None = None) -> None:
        """One message to a station, or to all, after what waits for it already; see `deliver`."""
        for receiver in self._all if station is None else (station,):
            receiver.answers.append(message)

    def deliver(self) -> None:
        """Send some of what waits, to each station in turn."""
        end = time.perf_counter() + BUDGET_S
        for _ in range(SHARE):
            waiting = [station for station in self._all if station.answers]
            for station in waiting:
                station.send(station.answers.popleft())
            if not waiting or time.perf_counter() > end:
                return

    def receive(self) -> Iterator[Heard]:
        """What stations say to this vehicle, one message of each in turn, until nothing is left or the time is up."""
        end = time.perf_counter() + BUDGET_S
        self._admit()
        busy = [self.from_udp, *(station.reader for station in self.connected)]
        while busy:
            for reader in tuple(busy):
                found = next(reader)
                if found is None:
                    busy.remove(reader)
                    continue
                for message, station in found:
                    station.heard = time.monotonic()
                    if not station.busy:
                        yield message, station
                if time.perf_counter() > end:
                    busy.clear()
                    break
        self.connected = [station for station in self.connected if station.open]

    def _admit(self) -> None:
        """Let one more connection in."""
        try:
            link, _ = self.tcp.accept()
        except OSError:
            return
        if len(self.connected) >= MAX_STATIONS:
            silent = _silent(self.connected)
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
                station = self._at(address) if _is_ours(message) else None
                yield [] if station is None else [(message, station)]
            yield []

    def _at(self, address: Address) -> UdpStation | None:
        """The station at an address, new or known; None when there are too many."""
        station = self.by_address.get(address)
        if station is None:
            learned = [other for other in self.by_address.values() if other.address != self.first]
            if len(learned) >= MAX_STATIONS:
                silent = _silent(learned)
                if silent is None:
                    return None
                del self.by_address[silent.address]
            station = self.by_address[address] = UdpStation(self._codec(), self.udp, address)
        return station


def _is_ours(message: Any) -> bool:
    """Whether a message is for this vehicle, and not one of its own that came back."""
    return (
        (message.get_srcSystem(), message.get_srcComponent()) != (SYSTEM, COMPONENT)
        and getattr(message, "target_system", 0) in (0, SYSTEM)
        and getattr(message, "target_component", 0) in (0, COMPONENT)
    )


def _silent(stations: Sequence[S]) -> S | None:
    """The station that was silent for longest, if that is long."""
    oldest = min(stations, key=lambda station: station.heard)
    return oldest if time.monotonic() - oldest.heard > SILENCE_S else None
