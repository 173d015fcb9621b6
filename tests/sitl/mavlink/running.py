"""The vehicle as its users run it: processes, ports, and clients that speak to it."""

from __future__ import annotations

import socket
import subprocess
import sys
import threading
import time
from contextlib import contextmanager

from mimopilot.sitl.mavlink.wire.px4_modes import custom_mode
from pymavlink import mavutil
from pymavlink.dialects.v20 import common as mavlink

#: An event that comes at all is waited for so long, s: however busy the machine is, no test is decided by its speed.
PATIENCE_S = 180.0
#: Waits of an upload, shortened where a test does not measure them, s: (module, name) -> seconds.
WAITS = {
    ("mimopilot.sitl.mavlink.ground_station.vehicle_contact", "LISTEN_S"): 0.15,
    ("mimopilot.sitl.mavlink.ground_station.parameter_protocol", "AUTOSAVE_S"): 0.15,
}
_PATCHES = "".join(f"import {module}; {module}.{name} = {value}; " for (module, name), value in WAITS.items())
#: The command line with them.
QUICK = (sys.executable, "-c", f"{_PATCHES}import mimopilot.cli.main; mimopilot.cli.main.main()")


def free_port(kind=socket.SOCK_STREAM):
    with socket.socket(socket.AF_INET, kind) as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def wait_for(condition, complaint=lambda: "it did not happen"):
    """Wait until something is so that another thread or process does."""
    deadline = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < deadline, complaint()
        time.sleep(0.01)


class Program:
    """A process whose output is read as it comes."""

    def __init__(self, *command, **keywords):
        self.process = subprocess.Popen(
            [str(word) for word in command],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            **keywords,
        )
        self.output = ""
        self.reader = threading.Thread(target=self._read)
        self.reader.start()

    def _read(self):
        while text := self.process.stdout.read(1):
            self.output += text

    def until(self, text):
        """Wait until it has said something."""
        wait_for(lambda: text in self.output, lambda: f"no {text!r} in:\n{self.output}")

    def say(self, line):
        self.output = ""
        self.process.stdin.write(line + "\n")
        self.process.stdin.flush()

    def end(self):
        if self.process.poll() is None:
            self.process.terminate()
        try:
            self.process.wait(timeout=PATIENCE_S)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()
        self.reader.join(timeout=PATIENCE_S)
        self.process.stdin.close()
        self.process.stdout.close()


def start(*arguments, **keywords):
    """A command of ours."""
    return Program(sys.executable, "-u", "-m", "mimopilot", *arguments, **keywords)


@contextmanager
def running_sitl(*extra, **keywords):
    """`mimopilot sitl adam0` on ports of its own; yields the program, with its `ports`."""
    udp, local, tcp = free_port(socket.SOCK_DGRAM), free_port(socket.SOCK_DGRAM), free_port()
    ports = ("--ground-port", udp, "--vehicle-port", local, "--tcp-port", tcp)
    program = start("sitl", "adam0", *ports, *extra, **keywords)
    program.udp, program.local, program.tcp = udp, local, tcp
    try:
        program.until("Ctrl-C ends")
        yield program
    finally:
        program.end()


class Pilot:
    """A ground station made of pymavlink alone."""

    def __init__(self, address):
        self.link = mavutil.mavlink_connection(address, dialect="common", source_system=255)
        self.texts = []
        self.said = self.beat = self.last = None
        self.beats = 0
        self.wait(lambda: self.beat is not None)

    def close(self):
        self.link.close()

    def take(self, timeout=0.05):
        """One message, if there is one; 0: if it is there already."""
        message = self.last = self.link.recv_match(blocking=timeout > 0, timeout=timeout or None)
        if message is not None and message.get_type() == "STATUSTEXT":
            if message.chunk_seq and self.texts:  # the rest of a long one
                self.texts[-1] += message.text
            else:
                self.texts.append(message.text)
        if message is not None and message.get_type() == "HEARTBEAT":
            self.beat = message
            self.beats += 1
        return message

    def wait(self, condition):
        """Listen until something is so."""
        deadline = time.monotonic() + PATIENCE_S
        while not condition():
            assert time.monotonic() < deadline, self.texts
            self.take()

    def hears(self, text):
        """Wait for a text; how many HEARTBEATs, which are sent once a second and with a text, came with it."""
        before = self.beats
        self.wait(lambda: any(text in said for said in self.texts))
        return self.beats - before

    def asks(self, kind):
        """The next message of a kind."""
        deadline = time.monotonic() + PATIENCE_S
        while time.monotonic() < deadline:
            message = self.take()
            if message is not None and message.get_type() == kind:
                return message
        raise AssertionError(f"no {kind}")

    def command(self, number, *params):
        """COMMAND_LONG; the result in its acknowledgement."""
        while self.take(0) is not None:  # a buffer that is full has no room for an answer
            pass
        self.link.mav.command_long_send(1, 1, number, 0, *params, *[0] * (7 - len(params)))
        while True:
            ack = self.asks("COMMAND_ACK")
            if ack.command == number:
                return ack.result

    def ready(self):
        """Wait until the vehicle can be armed."""
        self.wait(
            lambda: (
                self.last is not None
                and self.last.get_type() == "SYS_STATUS"
                and self.last.onboard_control_sensors_health & mavlink.MAV_SYS_STATUS_PREARM_CHECK
            )
        )

    def flies(self, mode):
        """Wait until the vehicle shows a mode."""
        self.wait(lambda: self.beat.custom_mode == custom_mode(mode))

    def armed(self):
        return bool(self.beat.base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED)
