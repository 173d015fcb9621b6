"""The plant as a process: what autopilots of every kind meet, and what happens to them."""

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
from mimopilot.sitl.errors import SitlError
from mimopilot.sitl.faults.kinds import parse_fault
from mimopilot.sitl.mavlink.simulator_api.hitl import SerialPlant
from mimopilot.sitl.mavlink.simulator_api.plant_server import PlantServer
from mimopilot.sitl.mavlink.simulator_api.simulated_vehicle import ARMED, SimulatedVehicle
from mimopilot.sitl.mavlink.wire.fast_codec import ACTUATORS, GPS, SENSOR, STATE, FastCodec
from mimopilot.sitl.mavlink.wire.sockets import LOOPBACK, listen
from mimopilot.sitl.physics.airframe import load_airframe
from pymavlink.dialects.v20 import common as mavlink

from tests.conftest import assert_one_clear_line
from tests.paths import TOP
from tests.sitl.mavlink.running import PATIENCE_S, wait_for

TS = 0.004
AIRFRAME = load_airframe("adam0").airframe


class Bench:
    """A plant served in this process, on a thread; what it tells is in `told`."""

    def __init__(self, speed=None, altitude=0.0, *faults):
        self.told = []
        self.vehicle = SimulatedVehicle(AIRFRAME, TS, 3, altitude, self.told.append, tuple(map(parse_fault, faults)))
        self.listener = listen(LOOPBACK, 0)
        self.port = self.listener.getsockname()[1]
        server = PlantServer(self.vehicle, self.listener, speed, child=False)
        self.thread = threading.Thread(target=server.serve, daemon=True)
        self.thread.start()

    def until_told(self, words):
        wait_for(lambda: any(words in line for line in self.told), lambda: (words, self.told))


class Clock:
    """In place of `time` in a module, for one thread: passes while that sleeps, and by `away` (s) at once at `at`."""

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


class Pilot:
    """A raw autopilot: answers frames one by one."""

    def __init__(self, port):
        self.codec, self.waiting = FastCodec(1, 1), []
        self.link = socket.create_connection((LOOPBACK, port), timeout=PATIENCE_S)
        self.frames = []

    def read(self):
        """The next message."""
        while not self.waiting:
            data = self.link.recv(65536)
            if not data:
                raise ConnectionResetError
            self.waiting = self.codec.parse(data)
        return self.waiting.pop(0)

    def frame(self):
        """Fields of the next HIL_STATE_QUATERNION; everything on the way to it is kept in `frames`."""
        while True:
            message = self.read()
            self.frames.append(message)
            if message[0] is STATE:
                return message[1]

    def answer(self, stamp, command=0.0, mode=ARMED):
        self.link.sendall(self.codec.pack(ACTUATORS, stamp, 1, *[command] * 16, mode))

    def fly(self, periods, command=0.0):
        """Answer so many frames; returns the last."""
        for _ in range(periods):
            state = self.frame()
            self.answer(state[0], command)
        return state

    def close(self):
        self.link.close()


@pytest.fixture
def bench():
    return Bench()


def test_the_same_seed_gives_the_same_bytes_after_each_start(bench):
    flights = []
    for _ in range(2):
        pilot = Pilot(bench.port)
        pilot.fly(300, 0.6)
        flights.append(pilot.frames)
        pilot.close()
    assert flights[0] == flights[1]
    kinds = [kind for kind, _ in flights[0]]
    assert (kinds.count(SENSOR), kinds.count(STATE), kinds.count(GPS)) == (300, 300, 12)
    # Magnetometer and barometer at 50 Hz, accelerometer and gyro with every frame.
    updated = [fields[14] for kind, fields in flights[0] if kind is SENSOR]
    assert [bits & 63 for bits in updated] == [63] * 300
    assert sum(bits & (448 | 6656) == 448 | 6656 for bits in updated) == 60


def test_an_autopilot_that_boots_gets_a_running_clock_and_a_vehicle_that_waits():
    bench = Bench(speed=1.0)
    pilot = Pilot(bench.port)
    first = pilot.frame()
    begin = time.monotonic()
    pilot.link.sendall(pilot.codec.pack(mavlink.MAVLink_heartbeat_message, 0, 2, 12, 0, 3, 3))
    stamps, gyro = [first[0]], set()
    while stamps[-1] < first[0] + 1_000_000:
        state = pilot.frame()
        stamps.append(state[0])
        assert state[1:] == first[1:]
        gyro.add(pilot.frames[-2][1][4])
    moved = [b - a for a, b in pairwise(stamps) if b > a]
    assert set(moved) == {4000}
    assert time.monotonic() - begin > 0.99  # never faster than real time; how much slower is the machine's affair
    assert len(gyro) > 100  # its sensors are alive
    assert bench.vehicle.flown == 0
    pilot.frames.clear()
    while bench.vehicle.flown < 100:  # now it answers frame by frame, those first that have waited
        assert pilot.fly(1, 0.6)[0] < stamps[-1] + 10_000_000
    stamps = [fields[0] for kind, fields in pilot.frames if kind is STATE]
    assert {b - a for a, b in pairwise(stamps)} == {4000}
    pilot.close()


def test_it_takes_off_and_a_fall_is_a_crash_that_is_told(bench):
    pilot = Pilot(bench.port)
    assert pilot.fly(250, 0.3)[10] == 0  # below hover it stands
    assert pilot.fly(300, 0.6)[10] > 1000  # mm
    while pilot.fly(1, 0.0)[10] > 0:
        pass
    bench.until_told("crashed at")
    # It stays down, whatever the autopilot wants.
    assert pilot.fly(250, 1.0)[10] == 0
    assert len(bench.told) == 1
    pilot.close()
    bench.until_told("went away at")
    pilot = Pilot(bench.port)
    assert pilot.fly(300, 0.6)[10] > 1000
    pilot.close()


def test_a_disarmed_autopilot_moves_nothing(bench):
    pilot = Pilot(bench.port)
    for _ in range(300):
        state = pilot.frame()
        pilot.answer(state[0], 1.0, mode=0)
    assert pilot.frame()[10] == 0
    pilot.close()


KILLED = """
import sys
sys.path.insert(0, {top!r})
from tests.sitl.mavlink.test_plant_process import Pilot
pilot = Pilot({port})
pilot.fly(100, 0.6)
print("flying", flush=True)
while True:
    pilot.fly(1, 0.6)
"""


def test_a_killed_autopilot_is_noticed_within_a_second_and_the_next_starts_anew():
    bench = Bench(speed=1.0)
    code = KILLED.format(top=str(TOP), port=bench.port)
    autopilot = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE)
    assert autopilot.stdout.readline() == b"flying\n"
    autopilot.send_signal(signal.SIGKILL)
    bench.until_told("the autopilot went away at")
    autopilot.wait()
    autopilot.stdout.close()
    pilot = Pilot(bench.port)
    state = pilot.frame()
    assert (state[0], state[10]) == (1_000_000, 0)
    pilot.answer(state[0])
    assert pilot.frame()[0] == 1_004_000
    pilot.close()


def test_an_autopilot_that_leaves_while_the_link_is_cut_is_noticed_and_the_next_is_served():
    bench = Bench(None, 0.0, "link@0.4")
    pilot = Pilot(bench.port)
    pilot.fly(100, 0.6)
    pilot.close()
    bench.until_told("the autopilot went away at")
    pilot = Pilot(bench.port)
    assert pilot.frame()[0] == 1_000_000
    pilot.close()


def test_a_frozen_autopilot_is_told_once_and_kept(bench):
    pilot = Pilot(bench.port)
    begin = time.monotonic()
    pilot.fly(100, 0.6)
    bench.until_told("has not answered for 1 s, at 0.40 s")
    assert time.monotonic() - begin >= 1.0
    time.sleep(1.0)
    assert len(bench.told) == 1
    state = pilot.fly(100, 0.6)
    assert state[0] == 1_000_000 + 199 * 4000
    bench.until_told("answers again")
    pilot.close()


@pytest.mark.parametrize("speed", [0.5, 1.0, 2.0])
def test_time_passes_as_fast_as_asked_and_what_a_busy_machine_missed_is_left_out(monkeypatch, speed):
    bench = Bench(speed)
    clock = Clock(bench.thread, at=1.0, away=3.0)
    monkeypatch.setattr("mimopilot.sitl.mavlink.simulator_api.plant_server.time", clock)
    pilot = Pilot(bench.port)
    begin = pilot.fly(1, 0.6)[0]
    for periods, away in ((round(0.5 * speed / TS), 0.0), (round(speed / TS), 3.0)):
        pilot.fly(periods, 0.6)
        stamp = pilot.frame()[0]
        assert clock.now == pytest.approx((stamp - begin) / 1e6 / speed + away, abs=2 * TS / speed)
        pilot.answer(stamp)
    pilot.close()


def test_a_disarmed_autopilot_that_stops_answering_gets_a_running_clock(bench):
    pilot = Pilot(bench.port)
    begin = time.monotonic()
    for _ in range(100):
        state = pilot.frame()
        pilot.answer(state[0], mode=0)
    first = pilot.frame()[0]
    bench.until_told("it is disarmed: time runs on")
    while (state := pilot.frame())[0] < first + 1_000_000:
        pass
    assert time.monotonic() - begin > 1.9  # one second of patience, one of real time
    assert state[10] == 0
    while not any("answers again" in line for line in bench.told):
        pilot.answer(pilot.frame()[0])
    stamps = [pilot.fly(1, 0.6)[0] for _ in range(50)]
    assert {b - a for a, b in pairwise(stamps)} == {4000}
    pilot.close()


def test_garbage_and_other_messages_are_passed_over_told_once_and_stall_nothing(bench):
    pilot = Pilot(bench.port)
    pilot.fly(50, 0.6)
    for _ in range(3):
        state = pilot.frame()
        pilot.link.sendall(b"\xfd\xff\0\0garbage" + os.urandom(64))
        pilot.link.sendall(pilot.codec.pack(mavlink.MAVLink_heartbeat_message, 0, 6, 8, 0, 4, 3))
        pilot.answer(state[0] - 4000, 0.0)  # an answer to an older frame is no answer
        pilot.answer(state[0], 0.6)
    state = pilot.fly(50, 0.6)
    assert state[0] == 1_000_000 + 102 * 4000
    assert len([line for line in bench.told if "no MAVLink" in line]) == 1
    assert bench.told == bench.told[:1]
    pilot.close()


def test_commands_that_are_not_finite_stop_the_motors_and_are_told_once(bench):
    pilot = Pilot(bench.port)
    state = pilot.fly(300, 0.6)
    for _ in range(20):
        state = pilot.frame()
        pilot.answer(state[0], float("nan"))
    after = pilot.frame()
    assert after[13] > state[13]  # it falls
    assert all(value == value for value in after)
    assert [line for line in bench.told if "not finite" in line] == bench.told
    pilot.close()


def test_a_second_autopilot_is_turned_away_and_the_first_flies_on():
    bench = Bench(speed=1.0)
    first = Pilot(bench.port)
    first.fly(50, 0.6)
    second = Pilot(bench.port)
    state = first.fly(100, 0.6)
    assert state[0] == 1_000_000 + 149 * 4000
    with pytest.raises(ConnectionResetError):
        second.read()
    bench.until_told("a second autopilot was turned away")
    assert len(bench.told) == 1
    first.close()
    second.close()


def test_an_autopilot_that_keeps_its_own_time_is_told_that_it_cannot_fly(bench):
    pilot = Pilot(bench.port)
    state = pilot.frame()
    for _ in range(3):
        pilot.link.sendall(pilot.codec.pack(ACTUATORS, state[0], 0, *[0.6] * 16, ARMED))
    bench.until_told("without the lockstep flag")
    assert len(bench.told) == 1
    pilot.close()


def test_a_peer_that_is_no_autopilot_is_asked_about(bench, monkeypatch):
    monkeypatch.setattr("mimopilot.sitl.mavlink.simulator_api.plant_server.MUTE_S", 0.3)
    pilot = Pilot(bench.port)
    pilot.frame()
    bench.until_told("no HIL_ACTUATOR_CONTROLS")
    pilot.close()


def test_a_child_ends_with_its_parent():
    command = [sys.executable, "-m", "mimopilot", "plant", "adam0", "--port", "0", "--child"]
    idle, busy = (subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) for _ in range(2))
    ports = [int(child.stdout.readline().rsplit(b":", 1)[1]) for child in (idle, busy)]
    pilot = Pilot(ports[1])
    pilot.fly(10)
    for child in (idle, busy):
        child.stdin.close()  # as the kernel does it when the parent is killed
    with pytest.raises(ConnectionResetError):
        while True:
            pilot.read()
    pilot.close()
    for child in (idle, busy):
        assert child.wait(timeout=PATIENCE_S) == 0
        child.stdout.close()


class Board:
    """The far end of a serial line: sends motor commands at 200 Hz when told to, as a board does."""

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


def test_a_board_on_a_serial_port_flies_in_real_time_and_its_silence_and_loss_are_told(tmp_path):
    told = []
    vehicle = SimulatedVehicle(AIRFRAME, TS, 0, 0.0, told.append)
    board, device = Board(), tmp_path / "ttyACM0"
    device.symlink_to(board.device)

    def until(condition):
        wait_for(condition, lambda: told)

    def until_told(words):
        until(lambda: any(words in line for line in told))

    plant = SerialPlant(vehicle, f"{device},921600")
    threading.Thread(target=plant.serve, daemon=True).start()
    until(lambda: len(board.sensors) > 10)
    assert vehicle.flown == 0  # held until the board speaks
    assert board.kinds == {SENSOR, GPS, mavlink.MAVLink_heartbeat_message}
    board.command = 0.6
    until(lambda: vehicle.simulator.state[2] < -1.0)
    board.command = None
    until_told("no motor commands from the board for 0.5 s")
    until_told("crashed at")
    board.command = 0.6
    until_told("come again")
    device.unlink()  # the terminal's number may be given to another test next
    board.unplug()
    until_told("went away")
    assert vehicle.flown == 0
    board = Board()
    device.symlink_to(board.device)
    until(lambda: board.sensors)
    assert board.sensors[0][0] == 1_000_000
    device.unlink()
    board.unplug()


def test_a_board_gets_real_time_and_what_a_busy_machine_missed_is_told(monkeypatch):
    told = []
    vehicle = SimulatedVehicle(AIRFRAME, TS, 0, 0.0, told.append)
    board = Board()
    clock = Clock(threading.current_thread(), 1.0, 3.0, 5.0)
    monkeypatch.setattr("mimopilot.sitl.mavlink.simulator_api.hitl.time", clock)
    first = vehicle.stamp
    with pytest.raises(TimeoutError):
        SerialPlant(vehicle, f"{board.device},921600")._fly()
    board.unplug()
    assert (vehicle.stamp - first) / 1e6 == pytest.approx(5.0 - 3.0, abs=2 * TS)
    (line,) = told
    assert line.startswith("late by 3.00 s, which is left out")


def test_a_wrong_serial_port_or_speed_is_one_clear_line(mimopilot):
    vehicle = SimulatedVehicle(AIRFRAME, TS, 0, 0.0, print)
    for url, words in (("/dev/nowhere,921600", "cannot be opened"), ("/dev/ttyACM0", "expected DEVICE,BAUD")):
        with pytest.raises(SitlError, match=words):
            SerialPlant(vehicle, url)
    assert_one_clear_line(mimopilot("plant", "adam0", "--serial", "/dev/ttyACM0,9", "--speed", "2"), "real time")
