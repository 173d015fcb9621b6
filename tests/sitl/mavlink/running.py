"""The vehicle as users run it: processes, ports, and a ground station client."""

from __future__ import annotations

import socket
import subprocess
import sys
import threading
import time
from contextlib import contextmanager

from pymavlink import mavutil
from pymavlink.dialects.v20 import common as mavlink

from mimopilot.sitl.mavlink.wire.px4_modes import custom_mode

#: Timeout for any expected event, s: so long that a busy machine does not fail a test.
PATIENCE_S = 180.0
#: Waits of an upload, s, shortened where a test does not measure them: (module, name) -> seconds.
WAITS = {
    ("mimopilot.sitl.mavlink.ground_station.vehicle_link_state", "LISTEN_S"): 0.15,
    ("mimopilot.sitl.mavlink.ground_station.parameter_protocol", "AUTOSAVE_S"): 0.15,
}
_PATCHES = "".join(f"import {module}; {module}.{name} = {value}; " for (module, name), value in WAITS.items())
#: The command line with these waits.
QUICK = (sys.executable, "-c", f"{_PATCHES}from mimopilot.cli.main import main; main()")


def free_port(kind=socket.SOCK_STREAM):
    with socket.socket(socket.AF_INET, kind) as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def wait_for(condition, complaint=lambda: "it did not happen"):
    """Wait until another thread or process has made a condition true."""
    deadline = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < deadline, complaint()
        time.sleep(0.01)


class Program:
    """A process whose output is read as it is written."""

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
        """Wait until its output holds a text."""
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
    """Start a mimopilot command."""
    return Program(sys.executable, "-u", "-m", "mimopilot", *arguments, **keywords)


@contextmanager
def running_sitl(*extra, **keywords):
    """`mimopilot sitl adam0` on free ports; yields the program, with its ports `udp`, `local` and `tcp`."""
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
    """A ground station, with a pilot's actions, on plain pymavlink."""

    def __init__(self, address):
        self.link = mavutil.mavlink_connection(address, dialect="common", source_system=255)
        self.texts = []
        self.said = self.beat = self.last = None
        self.beats = 0
        self.wait(lambda: self.beat is not None)

    def close(self):
        self.link.close()

    def take(self, timeout=0.05):
        """Receive one message, if one arrives within the timeout, s; 0: only if it has arrived already."""
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
        """Receive messages until a condition is true."""
        deadline = time.monotonic() + PATIENCE_S
        while not condition():
            assert time.monotonic() < deadline, self.texts
            self.take()

    def hears(self, text):
        """Wait for a text; return the number of HEARTBEATs until then. They come once a second and with a text."""
        before = self.beats
        self.wait(lambda: any(text in said for said in self.texts))
        return self.beats - before

    def asks(self, kind):
        """Wait for the next message of a kind."""
        deadline = time.monotonic() + PATIENCE_S
        while time.monotonic() < deadline:
            message = self.take()
            if message is not None and message.get_type() == kind:
                return message
        raise AssertionError(f"no {kind}")

    def command(self, number, *params):
        """Send COMMAND_LONG; return the result in its acknowledgement."""
        while self.take(0) is not None:  # a full buffer would drop the answer
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
        """Wait until the vehicle reports a mode."""
        self.wait(lambda: self.beat.custom_mode == custom_mode(mode))

    def armed(self):
        return bool(self.beat.base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED)
