"""The autopilot host: runs the compiled controller against a plant on the other end of a TCP connection."""

from __future__ import annotations

import select
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sitl.autopilot import RECORD, Autopilot, tick
from sitl.errors import SitlError
from sitl.mavlink.ground import Ground
from sitl.mavlink.lean import ACTUATORS, STATE, LeanCodec, Message
from sitl.mavlink.link import COMPONENT, LOOPBACK, SYSTEM
from sitl.scenario import Scenario
from sitl.sensors import SIZE

ARMED = 128
LOCKSTEP = 1


@contextmanager
def plant_process(airframe: str, port: int, Ts: float, seed: int, speed: float | None) -> Iterator[int]:
    """Run `mimopilot plant` as a child; yields the port that it listens on, and ends it on leaving.

    Raises
    ------
    SitlError
        When it does not come up, with its own message.
    """
    command = [sys.executable, "-m", "mimopilot", "plant", airframe, "--port", str(port), "--seed", str(seed)]
    command += ["--rate", repr(1 / Ts), "--speed", "max" if speed is None else repr(speed)]
    command += ["--altitude", "10"]
    child = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert child.stdout is not None and child.stderr is not None
    try:
        line = child.stdout.readline()
        if not line:
            raise SitlError(
                child.stderr.read().strip().removeprefix("mimopilot: ") or "the plant process did not start"
            )
        yield int(line.rsplit(":", 1)[1])
    finally:
        child.terminate()
        try:
            child.wait(timeout=5)
        except subprocess.TimeoutExpired:
            child.kill()
            child.wait()
        child.stdout.close()
        child.stderr.close()


class Host:
    """One autopilot on one plant connection.

    Parameters
    ----------
    autopilot : Autopilot
        The controller and what surrounds it.
    rotors : int
        Number of motors.
    port : int
        TCP port of the plant on this machine.
    """

    def __init__(self, autopilot: Autopilot, rotors: int, port: int) -> None:
        self.autopilot, self.rotors = autopilot, rotors
        self.codec = LeanCodec(SYSTEM, COMPONENT)
        self.measurement = np.zeros(SIZE)
        self.stamp = -1
        self.row: NDArray[Any] = np.zeros(1, RECORD)
        try:
            self.plant = socket.create_connection((LOOPBACK, port), timeout=10.0)
        except OSError as error:
            raise SitlError(f"no plant on TCP port {port}: {error}", exit_code=1) from error
        self.plant.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    def close(self) -> None:
        """Leave the plant."""
        self.plant.close()

    def _frames(self) -> Iterator[Message]:
        """Messages of the plant; ends when it goes away."""
        while True:
            data = self.plant.recv(65536)
            if not data:
                return
            yield from self.codec.parse(data)

    def _take(self, message: Message) -> bool:
        """Note a message of the plant; True when a new period is due. A repeated time is answered, not flown."""
        kind, fields = message
        if kind is not STATE:
            return False
        if fields[0] <= self.stamp:
            self._answer(self.row[0])
            return False
        self.stamp = fields[0]
        self.measurement[:7] = fields[1:8]
        self.measurement[7] = fields[10]
        self.measurement[8] = -fields[13]
        return True

    def _fly_period(self, row: Any) -> None:
        tick(*self.autopilot.arguments(), self.measurement, row)
        self.row[0] = row
        self._answer(row)

    def _answer(self, row: Any) -> None:
        controls = row["commands"].tolist()
        self.plant.sendall(self.codec.pack(ACTUATORS, self.stamp, LOCKSTEP, *controls, ARMED))

    def fly(self, scenario: Scenario) -> NDArray[Any]:
        """Fly a scenario from the first frame on.

        Returns
        -------
        (N,) array of `sitl.autopilot.RECORD`

        Raises
        ------
        SitlError
            When the plant goes away before the end.
        """
        record = np.zeros(len(scenario.setpoint), RECORD)
        record["setpoint"], record["excitation"] = scenario.setpoint, scenario.excitation
        count = 0
        for message in self._frames():
            if self._take(message):
                self._fly_period(record[count])
                count += 1
                if count == len(record):
                    return record
        raise SitlError(f"the plant went away after {count} of {len(record)} periods", exit_code=1)

    def run(self, ground: Ground) -> None:
        """Fly level and serve a ground station, until the plant goes away.

        Raises
        ------
        SitlError
            When it does.
        """
        row = np.zeros(1, RECORD)
        self.plant.setblocking(False)
        while True:
            ready, _, _ = select.select([self.plant, ground.socket], [], [], 0.2)
            if ground.socket in ready:
                ground.receive()
            if self.plant in ready:
                data = self.plant.recv(65536)
                if not data:
                    raise SitlError("the plant process went away", exit_code=1)
                for message in self.codec.parse(data):
                    if self._take(message):
                        row[0]["setpoint"] = ground.setpoint
                        self._fly_period(row[0])
            ground.telemeter(time.monotonic(), self.stamp, self.row[0])
