"""Messages between ground station and vehicle, independent of their encoding and of the link that carries them.

An exchange is a generator. It yields a `SendAndWait` (messages to send, latest time to resume) and receives a
`LinkEvent` (the time, messages received). `run_exchange` runs one over a link: a real one, or a simulated one that
loses, duplicates and reorders messages.
"""

from __future__ import annotations

from collections.abc import Generator, Sequence
from typing import NamedTuple, Protocol, TypeVar

from mimopilot.sitl.mavlink.wire.float32 import INT32, REAL32
from mimopilot.sitl.mavlink.wire.ftp import FtpPacket

#: MAV_PARAM_TYPE. PX4 sends the bits of an INT32. ArduPilot's whole numbers are INT8, INT16 or INT32, sent as floats.
INT8, INT16 = 2, 4
WHOLE = (INT8, INT16, INT32)
#: MAV_COMP_ID_AUTOPILOT1.
AUTOPILOT = 1
#: MAV_CMD_PREFLIGHT_STORAGE.
STORAGE_COMMAND = 245
#: PARAM_VALUE.param_index of a parameter that is in no list. PX4: of a module that was not started since boot.
UNKNOWN_INDEX = 65535
#: MAV_RESULT.
ACCEPTED, DENIED, FAILED, IN_PROGRESS = 0, 2, 4, 5
#: Message number of HEARTBEAT.
HEARTBEAT = 0
#: MAV_AUTOPILOT_ARDUPILOTMEGA.
ARDUPILOT = 3
#: MAV_TYPE_GENERIC, MAV_TYPE_QUADROTOR.
GENERIC, QUADROTOR = 0, 2
#: In place of a MAV_AUTOPILOT: a Crazyflie, which speaks CRTP.
CRAZYFLIE = -1
#: MAV_PARAM_ERROR of PARAM_ERROR, and its text.
DOES_NOT_EXIST, READ_ONLY = 1, 5
REASONS = {
    DOES_NOT_EXIST: "it does not exist",
    2: "value out of its range",
    3: "permission denied",
    4: "component not found",
    READ_ONLY: "read only",
    6: "type not supported",
    7: "wrong type",
    8: "it could not be read",
}


class Heartbeat(NamedTuple):
    """HEARTBEAT of an autopilot; `simulated`: it says that no real motors turn (MAV_MODE_FLAG_HIL_ENABLED)."""

    system: int
    component: int
    autopilot: int
    armed: bool
    mode: int = 0
    type: int = GENERIC
    simulated: bool = False


class ParameterValue(NamedTuple):
    """PARAM_VALUE; `kind` is its param_type, `place` its param_index."""

    system: int
    component: int
    name: str
    value: float
    kind: int = REAL32
    place: int = UNKNOWN_INDEX


class ParameterRefusal(NamedTuple):
    """PARAM_ERROR."""

    system: int
    component: int
    name: str
    reason: int


class CommandAck(NamedTuple):
    """COMMAND_ACK."""

    system: int
    component: int
    command: int
    result: int
    progress: int = 0


class AttitudeReport(NamedTuple):
    """ATTITUDE: roll and pitch, rad; time since boot, s; body rates, rad/s; yaw, rad."""

    system: int
    component: int
    roll: float
    pitch: float
    time: float = 0.0
    rates: tuple[float, float, float] = (0.0, 0.0, 0.0)
    yaw: float = 0.0


class LandedState(NamedTuple):
    """EXTENDED_SYS_STATE; `state` is MAV_LANDED_STATE."""

    system: int
    component: int
    state: int


class PowerReport(NamedTuple):
    """SYS_STATUS: charge left (%; -1: unknown), and whether logging works (None: not reported)."""

    system: int
    component: int
    charge: int
    logging: bool | None = None


class AltitudeReport(NamedTuple):
    """VFR_HUD: altitude, m; climb, m/s."""

    system: int
    component: int
    altitude: float
    climb: float = 0.0


class ThrustReport(NamedTuple):
    """ATTITUDE_TARGET: collective (0 to 1) that the vehicle flies with."""

    system: int
    component: int
    thrust: float


class StorageReport(NamedTuple):
    """STORAGE_INFORMATION of a usable card: free space, MiB."""

    system: int
    component: int
    free: float


class InjectorState(NamedTuple):
    """DEBUG_VECT of the injector: phase (0 roll, 1 pitch, 2 pause between them, -1 off), vehicle time (us)."""

    system: int
    component: int
    phase: int
    time: int


class StatusText(NamedTuple):
    """STATUSTEXT; a text of more than 50 characters comes in chunks, from number 0 on."""

    system: int
    component: int
    text: str
    chunk: int = 0

    def behind(self, last: str) -> str:
        """The text so far, with what it holds of the chunks before."""
        return last + self.text if self.chunk else self.text


class FileReply(NamedTuple):
    """FILE_TRANSFER_PROTOCOL to this ground station."""

    system: int
    component: int
    packet: FtpPacket


class LogEntry(NamedTuple):
    """LOG_ENTRY: number, number of all logs, size (bytes) and time (s since 1970; 0: unknown) of a log."""

    system: int
    component: int
    id: int
    total: int
    size: int
    time: int


class LogData(NamedTuple):
    """LOG_DATA: a piece of a log at an offset (bytes)."""

    system: int
    component: int
    id: int
    offset: int
    data: bytes


class GroundHeartbeat(NamedTuple):
    """HEARTBEAT of the ground station; the vehicle answers to where it comes from."""


class ReadParameter(NamedTuple):
    """PARAM_REQUEST_READ by name."""

    system: int
    component: int
    name: str


class SetParameter(NamedTuple):
    """PARAM_SET; `kind` as in `ParameterValue`."""

    system: int
    component: int
    name: str
    value: float
    kind: int = REAL32


class StoreParameters(NamedTuple):
    """MAV_CMD_PREFLIGHT_STORAGE: save the parameters to non-volatile memory.

    `names`: for a vehicle that saves one parameter after the other, those to save besides the ones that were written.
    """

    system: int
    component: int
    names: tuple[str, ...] = ()


class SetMessageInterval(NamedTuple):
    """MAV_CMD_SET_MESSAGE_INTERVAL: stream a message (number) at an interval (us)."""

    system: int
    component: int
    message: int
    interval: int


class RequestMessage(NamedTuple):
    """MAV_CMD_REQUEST_MESSAGE: send a message (number) once, now."""

    system: int
    component: int
    message: int


class SendCommand(NamedTuple):
    """COMMAND_LONG: a MAV_CMD and its first parameters; the others are 0."""

    system: int
    component: int
    command: int
    params: tuple[float, ...] = ()


class AttitudeTarget(NamedTuple):
    """SET_ATTITUDE_TARGET: roll, pitch and yaw (rad), and collective (0 to 1); body rates are ignored."""

    system: int
    component: int
    roll: float
    pitch: float
    yaw: float
    thrust: float


class FileRequest(NamedTuple):
    """FILE_TRANSFER_PROTOCOL."""

    system: int
    component: int
    packet: FtpPacket


class RequestLogs(NamedTuple):
    """LOG_REQUEST_LIST of the logs numbered first to last."""

    system: int
    component: int
    first: int
    last: int


class RequestLogData(NamedTuple):
    """LOG_REQUEST_DATA: a number of bytes (`length`) of a log from an offset on."""

    system: int
    component: int
    id: int
    offset: int
    length: int


class EndLogs(NamedTuple):
    """LOG_REQUEST_END: stop sending."""

    system: int
    component: int


#: Pieces of a vehicle's files and logs.
TransferReport = FileReply | LogEntry | LogData
#: Flight state that a vehicle streams.
FlightReport = (
    AttitudeReport
    | LandedState
    | PowerReport
    | AltitudeReport
    | ThrustReport
    | StorageReport
    | InjectorState
    | StatusText
)
Incoming = Heartbeat | ParameterValue | ParameterRefusal | CommandAck | FlightReport | TransferReport
Outgoing = (
    GroundHeartbeat
    | ReadParameter
    | SetParameter
    | StoreParameters
    | SetMessageInterval
    | RequestMessage
    | SendCommand
    | AttitudeTarget
    | FileRequest
    | RequestLogs
    | RequestLogData
    | EndLogs
)
T = TypeVar("T")
#: Host and port of a sender on a UDP link; `SOLE_PEER` on a point-to-point link.
Address = tuple[str, int]
SOLE_PEER: Address = ("", 0)


class Received(NamedTuple):
    """A received message and its sender's address."""

    origin: Address
    message: Incoming


class SendAndWait(NamedTuple):
    """Messages to send now, latest time (s) to resume, receiver (None: every address)."""

    send: Sequence[Outgoing]
    wake: float
    to: Address | None = None


class LinkEvent(NamedTuple):
    """The time (s) now, messages received since, and whether the link is closed for good."""

    now: float
    received: Sequence[Received]
    closed: bool = False


Exchange = Generator[SendAndWait, LinkEvent, T]


class Link(Protocol):
    """Carries an exchange."""

    @property
    def closed(self) -> bool:
        """Whether it is closed for good."""

    def now(self) -> float:
        """Monotonic time, s."""

    def send(self, messages: Sequence[Outgoing], to: Address | None = None) -> None:
        """Send to one address or to every one; messages may be lost."""

    def receive(self, until: float) -> Sequence[Received]:
        """Messages received; waits for one until a time (s)."""


def run_exchange(exchange: Exchange[T], link: Link) -> T:
    """Run an exchange over a link to its end and return its result."""
    try:
        step = next(exchange)
        while True:
            link.send(step.send, step.to)
            received = link.receive(step.wake)
            step = exchange.send(LinkEvent(link.now(), received, link.closed))
    except StopIteration as end:
        result: T = end.value
        return result
