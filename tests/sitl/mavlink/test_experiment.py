"""The experiment on a vehicle in the air: what is checked before, watched on the way, and put back after."""

import re
import signal
import struct

import numpy as np
import pytest
from mimopilot.sitl.autopilot.excitation_injector import AXIS
from mimopilot.sitl.errors import SitlError
from mimopilot.sitl.mavlink.ground_station.connection import express, understand
from mimopilot.sitl.mavlink.ground_station.events import Value, Write, drive
from mimopilot.sitl.mavlink.ground_station.experiment import INTEGERS, excite, observe
from mimopilot.sitl.mavlink.ground_station.experiment_console import Choice, settings
from mimopilot.sitl.mavlink.ground_station.parameter_protocol import Conversation
from mimopilot.sitl.mavlink.wire.codec import Codec
from mimopilot.tuning.logs.reader import read_log
from pymavlink.dialects.v20 import common as mavlink

from tests.conftest import assert_one_clear_line
from tests.sitl.mavlink.flying_vehicle import FlyingVehicle
from tests.sitl.mavlink.running import PATIENCE_S, Pilot, running_sitl, start
from tests.sitl.mavlink.scripted_vehicle import SimulatedLink

CHOICE = Choice("both", 8.0, 0.2, 50.0, 3, "hold", 25.0)
WANTED = settings(CHOICE, 0.004)
PLANNED = 2 * 8.0 + 1.0


def experiment(vehicle, interrupt_at=None, **link):
    carrier = SimulatedLink(vehicle, **link)
    talk = Conversation(carrier.now(), integers=INTEGERS, force_armed=True)
    if interrupt_at is not None:
        vehicle.then[interrupt_at] = lambda _: setattr(talk, "interrupted", True)
    drive(talk.meet(), carrier)
    sights = drive(observe(talk, 4), carrier)
    return drive(excite(talk, sights, WANTED), carrier), carrier


def end_of_moments(vehicle):
    """Time (s) of the last moment."""
    return 0.02 * (1 + max(np.flatnonzero(np.any(vehicle.moments, axis=1)), default=-1))


@pytest.mark.parametrize("integers", [False, True], ids=["floats", "integers as on a PX4"])
@pytest.mark.parametrize("loss", [0.0, 0.3])
def test_the_whole_experiment_is_flown_and_all_is_put_back(integers, loss):
    vehicle = FlyingVehicle(integers)
    before = dict(vehicle.settings)
    result, _ = experiment(vehicle, loss=loss)
    assert (result.complete, result.reason, result.stopped, result.restored) == (True, "", True, True)
    # As it was told ten times a second, by messages that may be lost.
    assert result.seconds == pytest.approx(PLANNED, abs=1.5 if loss else 0.2)
    moments = np.array(vehicle.moments)
    assert [np.abs(moments[:, axis]).max() for axis in (0, 1, 2)] == pytest.approx([0.2, 0.2, 0.0])
    assert [np.count_nonzero(moments[:, axis]) for axis in (0, 1)] == [400, 400]
    assert (vehicle.settings, vehicle.values[AXIS]) == (before, 0.0)
    assert vehicle.stored == 0  # nothing of this is meant to outlast the flight


def change(**attributes):
    def happen(vehicle):
        for name, value in attributes.items():
            setattr(vehicle, name, value)

    return happen


@pytest.mark.parametrize("careless", [False, True], ids=["watched by both", "watched by us alone"])
@pytest.mark.parametrize(
    ("happens", "words"),
    [
        (change(mode=3 << 16), "the vehicle left its mode|stopped: mode left"),
        (change(armed=False), "the vehicle was disarmed|stopped: mode left"),
        (change(landed=1), "on the ground"),
        (change(tilt=0.44), "tilts by 25 degrees|stopped: tilt"),
        (change(silent={"HEARTBEAT"}), "no HEARTBEAT for 5 s"),
        (change(silent={30}), "does not tell ATTITUDE any more"),
        (change(silent={250}), "does not tell DEBUG_VECT any more"),
    ],
)
def test_whatever_happens_on_the_way_ends_it_soon_and_all_is_put_back(happens, words, careless):
    at = 6.0
    vehicle = FlyingVehicle(then={at: happens}, careless=careless)
    before = dict(vehicle.settings)
    result, _ = experiment(vehicle)
    assert not result.complete
    assert re.search(words, result.reason), result.reason
    assert (result.stopped, result.restored) == (True, True)
    assert at - 0.1 < end_of_moments(vehicle) < at + 6.5
    assert (vehicle.settings, vehicle.values[AXIS]) == (before, 0.0)


def test_ctrl_c_stops_the_injection_before_anything_else():
    vehicle = FlyingVehicle()
    before = dict(vehicle.settings)
    result, link = experiment(vehicle, interrupt_at=5.0)
    assert (result.complete, result.reason, result.stopped, result.restored) == (False, "interrupted", True, True)
    assert end_of_moments(vehicle) < 5.5
    first = next(message for at, message in link.log if at >= 5.0 and isinstance(message, Write))
    assert (first.name, first.value) == (AXIS, 0.0)
    assert vehicle.settings == before


def test_a_vehicle_that_cannot_be_reached_any_more_is_told_and_stops_by_itself():
    vehicle = FlyingVehicle()
    link = SimulatedLink(vehicle)
    vehicle.then[5.0] = lambda _: setattr(link, "up", False)
    talk = Conversation(link.now(), integers=INTEGERS, force_armed=True)
    drive(talk.meet(), link)
    result = drive(excite(talk, drive(observe(talk, 4), link), WANTED), link)
    assert (result.complete, result.stopped, result.restored) == (False, False, False)
    assert not vehicle.exciting


@pytest.mark.parametrize(
    ("vehicle", "words"),
    [
        ({"armed": False}, "not armed"),
        ({"landed": 1}, "on the ground"),
        ({"mode": 3 << 16}, "another mode"),
        ({"tilt": 0.4}, "tilts by 23 degrees"),
        ({"silent": {250}}, "our controller does not fly it"),
        ({"silent": {30, 245}}, "does not tell ATTITUDE, EXTENDED_SYS_STATE"),
    ],
)
def test_a_vehicle_that_does_not_hover_under_our_controller_is_left_alone(vehicle, words):
    flying = FlyingVehicle()
    change(**vehicle)(flying)
    with pytest.raises(SitlError, match=words):
        experiment(flying)
    assert flying.writes == 0


def test_a_run_that_was_left_in_the_parameters_is_not_started_by_putting_them_back():
    vehicle = FlyingVehicle(**{AXIS: 3.0})
    result, _ = experiment(vehicle)
    assert (result.complete, result.restored) == (True, True)
    assert vehicle.values[AXIS] == 0.0
    assert len(np.flatnonzero(np.any(vehicle.moments, axis=1))) == 800


def test_a_vehicle_that_refuses_a_setting_is_not_started():
    vehicle = FlyingVehicle()
    vehicle.fault, vehicle.victim = "out of range", "MIMO_EX_AMP"
    before = dict(vehicle.settings)
    result, _ = experiment(vehicle)
    assert (result.complete, result.restored) == (False, True)
    assert "MIMO_EX_AMP" in result.reason
    assert (end_of_moments(vehicle), vehicle.settings) == (0.0, before)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"axis": "yaw"}, "--axis: got 'yaw'"),
        ({"mode": "acro"}, "--mode: got 'acro'"),
        ({"amplitude": 0.6}, "MIMO_EX_AMP: got 0.6"),
        ({"amplitude": float("nan")}, "finite"),
        ({"seconds_per_axis": 1000.0}, "MIMO_EX_DUR"),
        ({"tilt_deg": 80.0}, "MIMO_EX_TILT"),
    ],
)
def test_settings_out_of_range_are_refused_before_anything_is_sent(change, words):
    with pytest.raises(SitlError, match=words):
        settings(Choice(**{**vars(CHOICE), **change}), 0.004)


@pytest.mark.parametrize("number", [0, 1, 60, 1000000, -1, -(2**31), 2**31 - 1])
def test_whole_numbers_keep_their_bits_on_the_wire(number):
    codec = Codec()
    (sent,) = codec.parse(codec.pack(express(Write(1, 1, "MIMO_EX_HMIN", float(number), 6))))
    assert struct.pack("<f", sent.param_value) == struct.pack("<i", number)
    echo = mavlink.MAVLink_param_value_message(b"MIMO_EX_HMIN", sent.param_value, 6, 1, 0)
    (heard,) = codec.parse(codec.pack(echo))
    assert understand(heard) == Value(1, 1, "MIMO_EX_HMIN", number, 6)


# The commands, on `mimopilot sitl`.


def in_the_air(sitl):
    pilot = Pilot(f"udpin:127.0.0.1:{sitl.udp}")
    pilot.ready()
    assert pilot.command(400, 1) == 0
    assert pilot.command(22, 0, 0, 0, 0, 0, 0, 5) == 0
    pilot.hears("mode hold")
    return pilot


def test_an_experiment_over_mavlink_gives_a_log_to_tune_from(tmp_path, mimopilot):
    log = tmp_path / "flight.ulg"
    with running_sitl("--speed", "4", "--log", log) as sitl:
        pilot = in_the_air(sitl)
        link = ("--connect", f"tcp:127.0.0.1:{sitl.tcp}", "--yes")
        done = mimopilot("experiment", *link, "--seconds-per-axis", 12)
        assert done.returncode == 0, done.stderr
        assert "mimopilot tune LOG" in done.stdout
        wrong = mimopilot("experiment", *link, "--mode", "position")
        assert_one_clear_line(wrong, "another mode", code=1)
        assert pilot.command(21) == 0
        pilot.hears("logged: flight.ulg")
        pilot.close()
    flown = read_log(log)
    excited = [np.flatnonzero(flown.u_bar[:, axis]) for axis in (0, 1)]
    assert [len(samples) * flown.Ts for samples in excited] == pytest.approx([12.0, 12.0])
    assert flown.Ts == 0.004
    tuned = mimopilot("tune", log, "--inner", "30,0.7,0", "--outer", "10,0.7,0", "--out", tmp_path / "g.gains.toml")
    assert tuned.returncode == 0, tuned.stderr
    assert "certified" in tuned.stdout


def test_ctrl_c_in_the_client_leaves_the_vehicle_hovering_as_it_was():
    with running_sitl() as sitl:
        pilot = in_the_air(sitl)
        client = start("experiment", "--connect", f"tcp:127.0.0.1:{sitl.tcp}", "--yes")
        pilot.hears("excitation: roll")
        client.process.send_signal(signal.SIGINT)
        pilot.hears("excitation cancelled")
        assert client.process.wait(timeout=PATIENCE_S) == 1
        client.until("interrupted")
        client.end()
        pilot.link.mav.param_request_list_send(1, 1)
        values = {}
        while len(values) < 47:
            message = pilot.asks("PARAM_VALUE")
            values[message.param_id] = message.param_value
        assert values["MIMO_EX_AMP"] == pytest.approx(0.1)
        assert values["MIMO_EX_DUR"] == 16.0
        assert pilot.armed()
        pilot.close()
