"""The plant as a process of its own: serves one autopilot after another over TCP, in lockstep.

Each period the plant sends its messages, waits for HIL_ACTUATOR_CONTROLS, and only then steps. Until an autopilot
has answered for the first time the vehicle is held at its start. The first frame is repeated, because an autopilot
may miss it; one that says something else first (PX4 sends HEARTBEAT, boots for seconds, and needs the clock to run
for that) gets new frames in real time. So does one that is disarmed and does not answer: without a rate controller PX4
has nothing to say, and waits for the clock.
"""

from __future__ import annotations

import os
import select
import socket
import sys
import time
from collections.abc import Callable
from typing import Any

from mimopilot.sitl.autopilot.autopilot import MAX_ROTORS
from mimopilot.sitl.mavlink.simulator_api.simulated_vehicle import ARMED, FORGET_S, SimulatedVehicle
from mimopilot.sitl.mavlink.wire.fast_codec import ACTUATORS, SPIN_S, Message, receive

FIRST_ANSWER_S = 0.2  # the first frame is repeated at this interval until it is answered
LOOK_S = 0.2  # between looks at everything but the autopilot
FROZEN_S = 1.0  # without an answer
MUTE_S = 10.0  # without the first one
LOCKSTEP = 1  # flag of HIL_ACTUATOR_CONTROLS
NO_CONTROLS = (0.0,) * MAX_ROTORS


class ParentGoneError(Exception):
    """The process that started this one has ended."""


class PlantServer:
    """Serves a vehicle at a listening socket.

    Parameters
    ----------
    vehicle : SimulatedVehicle
        It is put back at its start for each autopilot.
    listener : socket
        Listening.
    speed : float or None
        Times real time; None: as fast as the autopilot answers.
    child : bool
        End when standard input is closed.
    """

    def __init__(self, vehicle: SimulatedVehicle, listener: socket.socket, speed: float | None, child: bool) -> None:
        self.vehicle, self.listener, self.speed = vehicle, listener, speed
        self.watched: list[Any] = [listener, sys.stdin] if child else [listener]
        self.next_look = 0.0
        listener.setblocking(False)

    def serve(self) -> None:
        """Serve for ever, or until the parent ends: then this process ends too."""
        try:
            while True:
                self._serve_one(self._accept())
        except ParentGoneError:
            os._exit(0)  # at once: to take compiled code apart takes longer than all the rest, and nobody listens

    def _accept(self) -> socket.socket:
        while True:
            ready, _, _ = select.select(self.watched, [], [])
            self._end_with_parent(ready)
            if self.listener in ready:
                try:
                    return self.listener.accept()[0]
                except OSError:  # it has gone again
                    continue

    @staticmethod
    def _end_with_parent(ready: list[Any]) -> None:
        if sys.stdin in ready and not os.read(sys.stdin.fileno(), 4096):
            raise ParentGoneError

    def _serve_one(self, connection: socket.socket) -> None:
        vehicle = self.vehicle
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        try:
            with connection:
                LockstepSession(self, connection).fly()
        except OSError:
            flown = vehicle.seconds
            vehicle.restart()
            vehicle.tell(
                f"the autopilot went away at {flown:.2f} s of flight; the vehicle is back at its start and waits for "
                "the next"
            )

    def look_around(self, now: float) -> None:
        """Turn a second autopilot away, and end with the parent.

        Raises
        ------
        ParentGoneError
        """
        if now < self.next_look:
            return
        self.next_look = now + LOOK_S
        ready, _, _ = select.select(self.watched, [], [], 0)
        self._end_with_parent(ready)
        if self.listener in ready:
            try:
                self.listener.accept()[0].close()
            except OSError:
                return
            self.vehicle.tell("a second autopilot was turned away: this vehicle has one already")


class LockstepSession:
    """One autopilot's flight."""

    def __init__(self, server: PlantServer, connection: socket.socket) -> None:
        self.server, self.vehicle, self.connection = server, server.vehicle, connection
        self.spin = SPIN_S if server.speed is None else 0.0
        self.begin = time.monotonic()
        self.told: set[str] = set()
        connection.setblocking(False)

    def fly(self) -> None:
        """Fly until the autopilot goes away.

        Raises
        ------
        OSError
            When it does.
        """
        vehicle, speed = self.vehicle, self.server.speed
        answer = self._first_answer()
        begin, count = time.monotonic(), 0
        while True:
            vehicle.fly(answer[2:18], answer[18])
            count += 1
            if speed is not None:
                now = time.monotonic()
                ahead = begin + count * vehicle.Ts / speed - now
                if ahead > 0:
                    time.sleep(ahead)
                elif ahead < -FORGET_S:
                    begin, count = now, 0
            messages = vehicle.messages()
            if vehicle.copies:
                self.connection.sendall(messages * vehicle.copies)
                answer = self._answer(armed=bool(answer[18] & ARMED))
            else:
                self._receive(0.0)  # nobody answers what is lost, but the autopilot or the parent may go

    def _first_answer(self) -> tuple[Any, ...]:
        """Offer the start until it is answered."""
        frame, booting, due = self.vehicle.messages(), False, 0.0
        while not booting:
            if time.monotonic() >= due:
                self._send(frame)
                due = time.monotonic() + FIRST_ANSWER_S
            for kind, fields in self._receive(due):
                if kind is not ACTUATORS:
                    booting = True
                elif self._in_time(fields):
                    return fields
            self._ask()
        return self._run_on(self.vehicle.stand)

    def _answer(self, armed: bool) -> tuple[Any, ...]:
        """Wait for the commands of this period."""
        since = time.monotonic()
        if (fields := self._wait(since + FROZEN_S)) is not None:
            return fields
        what = "time stands still until it does" if armed else "it is disarmed: time runs on, the motors stand"
        when = f"at {self.vehicle.seconds:.2f} s of flight"
        self.vehicle.tell(f"the autopilot has not answered for {FROZEN_S:g} s, {when}; {what}")
        if armed:
            while (fields := self._wait(time.monotonic() + LOOK_S)) is None:
                pass
        else:
            fields = self._run_on(lambda: self.vehicle.fly(NO_CONTROLS, 0))
        self.vehicle.tell(f"the autopilot answers again, after {time.monotonic() - since:.1f} s")
        return fields

    def _run_on(self, pass_period: Callable[[], None]) -> tuple[Any, ...]:
        """Let time run at its pace until a frame is answered before the next: PX4 waits for the clock, not for us."""
        pace = self.vehicle.Ts / (self.server.speed or 1.0)
        due = time.monotonic()
        while True:
            due = max(due, time.monotonic() - FORGET_S) + pace
            if (fields := self._wait(due)) is not None:
                return fields
            self._ask()
            pass_period()
            self._send(self.vehicle.messages())

    def _wait(self, until: float) -> tuple[Any, ...] | None:
        """The answer to the last frame, as soon as it comes; None when the time is over. Older ones are passed over."""
        while True:
            for kind, fields in self._receive(until):
                if kind is ACTUATORS and self._in_time(fields):
                    return fields
            if time.monotonic() >= until:
                return None

    def _in_time(self, fields: tuple[Any, ...]) -> bool:
        if not fields[1] & LOCKSTEP:
            self._tell_once("motor commands came without the lockstep flag: the autopilot must keep lockstep")
            return False
        stamp: int = fields[0]
        return stamp >= self.vehicle.stamp

    def _send(self, data: bytes) -> None:
        """Send to an autopilot that may not read for as long as it boots."""
        if select.select([], [self.connection], [], 0)[1]:
            self.connection.sendall(data)

    def _ask(self) -> None:
        if self.vehicle.flown == 0 and time.monotonic() > self.begin + MUTE_S:
            self._tell_once(f"no HIL_ACTUATOR_CONTROLS in {MUTE_S:g} s: is that an autopilot in simulation?")

    def _receive(self, until: float) -> list[Message]:
        """What came, as soon as something comes; nothing when the time is over."""
        while True:
            now = time.monotonic()
            self.server.look_around(now)
            data = receive(self.connection, self.spin if now < until else 0.0)
            if data is None:
                if now >= until:
                    return []
                select.select([self.connection], [], [], min(until - now, LOOK_S))
                continue
            if not data:
                raise ConnectionResetError
            messages = self.vehicle.codec.parse(data)
            if self.vehicle.codec.skipped:
                self._tell_once("bytes that are no MAVLink came from the autopilot and are passed over")
            return messages

    def _tell_once(self, text: str) -> None:
        if text not in self.told:
            self.told.add(text)
            self.vehicle.tell(text)
