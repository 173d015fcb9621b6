"""The two processes and their ground link, with real sockets and real clients."""

import math
import socket
import subprocess
import sys
import threading
import time
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from pymavlink import mavutil
from pymavlink.dialects.v20 import common as mavlink

from codegen.native import NativeController, load_native
from codegen.parameters import IDENTITY, PARAMETERS
from sitl.airframe import load_airframe
from sitl.autopilot import Autopilot
from sitl.errors import SitlError
from sitl.loop import fly
from sitl.mavlink.host import Host, plant_process
from sitl.mavlink.link import Codec, listen
from sitl.mavlink.parameter_server import ParameterServer
from sitl.scenario import doublet
from tests.conftest import assert_one_clear_line

TS = 0.004


@pytest.fixture(scope="module")
def vehicle():
    return load_airframe("adam0")


def free_port(kind=socket.SOCK_STREAM):
    with socket.socket(socket.AF_INET, kind) as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def test_a_flight_over_mavlink_has_the_same_moments_bit_for_bit(vehicle):
    gains = vehicle.default_gains()
    scenario = doublet("roll", 0.39, 0.42, TS)
    in_process = fly(vehicle.airframe, Autopilot(vehicle.airframe, gains), scenario, seed=5)
    with plant_process("adam0", 0, TS, 5, None) as port:
        host = Host(Autopilot(vehicle.airframe, gains), 4, port)
        record = host.fly(scenario)
        host.close()
    assert record.tobytes() == in_process.record.tobytes()


def test_an_autopilot_that_starts_late_flies_the_same_flight(vehicle):
    gains = vehicle.default_gains()
    scenario = doublet("roll", 0.39, 0.42, TS, tail=0.1)
    in_process = fly(vehicle.airframe, Autopilot(vehicle.airframe, gains), scenario, seed=5)
    with plant_process("adam0", 0, TS, 5, None) as port:
        host = Host(Autopilot(vehicle.airframe, gains), 4, port)
        time.sleep(1.0)  # several copies of the first frame are waiting by now
        record = host.fly(scenario)
        host.close()
    assert record.tobytes() == in_process.record.tobytes()


def test_the_plant_repeats_its_first_frame_until_it_is_answered_and_then_keeps_lockstep():
    with plant_process("adam0", 0, TS, 0, None) as port, socket.create_connection(("127.0.0.1", port)) as link:
        link.settimeout(5)
        codec, stamps = Codec(), []
        while len(stamps) < 3:
            stamps += [m.time_usec for m in codec.parse(link.recv(4096)) if m.get_type() == "HIL_STATE_QUATERNION"]
        assert len(set(stamps)) == 1
        answer = mavlink.MAVLink_hil_actuator_controls_message(stamps[0], [0.5] * 16, 128, 1)
        link.sendall(codec.pack(answer))
        frames = []
        while len(frames) < 2:
            frames += [
                m for m in codec.parse(link.recv(4096)) if m.get_type() in ("HIL_SENSOR", "HIL_STATE_QUATERNION")
            ]
        assert {f.get_type() for f in frames} == {"HIL_SENSOR", "HIL_STATE_QUATERNION"}
        assert frames[-1].time_usec == stamps[0] + 4000
        # Unanswered, it waits: nothing more comes.
        link.settimeout(0.5)
        with pytest.raises(TimeoutError):
            link.recv(4096)


def test_a_plant_that_goes_away_is_an_error_that_says_when(vehicle):
    server = listen("127.0.0.1", 0)

    def leave():
        connection, _ = server.accept()
        connection.close()

    thread = threading.Thread(target=leave)
    thread.start()
    host = Host(Autopilot(vehicle.airframe, vehicle.default_gains()), 4, server.getsockname()[1])
    with pytest.raises(SitlError, match="went away after 0 of"):
        host.fly(doublet("roll", 0.39, 0.42, TS))
    thread.join()
    server.close()
    host.close()


@pytest.fixture
def server(vehicle):
    gains = vehicle.default_gains()
    return ParameterServer(NativeController(load_native(gains), gains), gains)


def types(answers):
    return [a.get_type() for a in answers]


def test_a_written_parameter_changes_the_running_controller(server):
    (answer,) = server.write("MIMO_RP_RR", 0.12, 9)
    assert np.float32(answer.param_value) == np.float32(0.12)
    assert server.controller.state["gains"][0, 4] == np.float32(0.12)
    assert server.read("MIMO_RP_RR", -1)[0].param_value == np.float32(0.12)


@pytest.mark.parametrize(
    ("name", "value", "kind", "reason"),
    [
        ("MIMO_NOPE", 1.0, 9, 1),
        ("MIMO_RP_RR", 99.0, 9, 2),
        ("MIMO_RP_RR", math.nan, 9, 2),
        ("MIMO_RP_RR", math.inf, 9, 2),
        ("MIMO_TS", 0.002, 9, 5),
        ("MIMO_SCALE_R", 1.0, 9, 5),
        ("MIMO_RP_RR", 0.1, 6, 7),
    ],
)
def test_a_refused_write_says_why_and_changes_nothing(server, name, value, kind, reason):
    before = server.controller.state.tobytes()
    answers = server.write(name, value, kind)
    assert answers[0].get_type() == "PARAM_ERROR"
    assert answers[0].error == reason
    assert types(answers[1:]) == ([] if reason == 1 else ["PARAM_VALUE"])
    assert server.controller.state.tobytes() == before


def test_the_list_holds_the_whole_table_in_order(server):
    listing = list(server.listing())
    assert [m.param_index for m in listing] == list(range(len(PARAMETERS + IDENTITY)))
    assert {m.param_count for m in listing} == {len(PARAMETERS + IDENTITY)}
    for i in (0, 20, 38):
        assert server.read("", i)[0].param_value == listing[i].param_value
    assert types(server.read("", 99)) == ["PARAM_ERROR"]


@contextmanager
def running_sitl(*extra):
    """`mimopilot sitl` on ports of its own; yields the ground station's port."""
    ports = {
        "--port": free_port(),
        "--ground-port": free_port(socket.SOCK_DGRAM),
        "--vehicle-port": free_port(socket.SOCK_DGRAM),
    }
    options = [str(item) for pair in ports.items() for item in pair]
    command = [sys.executable, "-u", "-m", "mimopilot", "sitl", "adam0", *options, *extra]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    try:
        assert "flies" in process.stdout.readline()
        yield process, ports["--ground-port"]
    finally:
        process.terminate()
        process.wait(timeout=10)
        process.stdout.close()


def test_a_ground_station_sees_the_vehicle_and_changes_its_gains():
    with running_sitl() as (_, port):
        link = mavutil.mavlink_connection(f"udpin:127.0.0.1:{port}", dialect="common")
        beat = link.wait_heartbeat(timeout=10)
        assert (beat.type, beat.autopilot) == (mavlink.MAV_TYPE_QUADROTOR, mavlink.MAV_AUTOPILOT_GENERIC)
        attitude = [link.recv_match(type="ATTITUDE", blocking=True, timeout=5) for _ in range(20)]
        assert max(abs(m.roll) for m in attitude) < 0.1
        assert any(m.roll != 0 for m in attitude)
        # Real time: the vehicle's clock keeps up with ours.
        begin, first = time.monotonic(), attitude[-1].time_boot_ms
        while time.monotonic() < begin + 2:
            last = link.recv_match(type="ATTITUDE", blocking=True, timeout=5).time_boot_ms
        assert (last - first) / 2000 == pytest.approx(1.0, abs=0.1)

        link.mav.param_request_list_send(1, 1)
        names = set()
        while len(names) < len(PARAMETERS + IDENTITY):
            message = link.recv_match(type="PARAM_VALUE", blocking=True, timeout=5)
            assert message is not None
            names.add(message.param_id)
        assert names == {p.name for p in PARAMETERS + IDENTITY}

        link.mav.param_set_send(1, 1, b"MIMO_RP_RR", 0.12, 9)
        assert np.float32(link.recv_match(type="PARAM_VALUE", blocking=True, timeout=5).param_value) == np.float32(0.12)
        link.mav.param_request_read_send(1, 1, b"MIMO_RP_RR", -1)
        assert np.float32(link.recv_match(type="PARAM_VALUE", blocking=True, timeout=5).param_value) == np.float32(0.12)
        # Another vehicle's message is not for us.
        link.mav.param_set_send(7, 1, b"MIMO_RP_RR", 0.2, 9)
        link.mav.param_request_read_send(1, 1, b"MIMO_RP_RR", -1)
        assert np.float32(link.recv_match(type="PARAM_VALUE", blocking=True, timeout=5).param_value) == np.float32(0.12)

        link.mav.mission_request_list_send(1, 1)
        assert link.recv_match(type="MISSION_COUNT", blocking=True, timeout=5).count == 0
        link.mav.file_transfer_protocol_send(0, 1, 1, [0] * 3 + [4] + [0] * 247)
        assert link.recv_match(type="FILE_TRANSFER_PROTOCOL", blocking=True, timeout=5).payload[3] == 129
        link.mav.command_long_send(1, 1, 31000, 0, *[0] * 7)
        assert link.recv_match(type="COMMAND_ACK", blocking=True, timeout=5).result == mavlink.MAV_RESULT_UNSUPPORTED
        link.mav.command_long_send(1, 1, 512, 0, 148, *[0] * 6)
        assert link.recv_match(type="AUTOPILOT_VERSION", blocking=True, timeout=5).capabilities & 8192
        link.mav.timesync_send(0, 1234)
        assert link.recv_match(type="TIMESYNC", blocking=True, timeout=5).ts1 == 1234
        link.close()


def test_mavproxy_fetches_and_sets_parameters(tmp_path):
    with running_sitl() as (_, port):
        command = [
            sys.executable,
            "-m",
            "MAVProxy.mavproxy",
            f"--master=udp:127.0.0.1:{port}",
            "--default-modules=param,link",
        ]
        proxy = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, cwd=tmp_path
        )
        output: list[str] = []
        reader = threading.Thread(target=lambda: output.extend(iter(lambda: proxy.stdout.read(1), "")))
        reader.start()

        def until(text, seconds=30):
            deadline = time.monotonic() + seconds
            while text not in "".join(output):
                assert time.monotonic() < deadline, "".join(output)
                time.sleep(0.05)

        def say(line):
            proxy.stdin.write(line + "\n")
            proxy.stdin.flush()

        try:
            until("Received 39 parameters")
            output.clear()
            say("param fetch")
            until("Received 39 parameters")
            say("param set MIMO_RP_RR 0.12")
            time.sleep(1)
            output.clear()
            say("param fetch MIMO_RP_RR")
            say("param show MIMO_RP_RR")
            until("MIMO_RP_RR       0.11999999731779099")
        finally:
            proxy.kill()
            proxy.wait(timeout=10)
            reader.join(timeout=10)
            proxy.stdin.close()
            proxy.stdout.close()


def test_a_plant_port_in_use_is_one_clear_line(mimopilot):
    with listen("127.0.0.1", 0) as taken:
        port = taken.getsockname()[1]
        free = ("--ground-port", free_port(socket.SOCK_DGRAM), "--vehicle-port", free_port(socket.SOCK_DGRAM))
        in_use = mimopilot("sitl", "adam0", "--port", port, *free)
        assert_one_clear_line(in_use, f"TCP port {port}", "--port")
        assert_one_clear_line(mimopilot("plant", "adam0", "--port", port), f"TCP port {port}")


def test_ctrl_c_ends_both_processes():
    import signal

    with running_sitl() as (process, _):
        parents = {p.parent.name: p.read_text().rsplit(")", 1)[1].split()[1] for p in Path("/proc").glob("[0-9]*/stat")}
        children = [child for child, parent in parents.items() if parent == str(process.pid)]
        assert len(children) == 1
        process.send_signal(signal.SIGINT)
        assert process.wait(timeout=10) == 0
        assert not Path(f"/proc/{children[0]}").exists()
