"""The parameter protocol of one ground station with one vehicle: what to send, and when to believe an answer.

No socket and no clock: see `sitl.mavlink.words` for how a conversation is driven.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

from sitl.errors import SitlError
from sitl.mavlink.words import (
    ACCEPTED,
    AUTOPILOT,
    FAILED,
    IN_PROGRESS,
    INT32,
    REAL32,
    REASONS,
    STORAGE_COMMAND,
    Ack,
    Beat,
    Heartbeat,
    Outgoing,
    Read,
    Refusal,
    Sight,
    Steps,
    Store,
    Turn,
    Value,
    Write,
    shortest,
)

#: One try, s; how many; how many requests may be under way. At 30 % loss each way 24 tries lose 1 exchange in 10^7.
TRY_S, TRIES, WINDOW = 0.5, 24, 10
#: A HEARTBEAT older than this (s) does not tell whether the vehicle is armed now: writing waits for the next.
FRESH_S = 3.0
#: After so many tries that were answered with another value, the vehicle is believed to keep that.
CONTRADICTIONS = 4
#: PX4 saves by itself at most 2.3 s after a change, ArduPilot sooner.
AUTOSAVE_S = 2.5
#: Least silence (s) after which what was sent before is taken to have arrived or to be lost.
QUIET_S = 0.1
BEAT_S = 1.0


class Answer(NamedTuple):
    """End of one request: the value that the vehicle stated last, and what is wrong (empty: nothing)."""

    value: float | None
    problem: str = ""


@dataclass
class _Request:
    """One request under way."""

    began: float
    due: float
    tries: int = 0
    contradicted: set[int] = field(default_factory=set)
    kept: float | None = None


class Conversation:
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
    integers : collection of str
        Names that may be whole numbers on the vehicle; all others must be floats there.

    Attributes
    ----------
    vehicle : Heartbeat or None
        Its last HEARTBEAT.
    others : set of int
        Systems of other autopilots on the link.
    interrupted : bool
        Set from outside (Ctrl-C): reading and writing end, putting back does not.
    possible : dict
        Name -> every value that the vehicle may hold now, given what was sent and heard.
    written : set of str
        Names for which a write was ever sent.
    progress : callable
        Told (phase, done, of) after each answer.
    witness : callable
        Told what else the vehicle says, whatever the talk is about.
    """

    def __init__(
        self,
        now: float,
        tries: int = TRIES,
        system: int = 0,
        force_armed: bool = False,
        integers: Collection[str] = (),
    ) -> None:
        self.now, self.tries, self.system, self.force_armed = now, tries, system, force_armed
        self.integers = integers
        self.vehicle: Heartbeat | None = None
        self.others: set[int] = set()
        self.interrupted = self.closed = False
        self.possible: dict[str, set[float]] = {}
        self.written: set[str] = set()
        self.progress: Callable[[str, int, int], None] = lambda phase, done, of: None
        self.witness: Callable[[Sight], None] = lambda sight: None
        self._kinds: dict[str, int] = {}
        self._heartbeat_at = self._heard_at = now
        self._beat_due = now
        # Longest exchange, and longest of those answered at the first try: only these are sure to be a round trip.
        self._longest = self._round_trip = 0.0

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

    def resume(self, now: float) -> None:
        """Go on after a pause in which nobody listened: writing waits for another HEARTBEAT."""
        self.now = self._heard_at = now
        self._heartbeat_at = now - FRESH_S

    def turn(self, send: Sequence[Outgoing], wake: float) -> Steps[list[Value | Refusal | Ack]]:
        """Send, wait, and return what the vehicle itself said; every other speaker is ignored."""
        if self.now >= self._beat_due:
            send = [Beat(), *send]
            self._beat_due = self.now + BEAT_S
        event = yield Turn(send, min(wake, self._beat_due))
        self.now, self.closed = event.now, event.closed
        heard: list[Value | Refusal | Ack] = []
        for message in event.heard:
            if message.component != AUTOPILOT:
                continue
            if self.vehicle is None and isinstance(message, Heartbeat) and self.system in (0, message.system):
                self.vehicle = message
            if self.vehicle is None or message.system != self.vehicle.system:
                if isinstance(message, Heartbeat):
                    self.others.add(message.system)
                continue
            self._heard_at = self.now
            if isinstance(message, Heartbeat):
                self.vehicle, self._heartbeat_at = message, self.now
            elif isinstance(message, Value | Refusal | Ack):
                heard.append(message)
            else:
                self.witness(message)
        return heard

    def meet(self) -> Steps[Heartbeat]:
        """Wait for the vehicle's HEARTBEAT.

        Raises
        ------
        SitlError
            When none comes in time.
        """
        deadline = self.now + self.patience
        while self.vehicle is None:
            if self.interrupted:
                raise SitlError("interrupted; nothing was written", exit_code=1)
            if self.closed:
                raise SitlError("the link was lost; nothing was written", exit_code=1)
            if self.now >= deadline:
                whose = f"of system {self.system}" if self.system else "of an autopilot"
                raise SitlError(f"no HEARTBEAT {whose} in {self.patience:g} s", exit_code=1)
            yield from self.turn([], deadline)
        return self.vehicle

    def ask(self, names: Sequence[str], phase: str, keep_going: bool = False) -> Steps[dict[str, Answer]]:
        """Read each by name. Ends at the first that fails, unless told to keep going (which Ctrl-C does not end)."""
        answers = yield from self._exchange(dict.fromkeys(names, None), phase, keep_going)
        for name, answer in answers.items():
            if answer.value is not None:
                self.possible[name] = {answer.value}
        return answers

    def tell(self, values: Mapping[str, float], phase: str, keep_going: bool = False) -> Steps[dict[str, Answer]]:
        """Write each. With `keep_going` neither a failure, nor Ctrl-C, nor an armed vehicle ends it."""
        return (yield from self._exchange(values, phase, keep_going))

    def _exchange(self, orders: Mapping[str, float | None], phase: str, keep_going: bool) -> Steps[dict[str, Answer]]:
        assert self.vehicle is not None
        answers: dict[str, Answer] = {}
        waiting, under_way = list(orders)[::-1], dict[str, _Request]()
        begin, writes = self.now, None not in orders.values()
        while waiting or under_way:
            obstacle = self._obstacle(begin, keep_going, writes)
            if obstacle:
                return answers | {name: Answer(None, obstacle) for name in [*under_way, *reversed(waiting)]}
            for name in [name for name, r in under_way.items() if r.tries == self.tries and r.due <= self.now]:
                answers[name] = self._give_up(under_way.pop(name))
            if not keep_going and any(answer.problem for answer in answers.values()):
                return answers
            while waiting and len(under_way) < WINDOW:
                name = waiting.pop()
                under_way[name] = _Request(began=self.now, due=self.now)
            hold = writes and not keep_going and self.now - self._heartbeat_at >= FRESH_S
            send: list[Outgoing] = []
            for name, request in under_way.items():
                if request.due <= self.now and not hold:
                    send.append(self._order(name, orders[name]))
                    request.tries, request.due = request.tries + 1, self.now + TRY_S
            wake = self.now + TRY_S if hold else min((r.due for r in under_way.values()), default=self.now)
            for message in (yield from self.turn(send, wake)):
                if isinstance(message, Ack) or message.name not in under_way:
                    continue
                answer = self._judge(message, under_way[message.name], orders[message.name])
                if answer is not None:
                    answers[message.name] = answer
                    del under_way[message.name]
                    self.progress(phase, len(answers), len(orders))
        return answers

    def _obstacle(self, begin: float, keep_going: bool, writes: bool) -> str:
        """Why nothing more may be sent; empty when all is well."""
        assert self.vehicle is not None
        if self.closed:
            return "the link was lost"
        if self.now - max(self._heard_at, begin) >= self.patience:
            return f"nothing was heard from the vehicle for {self.patience:g} s"
        if keep_going:
            return ""
        if self.interrupted:
            return "interrupted"
        if writes and self.vehicle.armed and not self.force_armed:
            return "the vehicle is armed"
        wait = max(self.patience, FRESH_S)
        if writes and self.now - max(self._heartbeat_at, begin) >= wait:
            return f"no HEARTBEAT in {wait:g} s"
        return ""

    def _give_up(self, request: _Request) -> Answer:
        """Answer to a request whose tries are used up: what the vehicle held on to, or silence."""
        if request.kept is not None:
            return Answer(request.kept, f"stays {shortest(request.kept)}")
        return Answer(None, f"no answer in {self.patience:g} s (a vehicle may be silent on what it lacks)")

    def _order(self, name: str, value: float | None) -> Outgoing:
        assert self.vehicle is not None
        address = self.vehicle.system, self.vehicle.component
        if value is None:
            return Read(*address, name)
        self.written.add(name)
        self.possible.setdefault(name, set()).add(value)
        return Write(*address, name, value, self._kinds.get(name, REAL32))

    def _judge(self, message: Value | Refusal, request: _Request, wanted: float | None) -> Answer | None:
        """What a message says about a request; None: nothing final."""
        if isinstance(message, Refusal):
            return Answer(None, f"refused: {REASONS.get(message.reason, f'PARAM_ERROR {message.reason}')}")
        if message.kind != REAL32 and not (message.kind == INT32 and message.name in self.integers):
            return Answer(None, f"is no float on the vehicle (param_type {message.kind})")
        self._kinds[message.name] = message.kind
        if wanted is not None and message.value != wanted:
            # The echo of a refused or altered write, or an old answer that comes late, or another station's.
            request.contradicted.add(request.tries)
            request.kept = message.value
            self.possible[message.name].add(message.value)
            if len(request.contradicted) == CONTRADICTIONS:
                request.due, request.tries = self.now, self.tries
            return None
        took = self.now - request.began
        self._longest = max(self._longest, took)
        if request.tries == 1:
            self._round_trip = max(self._round_trip, took)
        if wanted is not None:
            self.possible[message.name] = {wanted}
        return Answer(message.value)

    def settle(self) -> Steps[None]:
        """Wait until what is under way has arrived: a late echo must not pass for what is held afterwards."""
        quiet = max(QUIET_S, 2 * (self._round_trip or self._longest))
        until, deadline = self.now + quiet, self.now + self.patience
        while self.now < min(until, deadline) and not self.closed:
            heard = yield from self.turn([], until)
            if any(not isinstance(m, Ack) and m.name in self.possible for m in heard):
                until = self.now + quiet

    def store(self) -> Steps[str]:
        """Have the vehicle save its parameters.

        Returns
        -------
        str
            ``acknowledged``; ``autosave``: not, but the time passed in which vehicles save by themselves; ``failed``;
            empty when the link closed.
        """
        assert self.vehicle is not None
        due, deadline, result = self.now, self.now + AUTOSAVE_S, IN_PROGRESS
        while self.now < deadline and not self.closed:
            send: list[Outgoing] = []
            if self.now >= due and result == IN_PROGRESS:
                send = [Store(self.vehicle.system, self.vehicle.component)]
                due = self.now + TRY_S
            wake = min(due, deadline) if result == IN_PROGRESS else deadline
            for message in (yield from self.turn(send, wake)):
                if isinstance(message, Ack) and message.command == STORAGE_COMMAND:
                    result = message.result
            if result == ACCEPTED:
                return "acknowledged"
        if self.closed:
            return ""
        return "failed" if result == FAILED else "autosave"
