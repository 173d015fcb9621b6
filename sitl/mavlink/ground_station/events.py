"""What a ground station and a vehicle say to each other about parameters, apart from how it is packed and carried.

A conversation is a generator: it yields a `Turn` (what to send, and when to wake it at the latest) and is sent an
`Event` (the time, and what was heard). `drive` runs one over a link, be it a radio or a simulated one that loses,
doubles and reorders.
"""

from __future__ import annotations

from collections.abc import Generator, Sequence
from typing import NamedTuple, Protocol, TypeVar

from mimopilot.sitl.mavlink.wire.float32 import REAL32

INT32 = 6
#: Component number of an autopilot.
AUTOPILOT = 1
STORAGE_COMMAND = 245
#: MAV_RESULT.
ACCEPTED, DENIED, FAILED, IN_PROGRESS = 0, 2, 4, 5
HEARTBEAT = 0
#: MAV_TYPE of a vehicle that does not say what it is.
GENERIC = 0
#: Of PARAM_ERROR.
DOES_NOT_EXIST = 1
REASONS = {
    DOES_NOT_EXIST: "it does not exist",
    2: "value out of its range",
    3: "permission denied",
    4: "component not found",
    5: "read only",
    6: "type not supported",
    7: "wrong type",
    8: "it could not be read",
}


class Heartbeat(NamedTuple):
    """HEARTBEAT of an autopilot."""

    system: int
    component: int
    autopilot: int
    armed: bool
    mode: int = 0
    type: int = GENERIC


class Value(NamedTuple):
    """PARAM_VALUE; `kind` is its param_type, and an INT32 is the whole number that its bits stand for."""

    system: int
    component: int
    name: str
    value: float
    kind: int = REAL32


class Refusal(NamedTuple):
    """PARAM_ERROR."""

    system: int
    component: int
    name: str
    reason: int


class Ack(NamedTuple):
    """COMMAND_ACK."""

    system: int
    component: int
    command: int
    result: int


class Attitude(NamedTuple):
    """ATTITUDE: roll and pitch, rad."""

    system: int
    component: int
    roll: float
    pitch: float


class Landed(NamedTuple):
    """EXTENDED_SYS_STATE: where the vehicle is, by MAV_LANDED_STATE."""

    system: int
    component: int
    state: int


class Excited(NamedTuple):
    """DEBUG_VECT of the injector: its phase (0 roll, 1 pitch, 2 between them, -1 off) at a time of the vehicle, us."""

    system: int
    component: int
    phase: int
    time: int


class Text(NamedTuple):
    """STATUSTEXT."""

    system: int
    component: int
    text: str


class Beat(NamedTuple):
    """Our own HEARTBEAT, so that the vehicle knows where to answer."""


class Read(NamedTuple):
    """PARAM_REQUEST_READ by name."""

    system: int
    component: int
    name: str


class Write(NamedTuple):
    """PARAM_SET; `kind` as in `Value`."""

    system: int
    component: int
    name: str
    value: float
    kind: int = REAL32


class Store(NamedTuple):
    """MAV_CMD_PREFLIGHT_STORAGE: write the parameters to the vehicle's memory."""

    system: int
    component: int


class Request(NamedTuple):
    """MAV_CMD_SET_MESSAGE_INTERVAL: send a message every so many microseconds."""

    system: int
    component: int
    message: int
    interval: int


class RequestOnce(NamedTuple):
    """MAV_CMD_REQUEST_MESSAGE: send a message now."""

    system: int
    component: int
    message: int


#: What a vehicle tells of its flight.
Sight = Attitude | Landed | Excited | Text
Incoming = Heartbeat | Value | Refusal | Ack | Sight
Outgoing = Beat | Read | Write | Store | Request | RequestOnce
T = TypeVar("T")
#: Host and port of a speaker on a UDP link; `THE_PEER` on a link that has but one.
Address = tuple[str, int]
THE_PEER: Address = ("", 0)


class Heard(NamedTuple):
    """A message, and the address that it came from."""

    origin: Address
    message: Incoming


class Turn(NamedTuple):
    """What to send now, the time (s) at which to come back at the latest, and to whom; None: to every address."""

    send: Sequence[Outgoing]
    wake: float
    to: Address | None = None


class Event(NamedTuple):
    """The time (s) now, what was heard since, and whether the link is gone for good."""

    now: float
    heard: Sequence[Heard]
    closed: bool = False


Steps = Generator[Turn, Event, T]


class Link(Protocol):
    """What carries a conversation."""

    closed: bool

    def now(self) -> float:
        """Monotonic time, s."""

    def send(self, messages: Sequence[Outgoing], to: Address | None = None) -> None:
        """Send, to one address or to every one; may lose."""

    def receive(self, until: float) -> Sequence[Heard]:
        """What has been heard; waits for it until a time (s)."""


def drive(steps: Steps[T], link: Link) -> T:
    """Run a conversation over a link to its end and return its result."""
    try:
        turn = next(steps)
        while True:
            link.send(turn.send, turn.to)
            heard = link.receive(turn.wake)
            turn = steps.send(Event(link.now(), heard, link.closed))
    except StopIteration as end:
        result: T = end.value
        return result
