"""The autopilot host with a faulty plant: one that stops sending, restarts, or sends invalid values."""

import math
import socket
import threading
import time
from contextlib import suppress

import pytest
from pymavlink.dialects.v20 import common as mavlink

from mimopilot.sitl.mavlink.wire.fast_codec import ACTUATORS, STATE, FastCodec
from tests.sitl.mavlink.running import Pilot, running_sitl

TS_US = 4000


class FakePlant:
    """Sends frames of a vehicle at rest, in real time, and keeps the answers."""

    def __init__(self):
        self.server = socket.create_server(("127.0.0.1", 0))
        self.port = self.server.getsockname()[1]
        self.stamp, self.step = 10_000_000, TS_US
        self.silent = self.invalid = self.over = False
        self.answers = []
        self.thread = threading.Thread(target=self._run)
        self.thread.start()

    def _run(self):
        link, _ = self.server.accept()
        codec = FastCodec(1, 1)
        with link, suppress(OSError):
            while not self.over:
                time.sleep(0.004)
                if self.silent:
                    continue
                self.stamp += self.step
                attitude = (math.nan,) * 4 if self.invalid else (1.0, 0.0, 0.0, 0.0)
                link.sendall(codec.pack(STATE, self.stamp, *attitude, *[0.0] * 3, 473977420, 85455940, 0, *[0] * 8))
                found = codec.parse(link.recv(65536))
                self.answers += [fields for kind, fields in found if kind is ACTUATORS]

    def close(self):
        self.over = True
        self.thread.join()
        self.server.close()


@pytest.fixture
def plant_and_pilot(request):
    plant = FakePlant()
    request.addfinalizer(plant.close)
    with running_sitl("--plant", f"127.0.0.1:{plant.port}") as sitl:
        pilot = Pilot(f"udpin:127.0.0.1:{sitl.udp}")
        pilot.ready()
        yield plant, pilot
        pilot.close()


def test_plant_faults_are_reported_and_flight_resumes_afterwards(plant_and_pilot):
    plant, pilot = plant_and_pilot

    def refused(reason):
        pilot.texts.clear()
        assert pilot.command(400, 1) == mavlink.MAV_RESULT_TEMPORARILY_REJECTED
        pilot.hears(reason)

    # It stops sending: the flight pauses, and resumes with it.
    assert pilot.command(400, 1) == mavlink.MAV_RESULT_ACCEPTED
    pilot.wait(pilot.armed)
    plant.silent = True
    pilot.hears("no frame from the plant for 0.9 s")
    plant.silent = False
    pilot.hears("the plant sends frames again")
    assert pilot.armed()
    # Each frame is answered with its own time; the rotors of an armed vehicle on the ground idle.
    pilot.wait(lambda: plant.answers[-1][-1] == 128)
    stamp, _, *controls, _ = plant.answers[-1]
    assert 0 <= plant.stamp - stamp < 10 * TS_US
    assert 0 < max(controls[:4]) < 0.2
    assert max(controls[4:]) == 0.0

    # Its clock goes back a little: frames are answered, not flown. Far: the plant has restarted.
    plant.stamp -= 100_000
    time.sleep(0.1)
    assert pilot.armed()
    pilot.texts.clear()
    plant.stamp = 1_000_000
    pilot.hears("the plant has restarted")
    pilot.hears("plant connected")
    pilot.wait(lambda: not pilot.armed())

    # Its attitude is not finite: the motor commands stay finite.
    pilot.ready()
    plant.answers.clear()
    plant.invalid = True
    pilot.hears("the controller rejects its inputs")
    refused("the controller rejects its inputs")
    assert all(math.isfinite(value) for answer in plant.answers for value in answer[2:18])
    plant.invalid = False
    pilot.ready()

    # Its period differs from the one the gains are for.
    plant.step = 5000
    pilot.hears("ms, the gains are for 4 ms")
    reason = "not armed: the plant's period is 5 ms, the gains are for 4 ms"
    pilot.wait(lambda: pilot.command(400, 1) and reason in pilot.texts)
