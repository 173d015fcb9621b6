"""The plant as a child process of the autopilot host: start, monitor, end."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

from mimopilot.sitl.errors import SitlError
from mimopilot.sitl.faults.kinds import Fault

START_S = 120.0  # s; chosen: the first start compiles everything
END_S = 2.0  # s from terminating the process to killing it; chosen
POLL_S = 0.02  # s between looks for its port while it starts; chosen


class PlantProcess:
    """`mimopilot plant` as a child process.

    It ends when its standard input closes, so also when this process is killed.

    Parameters
    ----------
    airframe : str
        Name or path.
    port : int
        TCP port to listen on; 0: any free one.
    Ts : float, s
        Period of its frames.
    seed : int
        Seed of its noise.
    speed : float or None
        Times real time; None: as fast as it is answered.
    altitude : float, m
        Initial hover altitude; 0: on the ground, rotors stopped.
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
        self._messages: list[str] = []
        self._port: int | None = None

    def start(self) -> None:
        """Start the process; a running one is ended first."""
        self.end()
        self._forget()
        self.child = subprocess.Popen(
            self.command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.STDOUT
        )
        assert self.child.stdout is not None
        os.set_blocking(self.child.stdout.fileno(), False)

    @property
    def alive(self) -> bool:
        """Whether the process runs."""
        return self.child is not None and self.child.poll() is None

    def _read_output(self) -> None:
        """Read the new lines of its output: its port, or messages for the user."""
        assert self.child is not None and self.child.stdout is not None
        *lines, self._rest = (self._rest + (self.child.stdout.read() or b"")).split(b"\n")
        for line in lines:
            text = line.decode(errors="replace").removeprefix("mimopilot: ")
            if "listens on" in text:
                self._port = int(text.rsplit(":", 1)[1])
            else:
                self._messages.append(text)

    def poll_port(self) -> int | None:
        """Read its output, and return the TCP port on which it listens; None while it starts.

        Raises
        ------
        SitlError
            When it ended without listening, with its last message.
        """
        assert self.child is not None
        alive = self.alive
        self._read_output()
        if self._port is None and not alive:
            last = "the plant process ended without a message; run `mimopilot plant` by itself to see why"
            raise SitlError(self._messages[-1] if self._messages else last, self.child.returncode or 1)
        return self._port

    def take_messages(self) -> list[str]:
        """Read its output, and return the messages since the last call, line by line."""
        if self.child is not None:
            self._read_output()
        taken, self._messages = self._messages, []
        return taken

    def wait(self) -> int:
        """Wait until it listens, and return the port; raises as `poll_port`."""
        deadline = time.monotonic() + START_S
        while (listening := self.poll_port()) is None:
            if time.monotonic() > deadline:
                raise SitlError(
                    f"the plant process did not start within {START_S:g} s; run `mimopilot plant` by itself to see why",
                    exit_code=1,
                )
            time.sleep(POLL_S)
        return listening

    def end(self) -> None:
        """End the process."""
        if self.child is None:
            return
        self.child.terminate()
        try:
            self.child.wait(timeout=END_S)
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
    """Run a plant for the duration of a block; yields its port. Parameters as `PlantProcess`.

    Raises
    ------
    SitlError
        When it does not start, with its own message.
    """
    process = PlantProcess(airframe, port, Ts, seed, speed, altitude, faults)
    process.start()
    try:
        yield process.wait()
    finally:
        process.end()
