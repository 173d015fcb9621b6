"""The plant as a child of the autopilot host: started, watched, started again, and never left behind."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

from mimopilot.sitl.errors import SitlError
from mimopilot.sitl.faults.kinds import Fault

START_SECONDS = 120.0  # the first time everything is compiled


class PlantProcess:
    """`mimopilot plant` as a child; it ends when its standard input closes, so also when this process is killed.

    Parameters
    ----------
    airframe : str
        Name or path.
    port : int
        TCP port to listen on; 0: any free one.
    Ts : float, s
        Period of its frames.
    seed : int
        Of its noise.
    speed : float or None
        Times real time; None: as fast as it is answered.
    altitude : float, m
        Where it starts, hovering; 0: on the ground, rotors standing.
    faults : sequence of Fault
        Of the plant and of its link, see `sitl.mavlink.simulator_api.simulated_vehicle.SimulatedVehicle`.
    """

    def __init__(
        self,
        airframe: str,
        port: int,
        Ts: float,
        seed: int,
        speed: float | None,
        altitude: float = 0.0,
        faults: Sequence[Fault] = (),
    ) -> None:
        self.command = [sys.executable, "-m", "mimopilot", "plant", airframe, "--port", str(port), "--seed", str(seed)]
        self.command += ["--rate", repr(1 / Ts), "--speed", "max" if speed is None else repr(speed)]
        self.command += ["--altitude", repr(altitude), "--child"]
        self.command += [word for fault in faults for word in ("--fault", str(fault))]
        self.child: subprocess.Popen[bytes] | None = None
        self._forget()

    def _forget(self) -> None:
        self._rest = b""
        self._said: list[str] = []
        self._port: int | None = None

    def start(self) -> None:
        """Start it; whatever ran before is ended."""
        self.end()
        self._forget()
        self.child = subprocess.Popen(
            self.command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.STDOUT
        )
        assert self.child.stdout is not None
        os.set_blocking(self.child.stdout.fileno(), False)

    @property
    def alive(self) -> bool:
        """Whether it runs."""
        return self.child is not None and self.child.poll() is None

    def _listen(self) -> None:
        """Take what it has said since."""
        assert self.child is not None and self.child.stdout is not None
        *lines, self._rest = (self._rest + (self.child.stdout.read() or b"")).split(b"\n")
        for line in lines:
            text = line.decode(errors="replace").removeprefix("mimopilot: ")
            if "listens on" in text:
                self._port = int(text.rsplit(":", 1)[1])
            else:
                self._said.append(text)

    def port(self) -> int | None:
        """The TCP port on which it listens; None while it starts.

        Raises
        ------
        SitlError
            When it has ended without listening, with its own last words.
        """
        assert self.child is not None
        alive = self.alive
        self._listen()
        if self._port is None and not alive:
            words = self._said[-1] if self._said else "the plant process ended without a word"
            raise SitlError(words, self.child.returncode or 1)
        return self._port

    def news(self) -> list[str]:
        """What it has said since the last call, line by line."""
        if self.child is not None:
            self._listen()
        said, self._said = self._said, []
        return said

    def wait(self) -> int:
        """The port, as soon as it listens; raises as `port`."""
        deadline = time.monotonic() + START_SECONDS
        while (listening := self.port()) is None:
            if time.monotonic() > deadline:
                raise SitlError(f"the plant process did not start within {START_SECONDS:g} s", exit_code=1)
            time.sleep(0.02)
        return listening

    def end(self) -> None:
        """End it."""
        if self.child is None:
            return
        self.child.terminate()
        try:
            self.child.wait(timeout=2)
        except subprocess.TimeoutExpired:
            self.child.kill()
            self.child.wait()
        for pipe in (self.child.stdin, self.child.stdout):
            assert pipe is not None
            pipe.close()
        self.child = None


@contextmanager
def plant_process(
    airframe: str,
    port: int,
    Ts: float,
    seed: int,
    speed: float | None,
    altitude: float = 10.0,
    faults: Sequence[Fault] = (),
) -> Iterator[int]:
    """Run a plant for as long as a block lasts; yields the port that it listens on. Arguments as `PlantProcess`.

    Raises
    ------
    SitlError
        When it does not come up, with its own message.
    """
    process = PlantProcess(airframe, port, Ts, seed, speed, altitude, faults)
    process.start()
    try:
        yield process.wait()
    finally:
        process.end()
