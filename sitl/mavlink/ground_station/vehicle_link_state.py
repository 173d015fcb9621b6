"""State of the contact with one vehicle: its HEARTBEAT, other autopilots on the link, contradictions.

No socket and no clock: see `sitl.mavlink.ground_station.events` for how an exchange is run.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

from mimopilot.sitl.errors import SitlError
from mimopilot.sitl.mavlink.ground_station.events import (
    AUTOPILOT,
    HEARTBEAT,
    Address,
    CommandAck,
    Exchange,
    FlightReport,
    GroundHeartbeat,
    Heartbeat,
    Outgoing,
    ParameterRefusal,
    ParameterValue,
    RequestMessage,
    SendAndWait,
    SendCommand,
    TransferReport,
)
from mimopilot.sitl.mavlink.wire.float32 import shortest

#: Wait for an answer to one try (s), number of tries. At 30 % loss each way 24 tries lose 1 exchange in 10^7.
TRY_S, TRIES = 0.5, 24
#: Beyond this age (s) a HEARTBEAT no longer shows whether the vehicle is armed. Its period is 1 s.
FRESH_S = 1.5
#: Listening time (s) in which every autopilot is heard: the HEARTBEAT period of 1 s, and a margin.
LISTEN_S = 1.2
#: Period of our own HEARTBEAT (s), as MAVLink asks.
BEAT_S = 1.0


class VehicleLinkState:
    """State of the contact with one vehicle, from its first HEARTBEAT on.

    Parameters
    ----------
    now : float, s
        Time at the start.
    tries : int
        How often a request is sent before it counts as unanswered.
    system : int
        The vehicle's system number; 0: the first one heard.
    force_armed : bool
        Write even if it is armed.

    Attributes
    ----------
    vehicle : Heartbeat or None
        Its last HEARTBEAT.
    address : Address or None
        Sender of its first HEARTBEAT. Messages go only there; those from elsewhere are ignored.
    others : set of int
        Systems of other autopilots on the link.
    interrupted : bool
        Set by the caller (Ctrl-C): ends reading and writing, but not a roll-back.
    possible : dict
        Name -> every value that the vehicle may hold now, given all messages sent and received.
    written : set of str
        Names of which a write was sent.
    was_armed : bool
        It reported armed after the first write.
    contradiction : str
        A reported value that differs from the one agreed on; empty: none.
    progress : callable
        Called with (phase, done, of) after each answer.
    on_report : callable
        Called with each `FlightReport` and `TransferReport` of the vehicle.
    """

    def __init__(self, now: float, tries: int = TRIES, system: int = 0, force_armed: bool = False) -> None:
        self.now, self.tries, self.system, self.force_armed = now, tries, system, force_armed
        self.vehicle: Heartbeat | None = None
        self.address: Address | None = None
        self.others: set[int] = set()
        self.interrupted = self.closed = self.was_armed = False
        self.possible: dict[str, set[float]] = {}
        self.written: set[str] = set()
        self.contradiction = ""
        self.progress: Callable[[str, int, int], None] = lambda phase, done, of: None
        self.on_report: Callable[[FlightReport | TransferReport], None] = lambda report: None
        self._agreed: dict[str, float] | None = None
        self._duplicate = ""
        self._heartbeat_at = self._heard_at = now
        self._beat_due = self._request_due = now

    @property
    def timeout(self) -> float:
        """Time without a message after which the vehicle counts as lost, s."""
        return self.tries * TRY_S

    @property
    def heartbeat_age(self) -> float:
        """Age of the last HEARTBEAT, s."""
        return self.now - self._heartbeat_at

    @property
    def lost(self) -> bool:
        """True if the link is closed, or no message came within `timeout`."""
        return self.closed or self.now - self._heard_at >= self.timeout

    @property
    def failure(self) -> str:
        """Why the upload can no longer succeed; empty: it can."""
        if self.was_armed and not self.force_armed:
            return "the vehicle was armed before the last reading"
        return self._duplicate or self.contradiction

    def check_contradictions(self, on: bool) -> None:
        """Start or stop checking reported values against those agreed on."""
        self._agreed = {} if on else None
        self.contradiction = ""

    def _set_agreed(self, name: str, value: float | None) -> None:
        """Record a value that was read; None: another is being written, nothing is agreed on."""
        if self._agreed is not None and value is not None:
            self._agreed[name] = value
        elif self._agreed is not None:
            self._agreed.pop(name, None)

    def forget(self, name: str) -> None:
        """Forget what was read of a parameter that the vehicle changes by itself."""
        self._set_agreed(name, None)
        self.possible.pop(name, None)

    def resume(self, now: float) -> None:
        """Continue after a pause without receiving: writing waits for a new HEARTBEAT."""
        self.now = self._heard_at = now
        self._heartbeat_at = now - FRESH_S

    def send_and_wait(
        self, send: Sequence[Outgoing], wake: float
    ) -> Exchange[list[ParameterValue | ParameterRefusal | CommandAck]]:
        """Send, wait, and return the vehicle's own answers; every other sender is ignored."""
        if self.now >= self._beat_due:
            send = [GroundHeartbeat(), *send]
            self._beat_due = self.now + BEAT_S
        event = yield SendAndWait(send, min(wake, self._beat_due), self.address)
        self.now, self.closed = event.now, event.closed
        answers: list[ParameterValue | ParameterRefusal | CommandAck] = []
        for origin, message in event.received:
            if message.component != AUTOPILOT:
                continue
            if self.vehicle is None and isinstance(message, Heartbeat) and self.system in (0, message.system):
                self.vehicle, self.address = message, origin
            if self.vehicle is None or message.system != self.vehicle.system:
                if isinstance(message, Heartbeat):
                    self.others.add(message.system)
                continue
            if origin != self.address:
                self._report_duplicate(origin)
                continue
            self._heard_at = self.now
            if isinstance(message, Heartbeat):
                self.vehicle, self._heartbeat_at = message, self.now
                self.was_armed |= message.armed and bool(self.written)
            elif isinstance(message, ParameterValue | ParameterRefusal | CommandAck):
                self._check_against_agreed(message)
                answers.append(message)
            else:
                self.on_report(message)
        return answers

    def _report_duplicate(self, origin: Address) -> None:
        assert self.vehicle is not None
        assert self.address is not None
        first, second = (f"{host}:{port}" for host, port in (self.address, origin))
        self._duplicate = (
            f"system {self.vehicle.system} is heard from two addresses, {first} and {second}: "
            "take one vehicle off the link, or give it another system number"
        )

    def _check_against_agreed(self, message: ParameterValue | ParameterRefusal | CommandAck) -> None:
        """Record a value that contradicts the one agreed on."""
        if not isinstance(message, ParameterValue) or self._agreed is None:
            return
        agreed = self._agreed.get(message.name, message.value)
        if message.value != agreed:
            self.possible[message.name].add(message.value)
            values = f"{shortest(message.value)}, after the vehicle reported {shortest(agreed)}"
            self.contradiction = f"{message.name}: {values}"

    def await_heartbeat(self) -> Exchange[Heartbeat]:
        """Wait for the vehicle's HEARTBEAT, and find out which other autopilots are on the link.

        Raises
        ------
        SitlError
            If none comes in time, or it is ambiguous which vehicle is meant.
        """
        deadline, until = self.now + self.timeout, self.now + LISTEN_S
        while self.vehicle is None or self.now < until:
            if self.interrupted:
                raise SitlError("interrupted; nothing was written", exit_code=1)
            if self.closed:
                raise SitlError("the link was lost; nothing was written", exit_code=1)
            if self.vehicle is None and self.now >= deadline:
                whose = f"of system {self.system}" if self.system else "of an autopilot"
                raise SitlError(f"no HEARTBEAT {whose} in {self.timeout:g} s", exit_code=1)
            unknown = self.vehicle is None
            yield from self.send_and_wait([], deadline if unknown else until)
            if unknown:
                until = self.now + LISTEN_S
        if self.others and not self.system:
            systems = ", ".join(map(str, sorted({self.vehicle.system, *self.others})))
            raise SitlError(f"several vehicles are on this link (systems {systems}); choose one with --system")
        if self._duplicate:
            raise SitlError(f"{self._duplicate}; nothing was written")
        return self.vehicle

    def request_heartbeat(self) -> list[Outgoing]:
        """Request for a HEARTBEAT, at most once every `TRY_S`."""
        assert self.vehicle is not None
        if self.now < self._request_due:
            return []
        self._request_due = self.now + TRY_S
        return [RequestMessage(self.vehicle.system, self.vehicle.component, HEARTBEAT)]

    def command(
        self,
        number: int,
        parameters: Sequence[float],
        is_final: Callable[[CommandAck], bool] = lambda ack: True,
        is_over: Callable[[], bool] = lambda: False,
    ) -> Exchange[CommandAck | None]:
        """Command the vehicle, again every `TRY_S` until it has acknowledged; returns None when it does not.

        Parameters
        ----------
        number : int
            MAV_CMD.
        parameters : sequence of float
            The first of its seven parameters.
        is_final : callable
            Whether an acknowledgement is the last one. After another, as of a command in progress, all tries are left.
        is_over : callable
            Asked before each repetition: whether no acknowledgement is to be expected any more.
        """
        assert self.vehicle is not None
        order = SendCommand(self.vehicle.system, self.vehicle.component, number, tuple(parameters))
        left, due, sent = self.tries, self.now, False
        while not self.closed:
            send: list[Outgoing] = []
            if self.now >= due:
                if not left or (sent and is_over()):
                    return None
                left, due, send, sent = left - 1, self.now + TRY_S, [order], True
            for answer in (yield from self.send_and_wait(send, due)):
                if not isinstance(answer, CommandAck) or answer.command != number:
                    continue
                if is_final(answer):
                    return answer
                left = self.tries
        return None
