"""The parameter server, and how `mimopilot sitl` meets ground stations and mistakes."""

import math
import socket

import numpy as np
import pytest
from pymavlink.dialects.v20 import common as mavlink

from codegen.native import NativeController, load_native
from codegen.parameters import EXCITATION, IDENTITY, PARAMETERS
from sitl.airframe import load_airframe
from sitl.injector import Injector
from sitl.mavlink.link import listen
from sitl.mavlink.parameter_server import ParameterServer
from tests.conftest import assert_one_clear_line
from tests.sitl.running import Pilot, free_port, running_sitl

TABLE = [*PARAMETERS, *IDENTITY, *EXCITATION]


@pytest.fixture(scope="module")
def vehicle():
    return load_airframe("adam0")


@pytest.fixture
def server(vehicle):
    gains = vehicle.default_gains()
    return ParameterServer(NativeController(load_native(gains), gains), gains, Injector(gains.Ts))


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
    assert [m.param_index for m in listing] == list(range(len(TABLE)))
    assert {m.param_count for m in listing} == {len(TABLE)}
    for i in (0, 20, 38):
        assert server.read("", i)[0].param_value == listing[i].param_value
    assert types(server.read("", 99)) == ["PARAM_ERROR"]


def test_a_ground_station_sees_the_vehicle_and_changes_its_gains():
    with running_sitl() as sitl:
        pilot = Pilot(f"udpin:127.0.0.1:{sitl.udp}")
        mav = pilot.link.mav
        assert (pilot.beat.type, pilot.beat.autopilot) == (mavlink.MAV_TYPE_QUADROTOR, mavlink.MAV_AUTOPILOT_GENERIC)
        attitude = [pilot.asks("ATTITUDE") for _ in range(20)]
        assert max(abs(m.roll) for m in attitude) < 0.1
        assert any(m.roll != 0 for m in attitude)

        mav.param_request_list_send(1, 1)
        names = set()
        while len(names) < len(TABLE):
            names.add(pilot.asks("PARAM_VALUE").param_id)
        assert names == {p.name for p in TABLE}

        mav.param_set_send(1, 1, b"MIMO_RP_RR", 0.12, 9)
        assert np.float32(pilot.asks("PARAM_VALUE").param_value) == np.float32(0.12)
        # Another vehicle's message is not for us.
        mav.param_set_send(7, 1, b"MIMO_RP_RR", 0.2, 9)
        mav.param_request_read_send(1, 1, b"MIMO_RP_RR", -1)
        assert np.float32(pilot.asks("PARAM_VALUE").param_value) == np.float32(0.12)
        pilot.close()


def test_a_plant_port_in_use_is_one_clear_line(mimopilot):
    with listen("127.0.0.1", 0) as taken:
        port = taken.getsockname()[1]
        free = ("--ground-port", free_port(socket.SOCK_DGRAM), "--vehicle-port", free_port(socket.SOCK_DGRAM))
        in_use = mimopilot("sitl", "adam0", "--port", port, *free)
        assert_one_clear_line(in_use, f"TCP port {port}", "--port")
        assert_one_clear_line(mimopilot("plant", "adam0", "--port", port), f"TCP port {port}")
