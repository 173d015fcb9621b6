"""Faults injected over MAVLink: the same flights as in one process."""

import math
from dataclasses import replace

import numpy as np
import pytest

from mimopilot.codegen.native import NativeController, load_native
from mimopilot.sitl.autopilot.autopilot import Autopilot
from mimopilot.sitl.autopilot.setpoints import AttitudeSetpoint
from mimopilot.sitl.faults.inject_autopilot import AutopilotFaults
from mimopilot.sitl.faults.kinds import parse_fault
from mimopilot.sitl.flight.scenario import doublet, hover
from mimopilot.sitl.flight.simulator import fly
from mimopilot.sitl.mavlink.simulator_api import lockstep
from mimopilot.sitl.mavlink.simulator_api.plant_link import PlantState
from mimopilot.sitl.mavlink.simulator_api.plant_process import plant_process
from mimopilot.sitl.mavlink.vehicle.host import Host
from mimopilot.sitl.physics.airframe import load_airframe
from tests.conftest import assert_one_clear_line

TS = 0.004


@pytest.fixture(scope="module")
def vehicle():
    return load_airframe("adam0")


@pytest.fixture(scope="module")
def library(vehicle):
    return load_native(vehicle.default_gains())


def pilot(vehicle, library, gains=None):
    gains = gains or vehicle.default_gains()
    return Autopilot(vehicle.airframe, gains, NativeController(library, gains))


def over_both(vehicle, library, scenario, *texts, seed=3, gains=None):
    """The same flight in process and over MAVLink."""
    faults = tuple(map(parse_fault, texts))
    flight = fly(vehicle.airframe, pilot(vehicle, library, gains), replace(scenario, faults=faults), seed)
    with plant_process("adam0", 0, TS, seed, None, faults=faults) as port:
        return flight, lockstep.fly(pilot(vehicle, library, gains), scenario, port)


def test_a_flight_with_component_faults_and_delays_over_mavlink_equals_the_one_in_process(vehicle, library):
    texts = (
        *("motor:3=0.8@1.1", "battery=0.9@0.5+0.4", "mass:0.1,-0.1,0=0.1@1.3", "delay=0.012@1.05", "jitter=0.008@1.2"),
        *("gyro-bias:roll=0.1@0.9", "gyro-noise=0.05@1.0+0.3", "gyro-stuck:pitch@1.15+0.05", "gyro-nan@1.5+0.02"),
    )
    flight, record = over_both(vehicle, library, doublet("roll", 0.3, 0.42, TS), *texts)
    assert np.isnan(record["rates"]).any()
    assert record.tobytes() == flight.record.tobytes()


def test_a_flight_with_model_following_over_mavlink_equals_the_one_in_process(vehicle, library):
    plain = vehicle.default_gains()
    gains = replace(plain, filters=replace(plain.filters, model_omega=12.0), Kff_o=np.eye(2), Kaff_i=0.006 * np.eye(2))
    flight, record = over_both(vehicle, library, doublet("roll", 0.3, 0.42, TS), gains=gains)
    assert record.tobytes() == flight.record.tobytes()
    other = fly(vehicle.airframe, pilot(vehicle, library), doublet("roll", 0.3, 0.42, TS), 3)
    assert np.abs(flight.record["attitude"] - other.record["attitude"])[:, 0].max() > 0.02


def test_the_link_loses_the_same_periods_over_mavlink(vehicle, library):
    texts = ("loss=0.3@0.2+0.3", "skip=5@0.8", "link@1.0+0.2", "clock=0.1@1.5")
    flight, record = over_both(vehicle, library, hover("roll", 2.0, TS), *texts)
    seen = flight.record[flight.runs == 1]
    assert 500 - len(seen) == pytest.approx(0.3 * 75 + 5 + 50 + 25, abs=15)
    assert record[: len(seen)].tobytes() == seen.tobytes()


def test_duplicated_messages_are_flown_once(vehicle, library):
    flight, record = over_both(vehicle, library, hover("roll", 1.0, TS), "duplicate=0.5@0")
    assert (flight.runs == 2).any()
    healthy = fly(vehicle.airframe, pilot(vehicle, library), hover("roll", 1.0, TS), 3)
    assert record.tobytes() == healthy.record.tobytes()


def test_the_plant_refuses_faults_it_cannot_inject_before_it_listens(mimopilot):
    assert_one_clear_line(mimopilot("plant", "adam0", "--port", 0, "--fault", "gain=2@1"), "'gain=2@1'", "autopilot")
    assert_one_clear_line(mimopilot("plant", "adam0", "--port", 0, "--fault", "motor:5=0@1"), "motors 1 to 4")


@pytest.mark.parametrize(
    ("arguments", "parts"),
    [
        (("--plant", "127.0.0.1:1", "--fault", "loss=0.1@1"), ("'loss=0.1@1'", "give it to that command")),
        (("--fault", "gain:Kp_o=100@1"), ("MIMO_AP_RR would be 650", "a vehicle refuses that write")),
    ],
)
def test_the_vehicle_refuses_faults_it_cannot_inject_before_it_flies(mimopilot, arguments, parts):
    assert_one_clear_line(mimopilot("sitl", "adam0", *arguments), *parts)


class NoPlantLink:
    """Replaces the plant link: discards the answers."""

    socket = None

    def answer(self, stamp, commands, armed):
        pass


def test_a_controller_fault_during_the_pre_arm_check_is_not_reported_as_a_wrong_period(vehicle, library):
    host = Host(pilot(vehicle, library), NoPlantLink())
    for k in range(1001):
        rate = math.nan if 450 <= k <= 520 else 0.0
        host._period(PlantState(7_000_000 + 4000 * k, 1, 0, 0, 0, rate, *[0.0] * 4, 10_000, *[0] * 8))
    texts = [text for _, text in host.vehicle.said]
    assert any("the controller rejects its inputs" in text for text in texts)
    assert not any("period" in text for text in texts)


def test_the_host_injects_gain_faults_and_stale_setpoints_at_their_times(vehicle, library):
    autopilot = pilot(vehicle, library)
    controller = autopilot.controller
    faults = AutopilotFaults(tuple(map(parse_fault, ("gain:Kp_i=0.5@0.2+0.4", "stale@0.4+0.8"))), TS, autopilot)
    host = Host(autopilot, NoPlantLink())
    host.faults = faults
    healthy, Kp_i, fresh = controller.state["gains"][0].copy(), slice(4, 8), []
    for k in range(400):
        host._period(PlantState(7_000_000 + 4000 * k, 1, 0, 0, 0, *[0.0] * 5, 10_000, *[0] * 8))
        factor = 0.5 if 50 <= k < 150 else 1.0
        assert (controller.state["gains"][0, Kp_i] == np.float32(factor) * healthy[Kp_i]).all(), k
        fresh.append(host.vehicle.attitude.fresh(host.vehicle.now))
        host.vehicle.attitude.put(AttitudeSetpoint(0.1, 0.0, 0.0, None), host.vehicle.now)
    # The setpoint of sample 99 is valid for half a second; the next received one comes after sample 300.
    assert np.flatnonzero(~np.array(fresh)).tolist() == [0, *range(225, 301)]
    assert (controller.state["gains"][0] == healthy).all()
