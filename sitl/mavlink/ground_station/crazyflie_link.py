"""A link to a Crazyflie that carries the messages of `sitl.mavlink.ground_station.events`: parameters and HEARTBEAT.

So an upload to a Crazyflie is the upload to any other vehicle, with every check of it. The table of contents, storing
one parameter after the other, and the supervisor's state, which becomes a HEARTBEAT, are CRTP's own and stay in here.
Requests of these are sent again until they are answered; those of parameters are the client's, which sends them again.
"""

from __future__ import annotations

import struct
import time
from collections.abc import Sequence

from mimopilot.sitl.crtp import packets
from mimopilot.sitl.crtp.driver import CrtpDriver
from mimopilot.sitl.crtp.packets import Packet, TocEntry
from mimopilot.sitl.errors import SitlError
from mimopilot.sitl.mavlink.ground_station.events import (
    ACCEPTED,
    AUTOPILOT,
    CRAZYFLIE,
    DOES_NOT_EXIST,
    FAILED,
    QUADROTOR,
    READ_ONLY,
    SOLE_PEER,
    STORAGE_COMMAND,
    Address,
    CommandAck,
    Heartbeat,
    Incoming,
    Outgoing,
    ParameterRefusal,
    ParameterValue,
    ReadParameter,
    Received,
    RequestMessage,
    SetParameter,
    StoreParameters,
)
from mimopilot.sitl.mavlink.wire.float32 import REAL32
from mimopilot.tuning.crazyflie_names import crazyflie_name
from mimopilot.tuning.parameter_row import PREFIX

#: Number of the only vehicle on the link.
SYSTEM = 1
#: s until a request of the link's own is sent again; chosen: ten round trips of the radio.
AGAIN_S = 0.2
#: s between two requests of the supervisor's state: MAVLink's period of HEARTBEAT.
STATE_S = 1.0
#: Most requests of table entries on the way; chosen.
WINDOW = 10
#: param_type of a value that single precision may not hold (MAV_PARAM_TYPE_REAL64).
NOT_SINGLE = 10
#: Errors of a parameter that could not be read (MAV_PARAM_ERROR).
READ_FAILED = 8


class CrazyflieLink:
    """A link to a Crazyflie; see `sitl.mavlink.ground_station.events.Link`.

    Parameters
    ----------
    uri : str
        See `sitl.crtp.driver.CrtpDriver`.

    Raises
    ------
    SitlError
        When it cannot be opened.
    """

    def __init__(self, uri: str) -> None:
        self.uri = uri
        self.driver = CrtpDriver(uri)
        self._entries: dict[int, TocEntry] = {}
        self._numbers: dict[str, int] = {}
        self._count: int | None = None
        self._answers: list[Incoming] = []
        # Requests of the link's own -> when to send them again.
        self._due: dict[Packet, float] = {packets.request_version(): 0.0}
        self._state_due = 0.0
        # Parameters written and not stored, the last one last; the one whose storing is under way is the first.
        self._unstored: dict[str, None] = {}
        self._storing = False
        self._heard = self._too_old = False

    @property
    def closed(self) -> bool:
        """Whether the link is lost."""
        return self.driver.closed

    @property
    def hint(self) -> str:
        """Why no vehicle was identified; empty: one was, or the message says it."""
        if self._too_old:
            return ""
        if not self._heard:
            return (
                f"; no Crazyflie answers at {self.uri}: is it on, and are channel, rate and address those of "
                "its configuration?"
            )
        if self._count is None or len(self._entries) < self._count:
            return f"; its table of parameters was received in part ({len(self._entries)} of {self._count or '?'})"
        return ""

    def close(self) -> None:
        """Close the link."""
        self.driver.close()

    def now(self) -> float:
        """Monotonic time, s."""
        return time.monotonic()

    def discard(self) -> None:
        """Discard all messages that are waiting."""
        self._answers.clear()
        while self.driver.receive(0.0) is not None:
            pass

    def send(self, messages: Sequence[Outgoing], to: Address | None = None) -> None:
        """Send; a message that cannot be sent is lost, as on a radio."""
        for message in messages:
            if isinstance(message, ReadParameter | SetParameter):
                self._send_parameter(message)
            elif isinstance(message, StoreParameters):
                if not self._storing:  # else it is the same command, sent again
                    self._unstored = dict.fromkeys(name for name in message.names if name not in self._unstored) | (
                        self._unstored
                    )
                self._storing = True
                self._store_next()
            elif isinstance(message, RequestMessage) and self._complete:
                self._due[packets.request_state()] = 0.0

    def receive(self, until: float) -> list[Received]:
        """Messages received; waits for one until a time (s).

        Raises
        ------
        SitlError
            When the firmware is too old to tell whether it flies.
        """
        while not self._answers and not self.closed:
            self._send_due()
            wake = min([until, *self._due.values(), *([self._state_due] if self._complete else [])])
            packet = self.driver.receive(wake - self.now())
            if packet is not None:
                self._take(packet)
            elif self.now() >= until:
                break
        answers, self._answers = self._answers, []
        return [Received(SOLE_PEER, message) for message in answers]

    @property
    def _complete(self) -> bool:
        """Whether the whole table of contents is known."""
        return self._count is not None and len(self._entries) == self._count

    def _send_due(self) -> None:
        now = self.now()
        if self._complete and now >= self._state_due:
            self._due.setdefault(packets.request_state(), now)
            self._state_due = now + STATE_S
        for packet in [packet for packet, due in self._due.items() if due <= now]:
            self.driver.send(packet)
            self._due[packet] = self.now() + AGAIN_S

    def _send_parameter(self, message: ReadParameter | SetParameter) -> None:
        entry = self._entry(message.name)
        if entry is None:
            self._refuse(message.name, DOES_NOT_EXIST)
        elif isinstance(message, ReadParameter):
            self.driver.send(packets.request_value(entry))
        elif entry.read_only:  # which the firmware does not answer
            self._refuse(message.name, READ_ONLY)
        else:
            self._unstored.pop(message.name, None)
            self._unstored[message.name] = None
            self.driver.send(packets.write_value(entry, message.value))

    def _entry(self, name: str) -> TocEntry | None:
        number = self._numbers.get(crazyflie_name(name) if name.startswith(PREFIX) else name)
        return None if number is None else self._entries[number]

    def _refuse(self, name: str, reason: int) -> None:
        self._answers.append(ParameterRefusal(SYSTEM, AUTOPILOT, name, reason))

    def _store_next(self) -> None:
        """Store the parameter that was written first; or report that all are stored.

        One after the other, the switch that was written last being the last: a vehicle that restarts in between does
        not fly a set of which only a part was stored.
        """
        if not self._storing:
            return
        entry = next((entry for name in self._unstored if (entry := self._entry(name)) is not None), None)
        if entry is None:
            self._finish_storing(ACCEPTED)
        else:
            self._due.setdefault(packets.store_value(entry), 0.0)

    def _finish_storing(self, result: int) -> None:
        self._storing = False
        self._answers.append(CommandAck(SYSTEM, AUTOPILOT, STORAGE_COMMAND, result))

    def _take(self, packet: Packet) -> None:
        """Process a packet of the vehicle."""
        port, channel, data = packet
        if not data:
            return
        if port == packets.PLATFORM and channel == packets.VERSION and data[0] == packets.PROTOCOL:
            self._take_version(data)
        elif port == packets.SUPERVISOR and data[0] == packets.ANSWER | packets.STATE_BITS and len(data) >= 3:
            self._due.pop(packets.request_state(), None)
            self._answers.append(_heartbeat(struct.unpack_from("<H", data, 1)[0]))
        elif port == packets.PARAM and channel == packets.TOC:
            self._take_contents(data)
        elif port == packets.PARAM:
            self._take_parameter(channel, data)

    def _take_version(self, data: bytes) -> None:
        self._heard = True
        self._due.pop(packets.request_version(), None)
        self._too_old = len(data) > 1 and data[1] < packets.SUPERVISOR_SINCE
        if self._too_old:
            raise SitlError(
                f"the Crazyflie speaks version {data[1]} of CRTP, which does not tell whether it flies: flash firmware "
                "2026.04 or later with our app (mimopilot generate --target crazyflie); nothing was written"
            )
        self._due.setdefault(packets.request_count(), 0.0)

    def _take_contents(self, data: bytes) -> None:
        if data[0] == packets.COUNT and len(data) >= 3 and self._count is None:
            self._due.pop(packets.request_count(), None)
            (self._count,) = struct.unpack_from("<H", data, 1)
        elif data[0] == packets.ITEM:
            entry = packets.parsed_entry(data)
            if entry is None or self._due.pop(packets.request_item(entry.number), None) is None:
                return
            self._entries[entry.number] = entry
            self._numbers[entry.name] = entry.number
        for number in range(self._count or 0):
            if len(self._due) >= WINDOW:
                break
            if number not in self._entries:
                self._due.setdefault(packets.request_item(number), 0.0)

    def _take_parameter(self, channel: int, data: bytes) -> None:
        misc = channel == packets.MISC
        if len(data) < (4 if misc else 3):
            return
        entry = self._entries.get(struct.unpack_from("<H", data, 1 if misc else 0)[0])
        if entry is None:
            return
        if misc and data[0] == packets.STORE:
            self._take_stored(entry, data[3])
        elif channel == packets.READ and data[2]:
            self._refuse(_name(entry), DOES_NOT_EXIST if data[2] == packets.NOT_FOUND else READ_FAILED)
        elif channel in (packets.READ, packets.WRITE) or (misc and data[0] == packets.UPDATED):
            value = packets.parsed_value(entry, data[2 if channel == packets.WRITE else 3 :])
            if value is None:
                # Too short for its type: the answer to a write that found no such parameter.
                self._refuse(_name(entry), DOES_NOT_EXIST)
            else:
                kind = REAL32 if entry.exact else NOT_SINGLE
                self._answers.append(ParameterValue(SYSTEM, AUTOPILOT, _name(entry), value, kind))

    def _take_stored(self, entry: TocEntry, error: int) -> None:
        if self._due.pop(packets.store_value(entry), None) is None:
            return
        if error:
            self._finish_storing(FAILED)
            return
        self._unstored.pop(_name(entry), None)
        self._store_next()


def _name(entry: TocEntry) -> str:
    """A parameter's name in our table; another one's as it is."""
    group, _, name = entry.name.partition(".")
    return f"{PREFIX}{name}" if crazyflie_name(f"{PREFIX}{name}") == entry.name else f"{group}.{name}"


def _heartbeat(bits: int) -> Heartbeat:
    """HEARTBEAT of the supervisor's state.

    A vehicle that arms itself, as those with brushed motors do, is always armed: there, flying counts.
    """
    armed = bool(bits & packets.FLYING or (bits & packets.ARMED and not bits & packets.AUTO_ARMED))
    return Heartbeat(SYSTEM, AUTOPILOT, CRAZYFLIE, armed, type=QUADROTOR)
