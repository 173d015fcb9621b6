"""MAVLink's parameter protocol with one vehicle: what to send, and which answer to accept.

No socket and no clock: see `sitl.mavlink.ground_station.events` for how an exchange is run.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

from mimopilot.sitl.mavlink.ground_station.events import (
    ACCEPTED,
    ARDUPILOT,
    CRAZYFLIE,
    DENIED,
    DOES_NOT_EXIST,
    FAILED,
    IN_PROGRESS,
    REASONS,
    STORAGE_COMMAND,
    UNKNOWN_INDEX,
    WHOLE,
    CommandAck,
    Exchange,
    Outgoing,
    ParameterRefusal,
    ParameterValue,
    ReadParameter,
    SetParameter,
    StoreParameters,
)
from mimopilot.sitl.mavlink.ground_station.vehicle_link_state import FRESH_S, TRIES, TRY_S, VehicleLinkState
from mimopilot.sitl.mavlink.wire.float32 import REAL32, shortest

#: Largest number of pending requests; chosen.
WINDOW = 10
#: Tries answered with another value after which the vehicle is taken to keep that value; chosen.
CONTRADICTIONS = 4
#: PX4 saves by itself at most 2.3 s after a change, ArduPilot sooner. A value read later than this (s) was saved.
AUTOSAVE_S = 2.5
#: Shortest silence (s) after which earlier messages count as delivered or lost; chosen.
QUIET_S = 0.1
#: MAV_RESULT of a storage command -> its name in the result of an upload.
STORAGE_RESULTS = {ACCEPTED: "acknowledged", DENIED: "denied", FAILED: "failed"}


class Answer(NamedTuple):
    """Result of one request: the value last reported, and the problem (empty: none).

    `absent`: the vehicle did not answer, or reported that the parameter does not exist. `place`: its param_index.
    """

    value: float | None
    problem: str = ""
    absent: bool = False
    place: int = UNKNOWN_INDEX


@dataclass
class _PendingRequest:
    """A request that is not answered yet; times in s."""

    began: float
    due: float
    tries: int = 0
    contradicted: set[int] = field(default_factory=set)
    kept: float | None = None


class ParameterClient(VehicleLinkState):
    """Reads and writes the parameters of one vehicle.

    Parameters
    ----------
    now, tries, system, force_armed
        See `sitl.mavlink.ground_station.vehicle_link_state.VehicleLinkState`.
    integers : collection of str
        Names that may be whole numbers on the vehicle; all others must be REAL32.
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
        # Time of the last write or storage command.
        self._changed_at = now - AUTOSAVE_S
        # Longest exchange, and longest one answered at the first try: only that is surely a round trip.
        self._longest = self._round_trip = 0.0

    def read(self, names: Sequence[str], phase: str, keep_going: bool = False) -> Exchange[dict[str, Answer]]:
        """Read each by name. Ends at the first failure; with `keep_going` neither a failure nor Ctrl-C ends it."""
        answers = yield from self._exchange(dict.fromkeys(names, None), phase, keep_going)
        for name, answer in answers.items():
            if answer.value is not None:
                self.possible[name] = {answer.value}
        return answers

    def write(self, values: Mapping[str, float], phase: str, keep_going: bool = False) -> Exchange[dict[str, Answer]]:
        """Write each. With `keep_going` neither a failure nor Ctrl-C nor an armed vehicle ends it."""
        return (yield from self._exchange(values, phase, keep_going))

    def _exchange(
        self, values: Mapping[str, float | None], phase: str, keep_going: bool
    ) -> Exchange[dict[str, Answer]]:
        assert self.vehicle is not None
        answers: dict[str, Answer] = {}
        waiting, pending = list(values)[::-1], dict[str, _PendingRequest]()
        begin, writes = self.now, None not in values.values()
        while waiting or pending:
            obstacle = self._obstacle(begin, keep_going, writes)
            if obstacle:
                return answers | {name: Answer(None, obstacle) for name in [*pending, *reversed(waiting)]}
            for name in [name for name, r in pending.items() if r.tries == self.tries and r.due <= self.now]:
                answers[name] = self._give_up(pending.pop(name))
            if not keep_going and any(answer.problem for answer in answers.values()):
                return answers
            while waiting and len(pending) < WINDOW:
                name = waiting.pop()
                pending[name] = _PendingRequest(began=self.now, due=self.now)
            hold = writes and not keep_going and self.now - self._heartbeat_at >= FRESH_S
            send = self.request_heartbeat() if hold else []
            for name, request in pending.items():
                if request.due <= self.now and not hold:
                    send.append(self._start_try(name, values[name]))
                    request.tries, request.due = request.tries + 1, self.now + TRY_S
            wake = self.now + TRY_S if hold else min((r.due for r in pending.values()), default=self.now)
            for message in (yield from self.send_and_wait(send, wake)):
                if isinstance(message, CommandAck) or message.name not in pending:
                    continue
                answer = self._accept(message, pending[message.name], values[message.name])
                if answer is not None:
                    answers[message.name] = answer
                    del pending[message.name]
                    self.progress(phase, len(answers), len(values))
        return answers

    def _obstacle(self, begin: float, keep_going: bool, writes: bool) -> str:
        """Why nothing more may be sent; empty: sending may continue."""
        assert self.vehicle is not None
        if self.closed:
            return "the link was lost"
        if self.now - max(self._heard_at, begin) >= self.timeout:
            return f"no message from the vehicle for {self.timeout:g} s"
        if keep_going:
            return ""
        if self.interrupted:
            return "interrupted"
        if self.failure:
            return self.failure
        if writes and self.vehicle.armed and not self.force_armed:
            return "the vehicle is armed"
        wait = self.timeout + FRESH_S  # so that complete silence is reported first
        if writes and self.now - max(self._heartbeat_at, begin) >= wait:
            return f"no HEARTBEAT in {wait:g} s"
        return ""

    def _give_up(self, request: _PendingRequest) -> Answer:
        """Result of a request whose tries are used up: the value that the vehicle kept, or no answer."""
        if request.kept is not None:
            return Answer(request.kept, f"stays {shortest(request.kept)}")
        return Answer(
            None, f"no answer in {self.timeout:g} s (a vehicle may not answer for a parameter that it lacks)", True
        )

    def _start_try(self, name: str, value: float | None) -> Outgoing:
        assert self.vehicle is not None
        address = self.vehicle.system, self.vehicle.component
        if value is None:
            return ReadParameter(*address, name)
        self.written.add(name)
        self._set_agreed(name, None)
        self._changed_at = self.now
        self.possible.setdefault(name, set()).add(value)
        return SetParameter(*address, name, value, self._kinds.get(name, REAL32))

    def _accept(
        self, message: ParameterValue | ParameterRefusal, request: _PendingRequest, wanted: float | None
    ) -> Answer | None:
        """Result of a request after a message, recorded; None: not final."""
        if isinstance(message, ParameterRefusal):
            reason = REASONS.get(message.reason, f"PARAM_ERROR {message.reason}")
            return Answer(None, f"refused: {reason}", message.reason == DOES_NOT_EXIST)
        if message.kind != REAL32 and not (message.kind in WHOLE and message.name in self.integers):
            return Answer(None, f"is not a float on the vehicle (param_type {message.kind})")
        self._kinds[message.name] = message.kind
        if wanted is not None and message.value != wanted:
            # The echo of a refused or altered write, a late answer, or an answer to another ground station.
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
            self._set_agreed(message.name, message.value)
        return Answer(message.value, place=message.place)

    def wait_until_quiet(self) -> Exchange[None]:
        """Wait until no messages are in transit: a late echo must not be taken for the value held afterwards."""
        quiet = max(QUIET_S, 2 * (self._round_trip or self._longest))
        until, deadline = self.now + quiet, self.now + self.timeout
        while self.now < min(until, deadline) and not self.closed:
            answers = yield from self.send_and_wait([], until)
            if any(not isinstance(m, CommandAck) and m.name in self.possible for m in answers):
                until = self.now + quiet

    def store(self, names: Collection[str] = ()) -> Exchange[str]:
        """Command the vehicle to save its parameters, but for ArduPilot, which saves each when it is set.

        ArduPilot denies the command (GCS_Common.cpp: only its erasing of all parameters is accepted). A Crazyflie saves
        nothing by itself, and one parameter after the other.

        Parameters
        ----------
        names : collection of str
            For a Crazyflie: what to save besides what was written, and before it.

        Returns
        -------
        str
            ``acknowledged``, ``denied`` or ``failed``, as the vehicle answered; ``autosave``: none of these, the
            vehicle must save by itself; empty: the link closed.
        """
        assert self.vehicle is not None
        if self.vehicle.autopilot == ARDUPILOT:
            self._changed_at = self.now
            return "autosave"
        alone = self.vehicle.autopilot != CRAZYFLIE
        due, deadline, result = self.now, self.now + (AUTOSAVE_S if alone else self.timeout), IN_PROGRESS
        while self.now < deadline and not self.closed and result == IN_PROGRESS:
            send: list[Outgoing] = []
            if self.now >= due:
                send = [StoreParameters(self.vehicle.system, self.vehicle.component, tuple(names))]
                self._changed_at, due = self.now, self.now + TRY_S
            for message in (yield from self.send_and_wait(send, min(due, deadline))):
                if isinstance(message, CommandAck) and message.command == STORAGE_COMMAND:
                    result = message.result
        return "" if self.closed else STORAGE_RESULTS.get(result, "autosave" if alone else "failed")

    def wait_for_autosave(self, keep_going: bool = False) -> Exchange[str]:
        """Wait until the vehicle has saved its changes by itself, and for a HEARTBEAT after that.

        Returns
        -------
        str
            Why there was none; empty: there was one.
        """
        begin = due = max(self.now, self._changed_at + AUTOSAVE_S)
        while self._heartbeat_at < due:
            obstacle = self._obstacle(begin, keep_going, writes=True)
            if obstacle or self.now >= begin + self.timeout:
                return obstacle or f"no HEARTBEAT in {self.timeout:g} s"
            send = self.request_heartbeat() if self.now >= due else []
            yield from self.send_and_wait(send, self.now + TRY_S if self.now >= due else due)
        return ""
