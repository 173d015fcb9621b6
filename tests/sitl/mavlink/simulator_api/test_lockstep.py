"""A scenario flown by two processes in lockstep over PX4's simulator API."""

import socket
import threading
import time

import pytest
from pymavlink.dialects.v20 import common as mavlink

from mimopilot.sitl.autopilot.autopilot import Autopilot
from mimopilot.sitl.errors import SitlError
from mimopilot.sitl.flight.scenario import doublet
from mimopilot.sitl.flight.simulator import fly
from mimopilot.sitl.mavlink.simulator_api import lockstep
from mimopilot.sitl.mavlink.simulator_api.plant_process import plant_process
from mimopilot.sitl.mavlink.wire.codec import Codec
from mimopilot.sitl.mavlink.wire.sockets import listen
from mimopilot.sitl.physics.airframe import load_airframe
from tests.sitl.mavlink.running import PATIENCE_S

TS = 0.004


@pytest.fixture(scope="module")
def vehicle():
    return load_airframe("adam0")


@pytest.mark.parametrize("late", [0.0, 1.0])
def test_a_flight_over_mavlink_equals_the_one_in_process_even_when_the_autopilot_starts_late(vehicle, late):
    gains = vehicle.default_gains()
    scenario = doublet("roll", 0.39, 0.42, TS, tail=0.5)
    in_process = fly(vehicle.airframe, Autopilot(vehicle.airframe, gains), scenario, seed=5)
    with plant_process("adam0", 0, TS, 5, None) as port:
        time.sleep(late)
        record = lockstep.fly(Autopilot(vehicle.airframe, gains), scenario, port)
    assert record.tobytes() == in_process.record.tobytes()


def test_the_plant_repeats_its_first_frame_until_it_is_answered_and_then_keeps_lockstep():
    with plant_process("adam0", 0, TS, 0, None) as port, socket.create_connection(("127.0.0.1", port)) as link:
        link.settimeout(PATIENCE_S)
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


def test_a_plant_that_disconnects_is_an_error_that_names_the_period(vehicle):
    server = listen("127.0.0.1", 0)

    def leave():
        connection, _ = server.accept()
        connection.close()

    thread = threading.Thread(target=leave)
    thread.start()
    scenario = doublet("roll", 0.39, 0.42, TS)
    with pytest.raises(SitlError, match="disconnected after 0 of"):
        lockstep.fly(Autopilot(vehicle.airframe, vehicle.default_gains()), scenario, server.getsockname()[1])
    thread.join()
    server.close()
