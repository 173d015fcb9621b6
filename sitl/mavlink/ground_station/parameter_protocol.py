"""The parameter protocol of one ground station with one vehicle: what to send, and when to believe an answer.

No socket and no clock: see `sitl.mavlink.ground_station.events` for how a conversation is driven.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

from mimopilot.sitl.mavlink.ground_station.events import (
    ACCEPTED,
    DENIED,
    DOES_NOT_EXIST,
    FAILED,
    IN_PROGRESS,
    INT32,
    REASONS,
    STORAGE_COMMAND,
    Ack,
    Outgoing,
    Read,
    Refusal,
    Steps,
    Store,
    Value,
    Write,
)
from mimopilot.sitl.mavlink.ground_station.vehicle_contact import FRESH_S, TRIES, TRY_S, Contact
from mimopilot.sitl.mavlink.wire.float32 import REAL32, shortest

#: How many requests may be under way.
WINDOW = 10
#: After so many tries that were answered with another value, the vehicle is believed to keep that.
CONTRADICTIONS = 4
#: PX4 saves by itself at most 2.3 s after a change, ArduPilot sooner; what is read after that has outlasted it.
AUTOSAVE_S = 2.5
#: Least silence (s) after which what was sent before is taken to have arrived or to be lost.
QUIET_S = 0.1
#: What a vehicle may say to being told to store.
ENDS = {ACCEPTED: "acknowledged", DENIED: "denied", FAILED: "failed"}


class Answer(NamedTuple):
    """End of one request: the value that the vehicle stated last, and what is wrong (empty: nothing).

    `absent`: it was silent on this one, or said that it has none such.
    """

    value: float | None
    problem: str = ""
    absent: bool = False


@dataclass
class _Request:
    """One request under way."""

    began: float
    due: float
    tries: int = 0
    contradicted: set[int] = field(default_factory=set)
    kept: float | None = None


class Conversation(Contact):
    """What is read from and written to the vehicle.

    Parameters
    ----------
    now, tries, system, force_armed
        See `sitl.mavlink.ground_station.vehicle_contact.Contact`.
    integers : collection of str
        Names that may be whole numbers on the vehicle; all others must be floats there.
    """

    def __init__(
        self,
        now: float,
        tries: int = TRIES,
        system: int = 0,
        force_armed: bool = False,
        integers: Collection[str] = (),
    ) -> None:
        super().__init__(now, tries, system, force_armed)
        self.integers = integers
        self._kinds: dict[str, int] = {}
        # When the vehicle was last told to change or to store something.
        self._changed_at = now - AUTOSAVE_S
        # Longest exchange, and longest of those answered at the first try: only these are sure to be a round trip.
        self._longest = self._round_trip = 0.0

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
            send = self.request_heartbeat() if hold else []
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
        if self.trouble:
            return self.trouble
        if writes and self.vehicle.armed and not self.force_armed:
            return "the vehicle is armed"
        wait = self.patience + FRESH_S  # a vehicle that says nothing at all is called that first
        if writes and self.now - max(self._heartbeat_at, begin) >= wait:
            return f"no HEARTBEAT in {wait:g} s"
        return ""

    def _give_up(self, request: _Request) -> Answer:
        """Answer to a request whose tries are used up: what the vehicle held on to, or silence."""
        if request.kept is not None:
            return Answer(request.kept, f"stays {shortest(request.kept)}")
        return Answer(None, f"no answer in {self.patience:g} s (a vehicle may be silent on what it lacks)", True)

    def _order(self, name: str, value: float | None) -> Outgoing:
        assert self.vehicle is not None
        address = self.vehicle.system, self.vehicle.component
        if value is None:
            return Read(*address, name)
        self.written.add(name)
        self.agree(name, None)
        self._changed_at = self.now
        self.possible.setdefault(name, set()).add(value)
        return Write(*address, name, value, self._kinds.get(name, REAL32))

    def _judge(self, message: Value | Refusal, request: _Request, wanted: float | None) -> Answer | None:
        """What a message says about a request; None: nothing final."""
        if isinstance(message, Refusal):
            reason = REASONS.get(message.reason, f"PARAM_ERROR {message.reason}")
            return Answer(None, f"refused: {reason}", message.reason == DOES_NOT_EXIST)
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
        else:
            self.agree(message.name, message.value)
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
            ``acknowledged``; ``denied`` or ``failed``: it said so; ``autosave``: none of these, so that it depends on
            what vehicles save by themselves; empty when the link closed.
        """
        assert self.vehicle is not None
        due, deadline, result = self.now, self.now + AUTOSAVE_S, IN_PROGRESS
        while self.now < deadline and not self.closed and result == IN_PROGRESS:
            send: list[Outgoing] = []
            if self.now >= due:
                send = [Store(self.vehicle.system, self.vehicle.component)]
                self._changed_at, due = self.now, self.now + TRY_S
            for message in (yield from self.turn(send, min(due, deadline))):
                if isinstance(message, Ack) and message.command == STORAGE_COMMAND:
                    result = message.result
        return "" if self.closed else ENDS.get(result, "autosave")

    def outlast(self, keep_going: bool = False) -> Steps[str]:
        """Wait until a vehicle has saved what was changed, and for a HEARTBEAT after that.

        Returns
        -------
        str
            Why there was none; empty when there was.
        """
        begin = due = max(self.now, self._changed_at + AUTOSAVE_S)
        while self._heartbeat_at < due:
            obstacle = self._obstacle(begin, keep_going, writes=True)
            if obstacle or self.now >= begin + self.patience:
                return obstacle or f"no HEARTBEAT in {self.patience:g} s"
            send = self.request_heartbeat() if self.now >= due else []
            yield from self.turn(send, self.now + TRY_S if self.now >= due else due)
        return ""
