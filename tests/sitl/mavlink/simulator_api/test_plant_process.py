"""The plant process, and how it treats autopilots that are late, silent, killed or faulty."""

import os
import pty
import select
import signal
import socket
import subprocess
import sys
import threading
import time
import tty
from itertools import pairwise

import pytest
from pymavlink.dialects.v20 import common as mavlink

from mimopilot.sitl.errors import SitlError
from mimopilot.sitl.faults.kinds import parse_fault
from mimopilot.sitl.mavlink.simulator_api.hitl import SerialPlant
from mimopilot.sitl.mavlink.simulator_api.plant_server import PlantServer
from mimopilot.sitl.mavlink.simulator_api.simulated_vehicle import SimulatedVehicle
from mimopilot.sitl.mavlink.wire.fast_codec import ACTUATORS, ARMED, GPS, SENSOR, STATE, FastCodec
from mimopilot.sitl.mavlink.wire.sockets import LOOPBACK, listen
from mimopilot.sitl.physics.airframe import load_airframe
from tests.conftest import assert_one_clear_line
from tests.paths import TOP
from tests.sitl.mavlink.running import PATIENCE_S, wait_for

TS = 0.004
AIRFRAME = load_airframe("adam0").airframe


class ServedPlant:
    """A plant served in this process, on a thread; its messages are in `reported`."""

    def __init__(self, speed=None, altitude=0.0, *faults):
        self.reported = []
        faults = tuple(map(parse_fault, faults))
        self.vehicle = SimulatedVehicle(AIRFRAME, TS, 3, altitude, self.reported.append, faults)
        self.listener = listen(LOOPBACK, 0)
        self.port = self.listener.getsockname()[1]
        server = PlantServer(self.vehicle, self.listener, speed, child=False)
        self.thread = threading.Thread(target=server.serve, daemon=True)
        self.thread.start()

    def until_reported(self, words):
        wait_for(lambda: any(words in line for line in self.reported), lambda: (words, self.reported))


class Clock:
    """Replaces `time` in a module for one thread: advances when it sleeps, and jumps by `away` (s) at time `at`."""

    def __init__(self, thread, at=float("inf"), away=0.0, end=float("inf")):
        self.thread, self.now, self.at, self.away, self.end = thread, 0.0, at, away, end

    def monotonic(self):
        return self.now if threading.current_thread() is self.thread else time.monotonic()

    def sleep(self, seconds):
        if threading.current_thread() is not self.thread:
            time.sleep(seconds)
            return
        self.now += seconds
        if self.now >= self.at:
            self.now, self.at = self.now + self.away, float("inf")
        if self.now >= self.end:
            raise TimeoutError


class RawAutopilot:
    """A minimal autopilot: answers frames one by one."""

    def __init__(self, port):
        self.codec, self.waiting = FastCodec(1, 1), []
        self.link = socket.create_connection((LOOPBACK, port), timeout=PATIENCE_S)
        self.frames = []

    def read(self):
        """Read the next message."""
        while not self.waiting:
            data = self.link.recv(65536)
            if not data:
                raise ConnectionResetError
            self.waiting = self.codec.parse(data)
        return self.waiting.pop(0)

    def frame(self):
        """Read to the next HIL_STATE_QUATERNION and return its fields; all messages are kept in `frames`."""
        while True:
            message = self.read()
            self.frames.append(message)
            if message[0] is STATE:
                return message[1]

    def answer(self, stamp, command=0.0, mode=ARMED):
        self.link.sendall(self.codec.pack(ACTUATORS, stamp, 1, *[command] * 16, mode))

    def fly(self, periods, command=0.0):
        """Answer this many frames; return the last."""
        for _ in range(periods):
            state = self.frame()
            self.answer(state[0], command)
        return state

    def close(self):
        self.link.close()


@pytest.fixture
def plant():
    return ServedPlant()


def test_the_same_seed_gives_the_same_bytes_after_each_start(plant):
    flights = []
    for _ in range(2):
        autopilot = RawAutopilot(plant.port)
        autopilot.fly(300, 0.6)
        flights.append(autopilot.frames)
        autopilot.close()
    assert flights[0] == flights[1]
    kinds = [kind for kind, _ in flights[0]]
    assert (kinds.count(SENSOR), kinds.count(STATE), kinds.count(GPS)) == (300, 300, 12)
    # Magnetometer and barometer at 50 Hz, accelerometer and gyro with every frame.
    updated = [fields[14] for kind, fields in flights[0] if kind is SENSOR]
    assert [bits & 63 for bits in updated] == [63] * 300
    assert sum(bits & (448 | 6656) == 448 | 6656 for bits in updated) == 60


def test_a_booting_autopilot_gets_a_running_clock_and_a_vehicle_held_at_its_start():
    plant = ServedPlant(speed=1.0)
    autopilot = RawAutopilot(plant.port)
    first = autopilot.frame()
    begin = time.monotonic()
    autopilot.link.sendall(autopilot.codec.pack(mavlink.MAVLink_heartbeat_message, 0, 2, 12, 0, 3, 3))
    stamps, gyro = [first[0]], set()
    while stamps[-1] < first[0] + 1_000_000:
        state = autopilot.frame()
        stamps.append(state[0])
        assert state[1:] == first[1:]
        gyro.add(autopilot.frames[-2][1][4])
    moved = [b - a for a, b in pairwise(stamps) if b > a]
    assert set(moved) == {4000}
    assert time.monotonic() - begin > 0.99  # never faster than real time; a busy machine may be slower
    assert len(gyro) > 100  # its sensors run
    assert plant.vehicle.flown == 0
    autopilot.frames.clear()
    while plant.vehicle.flown < 100:  # now it answers frame by frame, the waiting ones first
        assert autopilot.fly(1, 0.6)[0] < stamps[-1] + 10_000_000
    stamps = [fields[0] for kind, fields in autopilot.frames if kind is STATE]
    assert {b - a for a, b in pairwise(stamps)} == {4000}
    autopilot.close()


def test_the_vehicle_takes_off_and_a_fall_is_reported_as_a_crash(plant):
    autopilot = RawAutopilot(plant.port)
    assert autopilot.fly(250, 0.3)[10] == 0  # below hover thrust it stays on the ground
    assert autopilot.fly(300, 0.6)[10] > 1000  # mm
    while autopilot.fly(1, 0.0)[10] > 0:
        pass
    plant.until_reported("crashed at")
    # After the crash its motors stay stopped.
    assert autopilot.fly(250, 1.0)[10] == 0
    assert len(plant.reported) == 1
    autopilot.close()
    plant.until_reported("disconnected at")
    autopilot = RawAutopilot(plant.port)
    assert autopilot.fly(300, 0.6)[10] > 1000
    autopilot.close()


def test_a_disarmed_autopilot_moves_nothing(plant):
    autopilot = RawAutopilot(plant.port)
    for _ in range(300):
        state = autopilot.frame()
        autopilot.answer(state[0], 1.0, mode=0)
    assert autopilot.frame()[10] == 0
    autopilot.close()


KILLED = """
import sys
sys.path.insert(0, {top!r})
from tests.sitl.mavlink.simulator_api.test_plant_process import RawAutopilot
autopilot = RawAutopilot({port})
autopilot.fly(100, 0.6)
print("flying", flush=True)
while True:
    autopilot.fly(1, 0.6)
"""


def test_a_killed_autopilot_is_reported_and_the_next_one_gets_a_reset_vehicle():
    plant = ServedPlant(speed=1.0)
    code = KILLED.format(top=str(TOP), port=plant.port)
    process = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE)
    assert process.stdout.readline() == b"flying\n"
    process.send_signal(signal.SIGKILL)
    plant.until_reported("the autopilot disconnected at")
    process.wait()
    process.stdout.close()
    autopilot = RawAutopilot(plant.port)
    state = autopilot.frame()
    assert (state[0], state[10]) == (1_000_000, 0)
    autopilot.answer(state[0])
    assert autopilot.frame()[0] == 1_004_000
    autopilot.close()


def test_an_autopilot_that_disconnects_during_link_loss_is_reported_and_the_next_one_is_served():
    plant = ServedPlant(None, 0.0, "link@0.4")
    autopilot = RawAutopilot(plant.port)
    autopilot.fly(100, 0.6)
    autopilot.close()
    plant.until_reported("the autopilot disconnected at")
    autopilot = RawAutopilot(plant.port)
    assert autopilot.frame()[0] == 1_000_000
    autopilot.close()


def test_an_autopilot_that_stops_answering_is_reported_once_and_stays_connected(plant):
    autopilot = RawAutopilot(plant.port)
    begin = time.monotonic()
    autopilot.fly(100, 0.6)
    plant.until_reported("has not answered for 1 s, at 0.40 s")
    assert time.monotonic() - begin >= 1.0
    time.sleep(1.0)
    assert len(plant.reported) == 1
    state = autopilot.fly(100, 0.6)
    assert state[0] == 1_000_000 + 199 * 4000
    plant.until_reported("answers again")
    autopilot.close()


@pytest.mark.parametrize("speed", [0.5, 1.0, 2.0])
def test_time_passes_at_the_requested_speed_and_a_long_delay_is_not_caught_up(monkeypatch, speed):
    plant = ServedPlant(speed)
    clock = Clock(plant.thread, at=1.0, away=3.0)
    monkeypatch.setattr("mimopilot.sitl.mavlink.simulator_api.plant_server.time", clock)
    autopilot = RawAutopilot(plant.port)
    begin = autopilot.fly(1, 0.6)[0]
    for periods, away in ((round(0.5 * speed / TS), 0.0), (round(speed / TS), 3.0)):
        autopilot.fly(periods, 0.6)
        stamp = autopilot.frame()[0]
        assert clock.now == pytest.approx((stamp - begin) / 1e6 / speed + away, abs=2 * TS / speed)
        autopilot.answer(stamp)
    autopilot.close()


def test_a_disarmed_autopilot_that_stops_answering_gets_new_frames_in_real_time(plant):
    autopilot = RawAutopilot(plant.port)
    begin = time.monotonic()
    for _ in range(100):
        state = autopilot.frame()
        autopilot.answer(state[0], mode=0)
    first = autopilot.frame()[0]
    plant.until_reported("it is disarmed: time runs on")
    while (state := autopilot.frame())[0] < first + 1_000_000:
        pass
    assert time.monotonic() - begin > 1.9  # one second of timeout, one of real time
    assert state[10] == 0
    while not any("answers again" in line for line in plant.reported):
        autopilot.answer(autopilot.frame()[0])
    stamps = [autopilot.fly(1, 0.6)[0] for _ in range(50)]
    assert {b - a for a, b in pairwise(stamps)} == {4000}
    autopilot.close()


def test_garbage_and_other_messages_are_ignored_and_reported_once(plant):
    autopilot = RawAutopilot(plant.port)
    autopilot.fly(50, 0.6)
    for _ in range(3):
        state = autopilot.frame()
        autopilot.link.sendall(b"\xfd\xff\0\0garbage" + os.urandom(64))
        autopilot.link.sendall(autopilot.codec.pack(mavlink.MAVLink_heartbeat_message, 0, 6, 8, 0, 4, 3))
        autopilot.answer(state[0] - 4000, 0.0)  # an answer to an older frame is ignored
        autopilot.answer(state[0], 0.6)
    state = autopilot.fly(50, 0.6)
    assert state[0] == 1_000_000 + 102 * 4000
    assert len([line for line in plant.reported if "not MAVLink" in line]) == 1
    assert plant.reported == plant.reported[:1]
    autopilot.close()


def test_commands_that_are_not_finite_stop_the_motors_and_are_reported_once(plant):
    autopilot = RawAutopilot(plant.port)
    state = autopilot.fly(300, 0.6)
    for _ in range(20):
        state = autopilot.frame()
        autopilot.answer(state[0], float("nan"))
    after = autopilot.frame()
    assert after[13] > state[13]  # it falls
    assert all(value == value for value in after)
    assert [line for line in plant.reported if "not finite" in line] == plant.reported
    autopilot.close()


def test_a_second_autopilot_is_refused_and_the_first_flies_on():
    plant = ServedPlant(speed=1.0)
    first = RawAutopilot(plant.port)
    first.fly(50, 0.6)
    second = RawAutopilot(plant.port)
    state = first.fly(100, 0.6)
    assert state[0] == 1_000_000 + 149 * 4000
    with pytest.raises(ConnectionResetError):
        second.read()
    plant.until_reported("a second autopilot was refused")
    assert len(plant.reported) == 1
    first.close()
    second.close()


def test_commands_without_the_lockstep_flag_are_ignored_and_reported_once(plant):
    autopilot = RawAutopilot(plant.port)
    state = autopilot.frame()
    for _ in range(3):
        autopilot.link.sendall(autopilot.codec.pack(ACTUATORS, state[0], 0, *[0.6] * 16, ARMED))
    plant.until_reported("without the lockstep flag")
    assert len(plant.reported) == 1
    autopilot.close()


def test_a_peer_that_never_answers_is_reported(plant, monkeypatch):
    monkeypatch.setattr("mimopilot.sitl.mavlink.simulator_api.plant_server.FIRST_ANSWER_TIMEOUT_S", 0.3)
    autopilot = RawAutopilot(plant.port)
    autopilot.frame()
    plant.until_reported("no HIL_ACTUATOR_CONTROLS")
    autopilot.close()


def test_a_child_process_ends_with_its_parent():
    command = [sys.executable, "-m", "mimopilot", "plant", "adam0", "--port", "0", "--child"]
    idle, busy = (subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) for _ in range(2))
    ports = [int(child.stdout.readline().rsplit(b":", 1)[1]) for child in (idle, busy)]
    autopilot = RawAutopilot(ports[1])
    autopilot.fly(10)
    for child in (idle, busy):
        child.stdin.close()  # as the kernel does when the parent is killed
    with pytest.raises(ConnectionResetError):
        while True:
            autopilot.read()
    autopilot.close()
    for child in (idle, busy):
        assert child.wait(timeout=PATIENCE_S) == 0
        child.stdout.close()


class Board:
    """The far end of a serial line: sends motor commands at 200 Hz while `command` is set, as a board does."""

    def __init__(self):
        self.fd, self.slave = pty.openpty()
        tty.setraw(self.slave)
        self.device = os.ttyname(self.slave)
        self.codec = FastCodec(1, 1)
        self.sensors, self.kinds, self.command, self.running = [], set(), None, True
        self.thread = threading.Thread(target=self._run)
        self.thread.start()

    def _run(self):
        while self.running:
            if select.select([self.fd], [], [], 0.005)[0]:
                for kind, fields in self.codec.parse(os.read(self.fd, 65536)):
                    self.kinds.add(kind)
                    if kind is SENSOR:
                        self.sensors.append(fields)
            if self.command is not None:
                os.write(self.fd, self.codec.pack(ACTUATORS, 0, 0, *[self.command] * 16, ARMED))

    def unplug(self):
        self.running = False
        self.thread.join()
        os.close(self.slave)
        os.close(self.fd)


def test_a_board_on_a_serial_port_flies_and_its_silence_and_disconnection_are_reported(tmp_path):
    reported = []
    vehicle = SimulatedVehicle(AIRFRAME, TS, 0, 0.0, reported.append)
    board, device = Board(), tmp_path / "ttyACM0"
    device.symlink_to(board.device)

    def until(condition):
        wait_for(condition, lambda: reported)

    def until_reported(words):
        until(lambda: any(words in line for line in reported))

    plant = SerialPlant(vehicle, f"{device},921600")
    threading.Thread(target=plant.serve, daemon=True).start()
    until(lambda: len(board.sensors) > 10)
    assert vehicle.flown == 0  # held until the board sends commands
    assert board.kinds == {SENSOR, GPS, mavlink.MAVLink_heartbeat_message}
    board.command = 0.6
    until(lambda: vehicle.simulator.state[2] < -1.0)
    board.command = None
    until_reported("no motor commands from the board for 0.5 s")
    until_reported("crashed at")
    board.command = 0.6
    until_reported("resumed")
    device.unlink()  # another test may get the terminal's number next
    board.unplug()
    until_reported("disconnected")
    assert vehicle.flown == 0
    board = Board()
    device.symlink_to(board.device)
    until(lambda: board.sensors)
    assert board.sensors[0][0] == 1_000_000
    device.unlink()
    board.unplug()


def test_a_board_gets_real_time_and_a_delay_that_is_not_caught_up_is_reported(monkeypatch):
    reported = []
    vehicle = SimulatedVehicle(AIRFRAME, TS, 0, 0.0, reported.append)
    board = Board()
    clock = Clock(threading.current_thread(), 1.0, 3.0, 5.0)
    monkeypatch.setattr("mimopilot.sitl.mavlink.simulator_api.hitl.time", clock)
    first = vehicle.stamp
    with pytest.raises(TimeoutError):
        SerialPlant(vehicle, f"{board.device},921600")._fly()
    board.unplug()
    assert (vehicle.stamp - first) / 1e6 == pytest.approx(5.0 - 3.0, abs=2 * TS)
    (line,) = reported
    assert line.startswith("late by 3.00 s, not caught up")


def test_a_wrong_serial_port_or_speed_is_one_clear_error(mimopilot):
    vehicle = SimulatedVehicle(AIRFRAME, TS, 0, 0.0, print)
    for url, words in (("/dev/nowhere,921600", "cannot be opened"), ("/dev/ttyACM0", "expected DEVICE,BAUD")):
        with pytest.raises(SitlError, match=words):
            SerialPlant(vehicle, url)
    assert_one_clear_line(mimopilot("plant", "adam0", "--serial", "/dev/ttyACM0,9", "--speed", "2"), "real time")
