"""Who is on the link: the one vehicle that is talked to, what it says of itself, and what speaks against it.

No socket and no clock: see `sitl.mavlink.ground_station.events` for how a conversation is driven.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

from mimopilot.sitl.errors import SitlError
from mimopilot.sitl.mavlink.ground_station.events import (
    AUTOPILOT,
    HEARTBEAT,
    Ack,
    Address,
    Beat,
    Heartbeat,
    Outgoing,
    Refusal,
    RequestOnce,
    Sight,
    Steps,
    Turn,
    Value,
)
from mimopilot.sitl.mavlink.wire.float32 import shortest

#: One try, s; how many. At 30 % loss each way 24 tries lose 1 exchange in 10^7.
TRY_S, TRIES = 0.5, 24
#: A HEARTBEAT older than this (s) does not tell whether the vehicle is armed now: it comes once a second.
FRESH_S = 1.5
#: Whoever sends HEARTBEAT once a second, as MAVLink asks, is heard in this time (s).
LISTEN_S = 1.2
BEAT_S = 1.0


class Contact:
    """State of a talk with one vehicle, from its first HEARTBEAT on.

    Parameters
    ----------
    now : float, s
        Time at the start.
    tries : int
        How often a request is sent before its silence is final.
    system : int
        The vehicle's system number; 0: the first that is heard.
    force_armed : bool
        Write even while it is armed.

    Attributes
    ----------
    vehicle : Heartbeat or None
        Its last HEARTBEAT.
    address : Address or None
        Where its first HEARTBEAT came from: all is sent there, and only what comes from there counts.
    others : set of int
        Systems of other autopilots on the link.
    interrupted : bool
        Set from outside (Ctrl-C): reading and writing end, putting back does not.
    possible : dict
        Name -> every value that the vehicle may hold now, given what was sent and heard.
    written : set of str
        Names for which a write was ever sent.
    was_armed : bool
        It said so after the first write.
    contradiction : str
        What it stated against a value that was agreed on; empty: nothing.
    progress : callable
        Told (phase, done, of) after each answer.
    witness : callable
        Told what else the vehicle says, whatever the talk is about.
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
        self.witness: Callable[[Sight], None] = lambda sight: None
        self._agreed: dict[str, float] | None = None
        self._doubled = ""
        self._heartbeat_at = self._heard_at = now
        self._beat_due = self._request_due = now

    @property
    def patience(self) -> float:
        """Silence that is taken for the end, s."""
        return self.tries * TRY_S

    @property
    def silence(self) -> float:
        """Age of the last HEARTBEAT, s."""
        return self.now - self._heartbeat_at

    @property
    def gone(self) -> bool:
        """True when the link is closed, or the vehicle silent for too long."""
        return self.closed or self.now - self._heard_at >= self.patience

    @property
    def trouble(self) -> str:
        """What was heard that forbids success from now on; empty: nothing."""
        if self.was_armed and not self.force_armed:
            return "the vehicle was armed before the last reading"
        return self._doubled or self.contradiction

    def watch(self, on: bool) -> None:
        """From now on what contradicts a value that was read counts, or (False) no longer."""
        self._agreed = {} if on else None
        self.contradiction = ""

    def agree(self, name: str, value: float | None) -> None:
        """A value was read, or (None) the vehicle is told another."""
        if self._agreed is not None and value is not None:
            self._agreed[name] = value
        elif self._agreed is not None:
            self._agreed.pop(name, None)

    def resume(self, now: float) -> None:
        """Go on after a pause in which nobody listened: writing waits for another HEARTBEAT."""
        self.now = self._heard_at = now
        self._heartbeat_at = now - FRESH_S

    def turn(self, send: Sequence[Outgoing], wake: float) -> Steps[list[Value | Refusal | Ack]]:
        """Send, wait, and return what the vehicle itself said; every other speaker is ignored."""
        if self.now >= self._beat_due:
            send = [Beat(), *send]
            self._beat_due = self.now + BEAT_S
        event = yield Turn(send, min(wake, self._beat_due), self.address)
        self.now, self.closed = event.now, event.closed
        heard: list[Value | Refusal | Ack] = []
        for origin, message in event.heard:
            if message.component != AUTOPILOT:
                continue
            if self.vehicle is None and isinstance(message, Heartbeat) and self.system in (0, message.system):
                self.vehicle, self.address = message, origin
            if self.vehicle is None or message.system != self.vehicle.system:
                if isinstance(message, Heartbeat):
                    self.others.add(message.system)
                continue
            if origin != self.address:
                self._find_double(origin)
                continue
            self._heard_at = self.now
            if isinstance(message, Heartbeat):
                self.vehicle, self._heartbeat_at = message, self.now
                self.was_armed |= message.armed and bool(self.written)
            elif isinstance(message, Value | Refusal | Ack):
                self._compare(message)
                heard.append(message)
            else:
                self.witness(message)
        return heard

    def _find_double(self, origin: Address) -> None:
        assert self.vehicle is not None
        assert self.address is not None
        first, second = (f"{host}:{port}" for host, port in (self.address, origin))
        self._doubled = (
            f"system {self.vehicle.system} is heard from two addresses, {first} and {second}: "
            "take one vehicle off the link, or give it another system number"
        )

    def _compare(self, message: Value | Refusal | Ack) -> None:
        """See whether a value contradicts what was agreed on."""
        if not isinstance(message, Value) or self._agreed is None:
            return
        agreed = self._agreed.get(message.name, message.value)
        if message.value != agreed:
            self.possible[message.name].add(message.value)
            self.contradiction = f"{message.name}: {shortest(message.value)}, after the vehicle said {shortest(agreed)}"

    def meet(self) -> Steps[Heartbeat]:
        """Wait for the vehicle's HEARTBEAT, and hear who else is there.

        Raises
        ------
        SitlError
            When none comes in time, or it is not clear which vehicle is meant.
        """
        deadline, until = self.now + self.patience, self.now + LISTEN_S
        while self.vehicle is None or self.now < until:
            if self.interrupted:
                raise SitlError("interrupted; nothing was written", exit_code=1)
            if self.closed:
                raise SitlError("the link was lost; nothing was written", exit_code=1)
            if self.vehicle is None and self.now >= deadline:
                whose = f"of system {self.system}" if self.system else "of an autopilot"
                raise SitlError(f"no HEARTBEAT {whose} in {self.patience:g} s", exit_code=1)
            unknown = self.vehicle is None
            yield from self.turn([], deadline if unknown else until)
            if unknown:
                until = self.now + LISTEN_S
        if self.others and not self.system:
            systems = ", ".join(map(str, sorted({self.vehicle.system, *self.others})))
            raise SitlError(f"several vehicles are on this link (systems {systems}); say which with --system")
        if self._doubled:
            raise SitlError(f"{self._doubled}; nothing was written")
        return self.vehicle

    def request_heartbeat(self) -> list[Outgoing]:
        """What asks for a HEARTBEAT, at most once a try."""
        assert self.vehicle is not None
        if self.now < self._request_due:
            return []
        self._request_due = self.now + TRY_S
        return [RequestOnce(self.vehicle.system, self.vehicle.component, HEARTBEAT)]
