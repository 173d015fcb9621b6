"""Server of the plant process: serves one autopilot after another over TCP, in lockstep.

Each period the plant sends its messages, waits for HIL_ACTUATOR_CONTROLS, and only then steps. The vehicle is held at
its start until the first answer. The first frame is repeated, because an autopilot may miss it.

An autopilot that first sends other messages gets new frames in real time: PX4 sends HEARTBEAT, and needs a running
clock to boot. So does one that is disarmed and does not answer: PX4 without a rate controller sends no commands.
"""

from __future__ import annotations

import os
import select
import socket
import sys
import time
from collections.abc import Callable
from typing import Any

from mimopilot.sitl.mavlink.simulator_api.simulated_vehicle import MAX_CATCH_UP_S, SimulatedVehicle
from mimopilot.sitl.mavlink.wire.fast_codec import ACTUATORS, ARMED, LOCKSTEP, SPIN_S, Message, receive
from mimopilot.sitl.physics.rigid_body import MAX_ROTORS

# All chosen:
REPEAT_S = 0.2  # s between repetitions of the first frame until it is answered
POLL_S = 0.2  # s between polls of everything but the autopilot
ANSWER_TIMEOUT_S = 1.0  # s without an answer before it is reported
FIRST_ANSWER_TIMEOUT_S = 10.0  # s without the first answer before it is reported; PX4 boots within seconds
NO_CONTROLS = (0.0,) * MAX_ROTORS


class ParentGoneError(Exception):
    """The process that started this one has ended."""


def end_with_parent(ready: list[Any]) -> None:
    """Look for the end of standard input among what is ready to be read.

    Raises
    ------
    ParentGoneError
    """
    if sys.stdin in ready and not os.read(sys.stdin.fileno(), 4096):
        raise ParentGoneError


class Pace:
    """Keeps simulated time from running faster than asked for.

    Parameters
    ----------
    speed : float or None
        Times real time; None: as fast as possible.
    """

    def __init__(self, speed: float | None) -> None:
        self.speed, self.begin, self.passed = speed, time.monotonic(), 0.0

    def wait(self, seconds: float) -> None:
        """Let this much simulated time pass, s; a long delay is not caught up."""
        if self.speed is None:
            return
        self.passed += seconds / self.speed
        now = time.monotonic()
        ahead = self.begin + self.passed - now
        if ahead > 0:
            time.sleep(ahead)
        elif ahead < -MAX_CATCH_UP_S:
            self.begin, self.passed = now, 0.0


class PlantServer:
    """Serves a simulated vehicle at a listening socket.

    Parameters
    ----------
    vehicle : SimulatedVehicle
        Reset to its start for each autopilot.
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
        self.next_poll = 0.0
        listener.setblocking(False)

    def serve(self) -> None:
        """Serve for ever; as a child, end this process when the parent ends."""
        try:
            while True:
                self._serve_one(self._accept())
        except ParentGoneError:
            os._exit(0)  # at once: tearing down compiled code takes longer than all the rest

    def _accept(self) -> socket.socket:
        while True:
            ready, _, _ = select.select(self.watched, [], [])
            end_with_parent(ready)
            if self.listener in ready:
                try:
                    return self.listener.accept()[0]
                except OSError:  # it has disconnected already
                    continue

    def _serve_one(self, connection: socket.socket) -> None:
        vehicle = self.vehicle
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        try:
            with connection:
                LockstepSession(self, connection).fly()
        except OSError:
            flown = vehicle.seconds
            vehicle.restart()
            vehicle.report(
                f"the autopilot disconnected at {flown:.2f} s of flight; the vehicle is reset to its start and waits "
                "for the next"
            )

    def poll(self, now: float) -> None:
        """Refuse a second autopilot, and check the parent, every `POLL_S`; `now` is a monotonic time in s.

        Raises
        ------
        ParentGoneError
        """
        if now < self.next_poll:
            return
        self.next_poll = now + POLL_S
        ready, _, _ = select.select(self.watched, [], [], 0)
        end_with_parent(ready)
        if self.listener in ready:
            try:
                self.listener.accept()[0].close()
            except OSError:
                return
            self.vehicle.report("a second autopilot was refused: this vehicle has one already")


class LockstepSession:
    """One autopilot's flight, from its connection to its end."""

    def __init__(self, server: PlantServer, connection: socket.socket) -> None:
        self.server, self.vehicle, self.connection = server, server.vehicle, connection
        self.spin = SPIN_S if server.speed is None else 0.0
        self.begin = time.monotonic()
        self.reported: set[str] = set()
        connection.setblocking(False)

    def fly(self) -> None:
        """Fly until the autopilot disconnects.

        Raises
        ------
        OSError
            When it does.
        """
        vehicle = self.vehicle
        answer = self._first_answer()
        pace = Pace(self.server.speed)
        while True:
            vehicle.fly(answer[2:18], answer[18])
            pace.wait(vehicle.Ts)
            messages = vehicle.pack_messages()
            if vehicle.copies:
                self.connection.sendall(messages * vehicle.copies)
                answer = self._wait_for_commands(armed=bool(answer[18] & ARMED))
            else:
                self._receive(0.0)  # a lost frame gets no answer, but the autopilot or the parent may disconnect

    def _first_answer(self) -> tuple[Any, ...]:
        """Send the first frame until it is answered."""
        frame, booting, due = self.vehicle.pack_messages(), False, 0.0
        while not booting:
            if time.monotonic() >= due:
                self._send(frame)
                due = time.monotonic() + REPEAT_S
            for kind, fields in self._receive(due):
                if kind is not ACTUATORS:
                    booting = True
                elif self._check_answer(fields):
                    return fields
            self._check_first_answer_time()
        return self._run_clock(self.vehicle.hold)

    def _wait_for_commands(self, armed: bool) -> tuple[Any, ...]:
        """Wait for the commands of this period, and report an autopilot that does not answer."""
        since = time.monotonic()
        if (fields := self._wait(since + ANSWER_TIMEOUT_S)) is not None:
            return fields
        what = "simulated time stops until it does" if armed else "it is disarmed: time runs on, the motors stop"
        when = f"at {self.vehicle.seconds:.2f} s of flight"
        self.vehicle.report(f"the autopilot has not answered for {ANSWER_TIMEOUT_S:g} s, {when}; {what}")
        if armed:
            while (fields := self._wait(time.monotonic() + POLL_S)) is None:
                pass
        else:
            fields = self._run_clock(lambda: self.vehicle.fly(NO_CONTROLS, 0))
        self.vehicle.report(f"the autopilot answers again, after {time.monotonic() - since:.1f} s")
        return fields

    def _run_clock(self, pass_period: Callable[[], None]) -> tuple[Any, ...]:
        """Run the clock at its pace until a frame is answered before the next: PX4 waits for the clock, not for us."""
        pace = self.vehicle.Ts / (self.server.speed or 1.0)
        due = time.monotonic()
        while True:
            due = max(due, time.monotonic() - MAX_CATCH_UP_S) + pace
            if (fields := self._wait(due)) is not None:
                return fields
            self._check_first_answer_time()
            pass_period()
            self._send(self.vehicle.pack_messages())

    def _wait(self, until: float) -> tuple[Any, ...] | None:
        """Wait for the answer to the last frame; None on timeout. Answers to older frames are ignored."""
        while True:
            for kind, fields in self._receive(until):
                if kind is ACTUATORS and self._check_answer(fields):
                    return fields
            if time.monotonic() >= until:
                return None

    def _check_answer(self, fields: tuple[Any, ...]) -> bool:
        """Whether an answer is for the current frame; one without the lockstep flag is reported."""
        if not fields[1] & LOCKSTEP:
            self._report_once("motor commands came without the lockstep flag: configure the autopilot for lockstep")
            return False
        stamp: int = fields[0]
        return stamp >= self.vehicle.stamp

    def _send(self, data: bytes) -> None:
        """Send, unless the autopilot does not read, as while it boots."""
        if select.select([], [self.connection], [], 0)[1]:
            self.connection.sendall(data)

    def _check_first_answer_time(self) -> None:
        if self.vehicle.flown == 0 and time.monotonic() > self.begin + FIRST_ANSWER_TIMEOUT_S:
            self._report_once(
                f"no HIL_ACTUATOR_CONTROLS in {FIRST_ANSWER_TIMEOUT_S:g} s: is the peer an autopilot in simulation?"
            )

    def _receive(self, until: float) -> list[Message]:
        """Wait for messages; none on timeout."""
        while True:
            now = time.monotonic()
            self.server.poll(now)
            data = receive(self.connection, self.spin if now < until else 0.0)
            if data is None:
                if now >= until:
                    return []
                select.select([self.connection], [], [], min(until - now, POLL_S))
                continue
            if not data:
                raise ConnectionResetError
            messages = self.vehicle.codec.parse(data)
            if self.vehicle.codec.skipped:
                self._report_once("the autopilot sent bytes that are not MAVLink; they are ignored")
            return messages

    def _report_once(self, text: str) -> None:
        if text not in self.reported:
            self.reported.add(text)
            self.vehicle.report(text)
