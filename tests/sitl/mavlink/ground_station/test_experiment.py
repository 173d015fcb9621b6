"""The experiment on a flying vehicle: checks before, monitoring during, and restoring after it."""

import re
import signal
from dataclasses import replace

import numpy as np
import pytest

from mimopilot.sitl.autopilot.excitation_injector import AXIS
from mimopilot.sitl.errors import SitlError
from mimopilot.sitl.mavlink.ground_station.events import SetParameter, run_exchange
from mimopilot.sitl.mavlink.ground_station.experiments.experiment_profile import ExcitationOptions
from mimopilot.sitl.mavlink.ground_station.experiments.module_injector import INTEGERS, excite, start_monitor
from mimopilot.sitl.mavlink.ground_station.experiments.module_profile import injector_settings
from mimopilot.sitl.mavlink.ground_station.parameter_protocol import ParameterClient
from mimopilot.tuning.logs.reader import read_log
from tests.conftest import assert_one_clear_line
from tests.sitl.mavlink.flying_vehicle import FlyingVehicle
from tests.sitl.mavlink.running import PATIENCE_S, Pilot, running_sitl, start
from tests.sitl.mavlink.scripted_vehicle import SimulatedLink

CHOICE = ExcitationOptions("both", 8.0, 0.2, 50.0, 3, "hold", 25.0)
WANTED = injector_settings(CHOICE, 0.004)
PLANNED = 2 * 8.0 + 1.0


def experiment(vehicle, interrupt_at=None, wanted=WANTED, **link):
    carrier = SimulatedLink(vehicle, **link)
    client = ParameterClient(carrier.now(), integers=INTEGERS, force_armed=True)
    if interrupt_at is not None:
        vehicle.then[interrupt_at] = lambda _: setattr(client, "interrupted", True)
    run_exchange(client.await_heartbeat(), carrier)
    monitor = run_exchange(start_monitor(client, 4), carrier)
    return run_exchange(excite(client, monitor, wanted), carrier), carrier


def end_of_injection(vehicle):
    """Time (s) at which the injection ended."""
    return 0.02 * (1 + max(np.flatnonzero(np.any(vehicle.moments, axis=1)), default=-1))


@pytest.mark.parametrize("integers", [False, True], ids=["floats", "integers as on a PX4"])
@pytest.mark.parametrize("loss", [0.0, 0.3])
def test_a_complete_experiment_restores_all_settings(integers, loss):
    vehicle = FlyingVehicle(integers)
    before = dict(vehicle.settings)
    result, _ = experiment(vehicle, loss=loss)
    assert (result.complete, result.reason, result.stopped, result.restored) == (True, "", True, True)
    # Measured from messages at 10 Hz, which may be lost.
    assert result.seconds == pytest.approx(PLANNED, abs=1.5 if loss else 0.2)
    moments = np.array(vehicle.moments)
    assert [np.abs(moments[:, axis]).max() for axis in (0, 1, 2)] == pytest.approx([0.2, 0.2, 0.0])
    assert [np.count_nonzero(moments[:, axis]) for axis in (0, 1)] == [400, 400]
    assert (vehicle.settings, vehicle.values[AXIS]) == (before, 0.0)
    assert vehicle.stored == 0  # the settings are for this flight only


def test_all_three_axes_are_excited_one_after_the_other():
    vehicle = FlyingVehicle()
    wanted = injector_settings(replace(CHOICE, axis="all", yaw_amplitude=0.3), 0.004)
    result, _ = experiment(vehicle, wanted=wanted)
    assert (result.complete, result.restored) == (True, True)
    assert result.seconds == pytest.approx(3 * 8.0 + 2 * 1.0, abs=0.3)  # messages at 10 Hz
    moments = np.array(vehicle.moments)
    assert np.abs(moments).max(axis=0) == pytest.approx([0.2, 0.2, 0.3])
    assert np.count_nonzero(moments, axis=0).tolist() == [400, 400, 400]
    assert (np.count_nonzero(moments, axis=1) <= 1).all()


def change(**attributes):
    def happen(vehicle):
        for name, value in attributes.items():
            setattr(vehicle, name, value)

    return happen


@pytest.mark.parametrize("careless", [False, True], ids=["monitored by both", "monitored by the ground station alone"])
@pytest.mark.parametrize(
    ("event", "parts"),
    [
        (change(mode=3 << 16), "the vehicle left its mode|stopped: mode left"),
        (change(armed=False), "the vehicle was disarmed|stopped: mode left"),
        (change(landed=1), "on the ground"),
        (change(tilt=0.44), "tilts by 25 degrees|stopped: tilt"),
        (change(silent={"HEARTBEAT"}), "no HEARTBEAT for 5 s"),
        (change(silent={30}), "no longer sends ATTITUDE"),
        (change(silent={250}), "no longer sends DEBUG_VECT"),
    ],
)
def test_an_unsafe_event_stops_the_experiment_and_all_settings_are_restored(event, parts, careless):
    at = 6.0
    vehicle = FlyingVehicle(then={at: event}, careless=careless)
    before = dict(vehicle.settings)
    result, _ = experiment(vehicle)
    assert not result.complete
    assert re.search(parts, result.reason), result.reason
    assert (result.stopped, result.restored) == (True, True)
    assert at - 0.1 < end_of_injection(vehicle) < at + 6.5
    assert (vehicle.settings, vehicle.values[AXIS]) == (before, 0.0)


def test_ctrl_c_stops_the_injection_first():
    vehicle = FlyingVehicle()
    before = dict(vehicle.settings)
    result, link = experiment(vehicle, interrupt_at=5.0)
    assert (result.complete, result.reason, result.stopped, result.restored) == (False, "interrupted", True, True)
    assert end_of_injection(vehicle) < 5.5
    first = next(message for at, message in link.log if at >= 5.0 and isinstance(message, SetParameter))
    assert (first.name, first.value) == (AXIS, 0.0)
    assert vehicle.settings == before


def test_after_a_link_loss_the_vehicle_stops_by_itself_and_the_loss_is_reported():
    vehicle = FlyingVehicle()
    link = SimulatedLink(vehicle)
    vehicle.then[5.0] = lambda _: setattr(link, "up", False)
    client = ParameterClient(link.now(), integers=INTEGERS, force_armed=True)
    run_exchange(client.await_heartbeat(), link)
    result = run_exchange(excite(client, run_exchange(start_monitor(client, 4), link), WANTED), link)
    assert (result.complete, result.stopped, result.restored) == (False, False, False)
    assert not vehicle.exciting


@pytest.mark.parametrize(
    ("vehicle", "parts"),
    [
        ({"armed": False}, "not armed"),
        ({"landed": 1}, "on the ground"),
        ({"mode": 3 << 16}, "another mode"),
        ({"tilt": 0.4}, "tilts by 23 degrees"),
        ({"silent": {250}}, "our controller does not fly it"),
        ({"silent": {30, 245}}, "does not send ATTITUDE, EXTENDED_SYS_STATE"),
    ],
)
def test_nothing_is_written_unless_the_vehicle_hovers_under_our_controller(vehicle, parts):
    flying = FlyingVehicle()
    change(**vehicle)(flying)
    with pytest.raises(SitlError, match=parts):
        experiment(flying)
    assert flying.writes == 0


def test_restoring_does_not_start_a_run_left_over_in_the_parameters():
    vehicle = FlyingVehicle(**{AXIS: 3.0})
    result, _ = experiment(vehicle)
    assert (result.complete, result.restored) == (True, True)
    assert vehicle.values[AXIS] == 0.0
    assert len(np.flatnonzero(np.any(vehicle.moments, axis=1))) == 800


def test_the_injection_is_not_started_if_a_setting_is_refused():
    vehicle = FlyingVehicle()
    vehicle.fault, vehicle.faulty = "out of range", "MIMO_EX_AMP"
    before = dict(vehicle.settings)
    result, _ = experiment(vehicle)
    assert (result.complete, result.restored) == (False, True)
    assert "MIMO_EX_AMP" in result.reason
    assert (end_of_injection(vehicle), vehicle.settings) == (0.0, before)


@pytest.mark.parametrize(
    ("change", "parts"),
    [
        ({"axis": "x"}, "--axis: got 'x'"),
        ({"yaw_amplitude": 0.6}, "MIMO_EX_AMPY: got 0.6"),
        ({"mode": "acro"}, "--mode: got 'acro'"),
        ({"amplitude": 0.6}, "MIMO_EX_AMP: got 0.6"),
        ({"amplitude": float("nan")}, "MIMO_EX_AMP: got nan"),
        ({"seconds_per_axis": 1000.0}, "MIMO_EX_DUR"),
        ({"tilt_deg": 80.0}, "MIMO_EX_TILT"),
    ],
)
def test_settings_out_of_range_are_refused_before_sending(change, parts):
    with pytest.raises(SitlError, match=parts):
        injector_settings(ExcitationOptions(**{**vars(CHOICE), **change}), 0.004)


# The commands, against `mimopilot sitl`.


def hovering_pilot(sitl):
    pilot = Pilot(f"udpin:127.0.0.1:{sitl.udp}")
    pilot.ready()
    assert pilot.command(400, 1) == 0
    assert pilot.command(22, 0, 0, 0, 0, 0, 0, 5) == 0
    pilot.hears("mode hold")
    return pilot


def test_an_experiment_over_mavlink_produces_a_log_for_tuning(tmp_path, mimopilot):
    log = tmp_path / "flight.ulg"
    with running_sitl("--speed", "4", "--log", log) as sitl:
        pilot = hovering_pilot(sitl)
        link = ("--connect", f"tcp:127.0.0.1:{sitl.tcp}", "--yes")
        done = mimopilot("experiment", *link, "--seconds-per-axis", 9)
        assert done.returncode == 0, done.stderr
        assert "mimopilot tune LOG" in done.stdout
        wrong = mimopilot("experiment", *link, "--mode", "position")
        assert_one_clear_line(wrong, "another mode", code=1)
        assert pilot.command(21) == 0
        pilot.hears("logged: flight.ulg")
        fetched = mimopilot("logs", "--last", *link[:2], "--out", "logs")
        assert "flight.ulg: " in fetched.stdout, fetched.stderr
        assert (tmp_path / "logs" / "flight.ulg").read_bytes() == log.read_bytes()
        pilot.close()
    flown = read_log(log)
    excited = [np.flatnonzero(signal) for signal in (*flown.u_bar.T, flown.yaw.u_bar)]
    assert [len(samples) * flown.Ts for samples in excited] == pytest.approx([9.0, 9.0, 9.0])
    assert excited[2][0] - excited[1][-1] == 251  # 1 s pause
    assert flown.yaw.segments == ((excited[2][0], len(flown.u)),)
    assert flown.Ts == 0.004
    tuned = mimopilot("tune", log, "--inner", "30,0.7,0", "--outer", "10,0.7,0", "--out", tmp_path / "g.gains.toml")
    assert tuned.returncode == 0, tuned.stderr
    assert "certified" in tuned.stdout


def test_ctrl_c_in_the_client_restores_the_settings_and_the_vehicle_hovers_on():
    with running_sitl() as sitl:
        pilot = hovering_pilot(sitl)
        client = start("experiment", "--connect", f"tcp:127.0.0.1:{sitl.tcp}", "--yes")
        pilot.hears("excitation: roll")
        client.process.send_signal(signal.SIGINT)
        pilot.hears("excitation cancelled")
        assert client.process.wait(timeout=PATIENCE_S) == 1
        client.until("interrupted")
        client.end()
        pilot.link.mav.param_request_list_send(1, 1)
        values = {}
        while len(values) < 48:
            message = pilot.asks("PARAM_VALUE")
            values[message.param_id] = message.param_value
        assert values["MIMO_EX_AMP"] == pytest.approx(0.1)
        assert values["MIMO_EX_DUR"] == 16.0
        assert pilot.armed()
        pilot.close()
