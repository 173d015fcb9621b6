"""The plant under ArduPilot's JSON protocol, with a small simulator of our own at the other end."""

import json
import math
import signal
import socket
import threading
import time

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mimopilot.sitl.errors import SitlError
from mimopilot.sitl.faults.kinds import parse_fault
from mimopilot.sitl.mavlink.simulator_api import json_server
from mimopilot.sitl.mavlink.simulator_api.ardupilot_json import PACKETS, parse_servos
from mimopilot.sitl.mavlink.simulator_api.json_server import JsonServer, check_json_faults
from mimopilot.sitl.mavlink.simulator_api.simulated_vehicle import SimulatedVehicle
from mimopilot.sitl.mavlink.wire.sockets import LOOPBACK, udp_socket
from mimopilot.sitl.physics.airframe import load_airframe
from mimopilot.sitl.physics.rigid_body import GRAVITY
from tests.conftest import assert_one_clear_line
from tests.sitl.mavlink.running import PATIENCE_S, free_port, start, wait_for

AIRFRAME = load_airframe("adam0").airframe
MAGIC = {16: 18458, 32: 29569}
RATE = 1200
WEIGHT = AIRFRAME.mass * GRAVITY
#: Thrust fraction of hover.
HOVER = WEIGHT / (4 * AIRFRAME.motors.thrust_max)
STANDING, HOVERING, FULL = 1000, round(1000 + 1000 * HOVER), 2000


class ScriptedSitl:
    """ArduPilot's end of the link: sends servo outputs, one frame at a time, and reads the answer."""

    def __init__(self, address, channels=16, rate=RATE):
        self.link = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.link.settimeout(PATIENCE_S)
        self.link.connect(address)
        self.channels, self.rate, self.count = channels, rate, -1

    def packet(self, pulses, count):
        magic = MAGIC[self.channels]
        rest = [0] * (self.channels - len(pulses))
        return PACKETS[magic].pack(magic, self.rate, count, *pulses, *rest)

    def ask(self, pulses, count=None):
        """One frame; the bytes of the answer."""
        self.count = self.count + 1 if count is None else count
        self.link.send(self.packet(pulses, self.count))
        return self.link.recv(4096)

    def fly(self, frames, *pulses):
        """Fly frames with pulses for all four motors, or for each; the last answer, parsed."""
        pulses = pulses * 4 if len(pulses) == 1 else pulses
        for _ in range(frames):
            answer = self.ask(pulses)
        return parsed(answer)

    def close(self):
        self.link.close()


def parsed(answer):
    assert answer[:1] == answer[-1:] == b"\n"
    assert answer.count(b"\n") == 2
    return json.loads(answer)


class Served:
    """A vehicle served on a thread; its messages are in `reported`."""

    def __init__(self, altitude=0.0, faults=(), speed=None):
        self.reported = []
        self.altitude, self.faults = altitude, tuple(map(parse_fault, faults))
        self.link = udp_socket(LOOPBACK, 0)
        self.vehicle = SimulatedVehicle(AIRFRAME, 1 / RATE, 0, altitude, self.reported.append, self.faults, False)
        self.server = JsonServer(self.vehicle, self.link, speed, child=False)
        threading.Thread(target=self.server.serve, daemon=True).start()
        self.peers = []

    def sitl(self, **options):
        self.peers.append(ScriptedSitl(self.link.getsockname(), **options))
        return self.peers[-1]


@pytest.fixture
def served():
    made = []

    def serve(**options):
        made.append(Served(**options))
        return made[-1]

    yield serve
    for one in made:
        for peer in one.peers:
            peer.close()


def test_a_vehicle_at_rest_on_the_ground_feels_its_weight_at_every_rate(served):
    for rate, channels in ((1200, 16), (400, 32), (333, 16)):
        sitl = served().sitl(rate=rate, channels=channels)
        motion = sitl.fly(rate, STANDING)
        assert motion["timestamp"] == pytest.approx(1.0, abs=1e-6)
        assert motion["imu"]["accel_body"] == pytest.approx([0, 0, -GRAVITY], abs=1e-6)
        assert motion["position"] == pytest.approx([0, 0, 0], abs=1e-9)
        assert motion["quaternion"] == pytest.approx([1, 0, 0, 0], abs=1e-9)


def test_a_vehicle_in_free_fall_obeys_the_closed_form_with_drag(served):
    sitl = served(altitude=50.0).sitl()
    sitl.fly(RATE, STANDING)  # the rotors run down
    begin = sitl.fly(1, STANDING)
    end = sitl.fly(RATE, STANDING)
    # m dv/dt = m g - d v: v - v_end decays with d / m, apart from the last thousandth of the rotors' thrust.
    terminal, decay = WEIGHT / AIRFRAME.drag, AIRFRAME.drag / AIRFRAME.mass
    before = begin["velocity"][2]
    fallen = terminal + (before - terminal) * math.exp(-decay)
    assert end["velocity"][2] == pytest.approx(fallen, abs=2e-3)
    path = terminal + (before - terminal) * (1 - math.exp(-decay)) / decay
    assert end["position"][2] - begin["position"][2] == pytest.approx(path, abs=2e-3)
    assert end["imu"]["accel_body"] == pytest.approx([0, 0, -AIRFRAME.drag * fallen / AIRFRAME.mass], abs=2e-3)


@pytest.mark.parametrize("channels", [16, 32])
def test_hover_thrust_balances_the_weight_and_a_pair_of_motors_rolls(served, channels):
    sitl = served(altitude=10.0).sitl(channels=channels)
    motion = sitl.fly(RATE, HOVERING)
    left = 4 * AIRFRAME.motors.thrust_max * (HOVERING - 1000) / 1000 - WEIGHT  # a pulse is a whole microsecond
    assert motion["imu"]["accel_body"][2] == pytest.approx(-GRAVITY - left / AIRFRAME.mass, abs=1e-3)
    assert motion["position"][2] == pytest.approx(-10 - left / AIRFRAME.mass / 2, abs=2e-3)
    # Motors on the left, 2 and 3, give more: it rolls to the right.
    motion = sitl.fly(RATE // 20, HOVERING - 20, HOVERING + 20, HOVERING + 20, HOVERING - 20)
    assert motion["imu"]["gyro"][0] > 0.1
    assert abs(motion["imu"]["gyro"][1]) < motion["imu"]["gyro"][0] / 4  # the airframe's coupling
    assert motion["quaternion"][1] > 0


def test_pulses_outside_of_the_range_are_limited_and_none_stops_a_motor(served):
    sitl = served(altitude=10.0).sitl()
    sitl.fly(RATE // 2, 2200)
    full = sitl.fly(1, FULL)["imu"]["accel_body"][2]
    assert sitl.fly(1, 65535)["imu"]["accel_body"][2] == pytest.approx(full, rel=0.01)
    assert full == pytest.approx(-4 * AIRFRAME.motors.thrust_max / AIRFRAME.mass, rel=0.05)
    assert sitl.fly(RATE // 2, 0)["imu"]["accel_body"][2] == pytest.approx(0, abs=0.5)


def test_a_repeated_frame_gets_the_same_bytes_and_is_not_flown_again(served):
    plant = served(altitude=10.0)
    sitl = plant.sitl()
    sitl.fly(10, HOVERING)
    first = sitl.ask([FULL] * 4)
    assert sitl.ask([STANDING] * 4, sitl.count) == first
    assert plant.vehicle.flown == 11
    assert parsed(sitl.ask([FULL] * 4))["timestamp"] == pytest.approx(12 / RATE, abs=1e-9)


def test_a_falling_count_and_a_new_port_are_restarts_that_fly_the_same_again(served, monkeypatch):
    monkeypatch.setattr(json_server, "SILENT_S", 0.2)
    plant = served()
    sitl = plant.sitl()

    def flight(peer):
        return [peer.ask([FULL] * 4) for _ in range(50)]

    first = flight(sitl)
    sitl.count = -1
    assert flight(sitl) == first
    assert plant.reported == ["ArduPilot restarted at 0.04 s of flight; the vehicle is reset to its start"]
    time.sleep(0.25)
    assert flight(plant.sitl()) == first
    assert len(plant.reported) == 2
    # The plant itself was restarted: it begins at any count.
    late = served().sitl()
    late.count = 4321
    assert flight(late) == first


def test_a_second_ardupilot_is_ignored_while_the_first_one_flies(served):
    plant = served()
    first, second = plant.sitl(), plant.sitl()
    first.fly(20, FULL)
    second.link.send(second.packet([FULL] * 4, 0))
    assert first.fly(1, FULL)["timestamp"] == pytest.approx(21 / RATE, abs=1e-9)
    assert plant.reported == ["a second ArduPilot is ignored: this vehicle has one already"]
    assert plant.server.ignored == 1


def test_a_new_frame_rate_changes_the_period_and_neither_motion_nor_faults(served):
    plant = served(altitude=10.0, faults=("motor:1=0@0.2", "mass:0.1,0,0=0.2@0.05"))
    sitl = plant.sitl()
    sitl.fly(RATE // 10, HOVERING)
    before = sitl.fly(1, HOVERING)
    sitl.rate = 600
    after = sitl.fly(1, HOVERING)
    step = after["timestamp"] - before["timestamp"]
    assert step == pytest.approx(1 / 600, abs=1e-9)
    for now, then, rate in zip(after["position"], before["position"], before["velocity"], strict=True):
        assert now - then == pytest.approx(rate * step, abs=1e-5)
    assert plant.vehicle.simulator.plant.mass == pytest.approx(AIRFRAME.mass + 0.2)
    sitl.fly(30, HOVERING)
    assert plant.vehicle.simulator.plant.effectiveness[0] == 1
    sitl.fly(40, HOVERING)
    assert plant.vehicle.simulator.plant.effectiveness[0] == 0
    assert not plant.reported


def test_a_crash_stops_the_motors_until_a_restart(served):
    plant = served(altitude=2.0)
    sitl = plant.sitl()
    sitl.fly(RATE, STANDING)
    wait_for(lambda: any("crashed at" in line for line in plant.reported), lambda: plant.reported)
    assert sitl.fly(RATE // 10, FULL)["position"][2] == pytest.approx(0, abs=1e-6)
    assert len(plant.reported) == 1


def test_time_passes_no_faster_than_the_speed_asked_for(served):
    sitl = served(speed=2.0).sitl()
    sitl.fly(1, STANDING)
    begin = time.monotonic()
    sitl.fly(RATE // 2, STANDING)
    assert time.monotonic() - begin > 0.24


BAD = (b"", b"\n", b"garbage", bytes(40), bytes(72))


def test_garbage_is_ignored_and_counted_with_one_warning(served):
    plant = served()
    sitl = plant.sitl()
    sitl.fly(3, STANDING)
    good = sitl.packet([FULL] * 4, 3)
    for bad in (*BAD, good[:-1], good + b"\0", PACKETS[18458].pack(18458, 0, 3, *[0] * 16), b"\0\0" + good[2:]):
        sitl.link.send(bad)
    assert sitl.fly(1, STANDING)["timestamp"] == pytest.approx(4 / RATE, abs=1e-9)
    assert plant.server.ignored == len(BAD) + 4
    assert len(plant.reported) == 1
    assert "not ArduPilot's servo outputs" in plant.reported[0]


@settings(max_examples=200, deadline=None)
@given(st.binary(max_size=80) | st.binary(min_size=38, max_size=38).map(lambda rest: b"\x1a\x48" + rest))
def test_no_bytes_are_read_as_anything_but_a_whole_packet(data):
    packet = parse_servos(data)
    whole = len(data) in (40, 72) and int.from_bytes(data[:2], "little") == MAGIC[(len(data) - 8) // 2]
    rate = int.from_bytes(data[2:4], "little")
    assert (packet is not None) == (whole and 1 <= rate <= 10_000)
    if packet is not None:
        assert packet.number == int.from_bytes(data[4:8], "little")
        assert len(packet.controls) == 16
        assert np.all((np.array(packet.controls) >= 0) & (np.array(packet.controls) <= 1))


@pytest.mark.parametrize("text", ["gyro-nan@1", "gyro-noise=0.1@1", "clock=1@1", "loss=0.1@1", "link@1", "skip=3@1"])
def test_a_fault_that_the_protocol_cannot_carry_is_refused(text):
    with pytest.raises(SitlError, match="not with ardupilot-json"):
        check_json_faults([parse_fault(text)])


def test_faults_of_the_plant_act(served):
    sitl = served(faults=("gyro-bias:roll=0.5@0.1",)).sitl()
    assert sitl.fly(100, STANDING)["imu"]["gyro"][0] == pytest.approx(0, abs=1e-6)
    assert sitl.fly(100, STANDING)["imu"]["gyro"][0] == pytest.approx(0.5, abs=1e-6)


def test_the_command_serves_names_a_port_in_use_and_ends_with_ctrl_c(mimopilot):
    port = free_port(socket.SOCK_DGRAM)
    command = ("plant", "adam0", "--protocol", "ardupilot-json", "--port", str(port))
    program = start(*command)
    try:
        program.until(f"listens on UDP 127.0.0.1:{port}")
        sitl = ScriptedSitl((LOOPBACK, port))
        assert sitl.fly(10, STANDING)["timestamp"] == pytest.approx(10 / RATE, abs=1e-9)
        sitl.link.send(b"garbage")
        sitl.fly(1, STANDING)
        assert_one_clear_line(mimopilot(*command), f"UDP port {port}")
        program.process.send_signal(signal.SIGINT)
        assert program.process.wait(timeout=PATIENCE_S) == 0
        program.until("1 packets were ignored")
        assert "Traceback" not in program.output
        sitl.close()
    finally:
        program.end()


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--rate", "400"), "--rate: not with ardupilot-json"),
        (("--altitude", "10", "--serial", "/dev/x,9"), "--altitude, --serial: not with ardupilot-json"),
        (("--fault", "loss=0.5@1"), "waits for every answer"),
    ],
)
def test_options_of_the_other_protocol_are_refused(mimopilot, options, words):
    assert_one_clear_line(mimopilot("plant", "adam0", "--protocol", "ardupilot-json", *options), words)


def test_an_unknown_protocol_is_refused(mimopilot):
    assert_one_clear_line(mimopilot("plant", "adam0", "--protocol", "gazebo"), "--protocol")
