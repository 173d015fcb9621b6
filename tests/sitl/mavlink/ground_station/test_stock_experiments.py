"""Experiments on stock firmware: prepared, rebooted, watched, stopped, and all parameters back."""

import re

import pytest

from mimopilot.sitl.errors import SitlError
from mimopilot.sitl.mavlink.ground_station.events import SendCommand, StatusText
from mimopilot.sitl.mavlink.ground_station.experiments.experiment_profile import ExcitationOptions
from mimopilot.sitl.mavlink.ground_station.experiments.experiments_by_name import experiment_profile
from mimopilot.sitl.mavlink.ground_station.flight_monitor import FlightMonitor
from mimopilot.sitl.mavlink.ground_station.profiles import make_restore_plan
from mimopilot.sitl.mavlink.ground_station.vehicle_link_state import VehicleLinkState
from mimopilot.sitl.mavlink.wire.parameter_files import parameter_text, read_parameters
from mimopilot.tuning.experiment import external_signal
from mimopilot.tuning.logs.reader import read_log
from tests.sitl.mavlink.flying_vehicle import FlyingVehicle
from tests.sitl.mavlink.running import Pilot, running_sitl, start
from tests.sitl.mavlink.stock_vehicles import HOLD, SimulatedSession, StockCopter, StockPx4

PREPARED = {"MC_AT_EN": 1, "MC_AT_APPLY": 0, "SDLOG_PROFILE": 17}


def profile_of(name, vehicle, **options):
    """The profile, and what it has saved; nothing has been written when it saves for the first time."""
    saved = []

    def save(values):
        assert saved or vehicle.writes == 0
        saved.append(dict(values))

    chosen = {"axis": None, "seconds_per_axis": 12.0, "amplitude": None, "bandwidth": 50.0, "seed": 0}
    chosen |= {"mode": "hold", "tilt_deg": 28.0}
    return experiment_profile(name, ExcitationOptions(**chosen | options), save), saved


def flying(vehicle, name, link=None, **options):
    """A session with a vehicle in the air, and the profile after its check."""
    vehicle.take_off()
    profile, _ = profile_of(name, vehicle, **options)
    session = SimulatedSession(vehicle, profile.integers, **(link or {}))
    return session, profile, profile.check(session)


@pytest.mark.parametrize("loss", [0.0, 0.3])
def test_a_stock_px4_is_prepared_rebooted_excited_and_restored(loss):
    vehicle = StockPx4()
    profile, saved = profile_of("px4-stock", vehicle, runs=2)
    session = SimulatedSession(vehicle, profile.integers, loss=loss)
    done = profile.prepare(session)
    assert (done.rebooted, vehicle.reboots, vehicle.stored > 0) == (True, 1, True)
    assert vehicle.module is not None
    assert {name: vehicle.values[name] for name in PREPARED} == PREPARED
    vehicle.take_off()
    result = profile.excite(session, profile.check(session))
    assert (result.complete, result.reason, result.stopped) == (True, "", True)
    assert vehicle.runs == 2
    # Roll, pitch and yaw of two runs.
    assert result.seconds == pytest.approx(2 * (5.1 + 5.1 + 10.0), abs=8.0 if loss else 2.0)
    restored = profile.restore(session)
    assert restored.complete
    assert vehicle.values == vehicle.before == saved[-1]
    assert "from the next reboot on" in restored.notes[0]


def test_a_prepared_px4_is_not_rebooted_again():
    vehicle = StockPx4(**PREPARED)
    profile, _ = profile_of("px4-stock", vehicle)
    assert not profile.prepare(SimulatedSession(vehicle, profile.integers)).rebooted
    assert vehicle.reboots == 0


def test_a_px4_that_cannot_restart_itself_is_rebooted_by_hand():
    vehicle = StockPx4({30.0: StockPx4.reboot}, denies=True)
    profile, _ = profile_of("px4-stock", vehicle)
    assert profile.prepare(SimulatedSession(vehicle, profile.integers)).rebooted
    assert (vehicle.reboots, vehicle.module is None) == (1, False)
    never = StockPx4(denies=True)
    profile, _ = profile_of("px4-stock", never)
    session = SimulatedSession(never, profile.integers)
    with pytest.raises(SitlError, match="not seen to reboot within 180 s; it refuses the command"):
        profile.prepare(session)
    assert profile.restore(session).complete


def test_an_autotune_that_the_firmware_does_not_start_is_found_by_its_parameters_and_all_goes_back():
    vehicle = StockPx4(starts=False)
    profile, _ = profile_of("px4-stock", vehicle)
    session = SimulatedSession(vehicle, profile.integers)
    with pytest.raises(SitlError, match=r"MC_AT_EN is 1 but the autotune was not started at boot.*does not start"):
        profile.prepare(session)
    assert profile.restore(session).complete
    assert vehicle.values == vehicle.before


def change(**attributes):
    def happen(vehicle):
        for name, value in attributes.items():
            setattr(vehicle, name, value)

    return happen


#: In the roll stretch, which begins about 9 s after the check: 3 s of wind, 4 s in which PX4 measures its rate.
AT = 12.0
EVENTS = [
    (change(mode=3 << 16), "left its mode"),
    (change(armed=False), "disarmed"),
    (change(landed=1), "on the ground"),
    (change(tilt=0.5), "tilts by 29 degrees"),
    (change(silent={"HEARTBEAT"}), "no HEARTBEAT for 5 s"),
    (change(silent={30}), "no longer sends ATTITUDE"),
    (change(stick=0.2), "ended its autotune in roll .a stick moved"),
]


@pytest.mark.parametrize(("event", "reason"), EVENTS)
def test_an_unsafe_event_ends_the_excitation_of_a_px4_and_all_goes_back(event, reason):
    vehicle = StockPx4({AT: event}, **PREPARED)
    session, profile, monitor = flying(vehicle, "px4-stock", runs=3)
    result = profile.excite(session, monitor)
    assert not result.complete
    assert re.search(reason, result.reason), result.reason
    assert result.stopped
    restored = profile.restore(session)
    assert restored.complete
    assert vehicle.values == vehicle.before
    session.run(wait_until(session.client, session.client.now + 5.0))
    # HEARTBEAT is missed after 5 s; the high-pass of the last step fades with 0.2 s.
    assert len(vehicle.excited(end=AT))
    assert len(vehicle.excited(begin=AT + 6.5)) == 0
    assert vehicle.runs == 1


def wait_until(client, end):
    while client.now < end:
        yield from client.send_and_wait([], end)


def test_ctrl_c_takes_the_amplitude_away_first():
    vehicle = StockPx4(**PREPARED)
    session, profile, monitor = flying(vehicle, "px4-stock")
    vehicle.then[AT] = lambda _: setattr(session.client, "interrupted", True)
    result = profile.excite(session, monitor)
    assert (result.complete, result.reason, result.stopped) == (False, "run 1: interrupted", True)
    assert profile.restore(session).complete
    assert len(vehicle.excited(begin=AT + 1.5)) == 0
    assert vehicle.values == vehicle.before


def test_a_lost_link_is_told_with_what_is_left():
    vehicle = StockPx4(**PREPARED)
    session, profile, monitor = flying(vehicle, "px4-stock")
    vehicle.then[AT] = lambda _: setattr(session.link, "up", False)
    result = profile.excite(session, monitor)
    assert (result.complete, result.stopped) == (False, False)
    restored = profile.restore(session)
    assert restored.left == {name: vehicle.before[name] for name in ("MC_AT_APPLY", "MC_AT_SYSID_AMP", "MC_AT_START")}


@pytest.mark.parametrize(
    ("changes", "parts"),
    [
        ({"armed": False}, "not armed"),
        ({"landed": 1}, "on the ground"),
        ({"mode": 3 << 16}, "not in the mode hold"),
        ({"charge": 20}, "battery is at 20 %"),
        ({"free": 3.0}, "card has 3 MiB left"),
        ({"tilt": 0.3}, "tilts by up to 17 degrees in hover.*too windy"),
        ({"silent": {30}}, "does not send ATTITUDE"),
        ({"module": None}, "autotune was not started at boot; land"),
    ],
)
def test_nothing_is_written_to_a_px4_that_is_not_ready(changes, parts):
    vehicle = StockPx4(**PREPARED)
    vehicle.take_off()
    change(**changes)(vehicle)
    profile, saved = profile_of("px4-stock", vehicle)
    with pytest.raises(SitlError, match=parts):
        profile.check(SimulatedSession(vehicle, profile.integers))
    assert (vehicle.writes, saved) == (0, [])


def test_all_that_a_px4_in_the_air_lacks_is_named_at_once():
    with pytest.raises(SitlError, match="MC_AT_EN is 0 and SDLOG_PROFILE is 1, too slow a log; 17 is needed; land"):
        flying(StockPx4(), "px4-stock")


def test_another_vehicle_and_an_armed_one_are_refused():
    profile, _ = profile_of("px4-stock", FlyingVehicle())
    other = StockCopter()
    with pytest.raises(SitlError, match=r"ArduPilot.*which the profile px4-stock does not fit"):
        profile.prepare(SimulatedSession(other, profile.integers))
    armed = StockPx4()
    armed.take_off()
    with pytest.raises(SitlError, match="armed or in the air: land and disarm it to prepare it"):
        profile.prepare(SimulatedSession(armed, profile.integers))
    assert (other.writes, armed.writes, armed.reboots) == (0, 0, 0)


@pytest.mark.parametrize("loss", [0.0, 0.3])
def test_an_arducopter_flies_three_chirps_from_stabilize_and_back(loss):
    vehicle = StockCopter()
    profile, _ = profile_of("ardupilot-stock", vehicle)
    session = SimulatedSession(vehicle, profile.integers, loss=loss)
    assert not profile.prepare(session).rebooted
    assert int(vehicle.values["LOG_BITMASK"]) & 3 == 3
    vehicle.take_off()
    result = profile.excite(session, profile.check(session))
    assert (result.complete, result.reason, result.stopped, vehicle.mode) == (True, "", True, 0)
    assert result.seconds == pytest.approx(3 * 12.0, abs=1.0)
    assert [axis for axis, *_ in vehicle.chirps] == [10, 11, 12]
    assert profile.settings["SID_F_STOP_HZ"] == pytest.approx(2 * 50.0 / 6.2832, rel=1e-4)
    assert profile.restore(session).complete
    assert vehicle.values == vehicle.before


@pytest.mark.parametrize(
    ("event", "reason", "mode"),
    [
        (change(tilt=0.5), "tilts by 29 degrees", 0),
        (change(altitude=16.0), r"altitude has changed by \+6.0 m", 0),
        (lambda vehicle: vehicle.enter(5), "left its mode", 5),  # the pilot's choice stays
        (change(said=["SystemID Stopped: lean=46 max=45"]), "the vehicle stopped: SystemID Stopped", 0),
        (change(silent={74}), "no longer sends VFR_HUD", 0),
    ],
)
def test_an_unsafe_event_ends_the_chirp_of_an_arducopter_and_all_goes_back(event, reason, mode):
    vehicle = StockCopter({AT: event})
    session, profile, monitor = flying(vehicle, "ardupilot-stock")
    result = profile.excite(session, monitor)
    assert not result.complete
    assert re.search(reason, result.reason), result.reason
    assert (result.stopped, vehicle.mode) == (True, mode)
    assert vehicle.chirps[-1][2] < AT + 3.0
    assert profile.restore(session).complete
    assert vehicle.values == vehicle.before


def test_an_arducopter_in_loiter_or_that_refuses_the_mode_is_told_as_it_says():
    vehicle = StockCopter()
    vehicle.mode = 5
    with pytest.raises(
        SitlError, match=r"mode 5: change to Stabilize.*manual throttle, so the altitude is the pilot's"
    ):
        flying(vehicle, "ardupilot-stock")
    assert vehicle.writes == 0
    refusing = StockCopter()
    session, profile, monitor = flying(refusing, "ardupilot-stock")
    refusing.command = lambda number, params: refusing.said.append("Axis requires manual throttle") or (4,)
    result = profile.excite(session, monitor)
    assert "refuses mode 25 (MAV_RESULT 4)" in result.reason
    assert profile.restore(session).complete


def test_the_saved_values_restore_a_px4_with_its_whole_numbers(tmp_path):
    file = tmp_path / "old.params"
    file.write_text(parameter_text("qgc", {"MC_AT_EN": 0.0, "MC_AT_SYSID_AMP": 0.5}, integers={"MC_AT_EN"}))
    assert "MC_AT_EN\t0.0\t6" in file.read_text()
    plan = make_restore_plan(read_parameters(file), str(file))
    assert (plan.profile, plan.integers) == ("px4-stock", {"MC_AT_EN", "MC_AT_SYSID_AMP"})


@pytest.mark.parametrize(
    ("name", "options", "parts"),
    [
        ("px4", {}, "--profile: got 'px4'"),
        ("px4-stock", {"axis": "roll"}, "--axis: PX4's autotune excites roll, pitch and yaw"),
        ("px4-stock", {"amplitude": 0.05}, "--amplitude: got 0.05, expected 0.1 to 6 rad/s"),
        ("ardupilot-stock", {"amplitude": 0.6}, "--amplitude: got 0.6"),
        ("ardupilot-stock", {"seconds_per_axis": 3.0}, "--seconds-per-axis: got 3, expected 5 to 255 s"),
        ("ardupilot-stock", {"runs": 2}, "--runs: belongs to --profile px4-stock"),
    ],
)
def test_options_that_do_not_fit_are_refused(name, options, parts):
    with pytest.raises(SitlError, match=parts):
        profile_of(name, None, **options)


def test_the_command_is_never_sent_to_a_running_px4_as_a_stop():
    """Up to v1.17 any such command starts a run when the autotune is idle."""
    vehicle = StockPx4({AT: change(tilt=0.5)}, **PREPARED)
    session, profile, monitor = flying(vehicle, "px4-stock")
    profile.excite(session, monitor)
    stops = [m for _, m in session.link.log if isinstance(m, SendCommand) and m.params[0] == 0]
    assert (stops, vehicle.mode) == ([], HOLD)


# The command, against `mimopilot sitl --autopilot px4-stock`.


def test_the_command_prepares_and_excites_a_stock_px4_whose_log_is_an_experiment(tmp_path, mimopilot):
    log, old = tmp_path / "flight.ulg", tmp_path / "old.params"
    with running_sitl("--autopilot", "px4-stock", "--speed", "4", "--log", log) as sitl:
        pilot = Pilot(f"udpin:127.0.0.1:{sitl.udp}")
        pilot.ready()
        assert pilot.beat.autopilot == 12
        link = ("--connect", f"tcp:127.0.0.1:{sitl.tcp}")
        options = ("--profile", "px4-stock", "--runs", 1, "--snapshot", old, "--yes")
        client = start("experiment", *link, *options)
        client.until("4 parameters set, rebooted; take off and hover now")
        pilot.wait(lambda: pilot.command(400, 1) == 0)  # it has just booted
        assert pilot.command(22, 0, 0, 0, 0, 0, 0, 5) == 0
        pilot.wait(lambda: client.process.poll() is not None)
        client.end()
        assert client.process.returncode == 0, client.output
        assert "excited for" in client.output
        assert pilot.command(21) == 0
        pilot.hears("logged: flight.ulg")
        same = mimopilot("restore", old, *link, "--dry-run")
        assert same.returncode == 0, same.stderr
        pilot.close()
    assert "MC_AT_EN\t0.0\t6" in old.read_text()
    signal, name = external_signal(read_log(log))
    assert (name, signal.any(axis=0).all()) == ("r_bar", True)


def test_a_stream_is_overdue_by_time_and_by_missed_messages():
    """At 30 % loss a stream at 5 Hz is silent for a second once in a minute."""
    client = VehicleLinkState(0.0)
    monitor = FlightMonitor(client, {"ATTITUDE": (30, 50_000), "VFR_HUD": (74, 200_000)})
    assert monitor.overdue(1.0) == ["ATTITUDE", "VFR_HUD"]
    monitor.seen = dict.fromkeys(monitor.streams, 0.0)
    for now, late in ((1.0, []), (1.1, ["ATTITUDE"]), (2.4, ["ATTITUDE"]), (2.5, ["ATTITUDE", "VFR_HUD"])):
        client.now = now
        assert monitor.overdue(1.0) == late


def test_a_long_text_of_the_vehicle_is_joined_from_its_chunks():
    monitor = FlightMonitor(VehicleLinkState(0.0), {})
    for text, chunk in (("Disarmed", 0), ("Arming denied: Resolve system health failures firs", 0), ("t", 1)):
        monitor(StatusText(1, 1, text, chunk))
    assert monitor.text == "Arming denied: Resolve system health failures first"
