"""`mimopilot sitl` and ground stations that connect, and mistakes on its command line."""

import socket

import numpy as np
import pytest
from pymavlink.dialects.v20 import common as mavlink

from mimopilot.sitl.mavlink.wire.sockets import listen
from mimopilot.tuning.parameters import EXCITATION, FIRMWARE_NUMBER, IDENTITY, PARAMETERS, SET_NUMBER
from tests.conftest import assert_one_clear_line
from tests.sitl.mavlink.running import Pilot, free_port, running_sitl

ACCEPTED, UNSUPPORTED = 0, 3
TABLE = [*PARAMETERS, *IDENTITY, FIRMWARE_NUMBER, *EXCITATION, SET_NUMBER]


@pytest.fixture(scope="module")
def pilot():
    with running_sitl() as sitl:
        pilot = Pilot(f"udpin:127.0.0.1:{sitl.udp}")
        pilot.ready()
        yield pilot
        pilot.close()


def test_a_ground_station_sees_the_vehicle_and_changes_its_gains(pilot):
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
    # A message to another vehicle is ignored.
    mav.param_set_send(7, 1, b"MIMO_RP_RR", 0.2, 9)
    mav.param_request_read_send(1, 1, b"MIMO_RP_RR", -1)
    assert np.float32(pilot.asks("PARAM_VALUE").param_value) == np.float32(0.12)


def test_qgroundcontrols_start_sequence_is_answered_without_a_wait(pilot):
    """Each request of its InitialConnectStateMachine, in its order, and those that follow are answered."""
    mav = pilot.link.mav
    mav.heartbeat_send(mavlink.MAV_TYPE_GCS, mavlink.MAV_AUTOPILOT_INVALID, 192, 0, 4)
    pilot.texts.clear()
    request = mavlink.MAV_CMD_REQUEST_MESSAGE
    assert pilot.command(request, mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION) == ACCEPTED
    assert pilot.asks("AUTOPILOT_VERSION").capabilities & mavlink.MAV_PROTOCOL_CAPABILITY_MAVLINK2
    for unknown in (435, 397, 395):  # AVAILABLE_MODES, COMPONENT_METADATA, COMPONENT_INFORMATION
        assert pilot.command(request, unknown) == UNSUPPORTED
    mav.param_request_list_send(1, 0)
    found = {pilot.asks("PARAM_VALUE").param_index for _ in TABLE}
    assert found == set(range(len(TABLE)))
    for kind in (0, 1, 2):  # mission, fence, rally points
        mav.mission_request_list_send(1, 1, kind)
        answer = pilot.asks("MISSION_COUNT")
        assert (answer.count, answer.mission_type) == (0, kind)
    for unknown in (521, 519, 183):
        assert pilot.command(unknown, 1) == UNSUPPORTED
    for known in (mavlink.MAV_CMD_GET_HOME_POSITION, mavlink.MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES):
        assert pilot.command(known, 1) == ACCEPTED
    assert pilot.texts == []  # none of them is reported to the pilot


def test_a_plant_port_in_use_is_one_clear_error(mimopilot):
    with listen("127.0.0.1", 0) as taken:
        port = taken.getsockname()[1]
        free = ("--ground-port", free_port(socket.SOCK_DGRAM), "--vehicle-port", 0, "--tcp-port", 0)
        in_use = mimopilot("sitl", "adam0", "--port", port, *free)
        assert_one_clear_line(in_use, f"TCP port {port}", "--port")
        assert_one_clear_line(mimopilot("plant", "adam0", "--port", port), f"TCP port {port}")


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--speed", "fast"), ("--speed fast", "or max")),
        (("--speed", "nan"), ("--speed nan",)),
        (("--plant", "here"), ("--plant here", "HOST:PORT")),
        (("--plant", "127.0.0.1:4560", "--speed", "max"), ("--speed", "belong to the plant")),
        (("--scenario", "spin"), ("scenario: got 'spin'",)),
        (("--log", "."), ("--log .", "cannot be written")),
    ],
)
def test_mistakes_are_one_clear_error(mimopilot, arguments, words):
    links = ("--ground-port", free_port(socket.SOCK_DGRAM), "--vehicle-port", 0, "--tcp-port", 0)
    assert_one_clear_line(mimopilot("sitl", "adam0", *links, *arguments), *words)
