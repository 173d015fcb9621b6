"""Uploads to a scripted Crazyflie, by the command: the same transaction as over MAVLink, with its faults."""

import math
import subprocess
import sys
from dataclasses import replace

import pytest

from mimopilot.sitl.mavlink.wire.parameter_files import read_parameters
from mimopilot.tuning.certificate import Certificate, Verdict
from mimopilot.tuning.crazyflie_names import STATE, ControllerState, crazyflie_name
from mimopilot.tuning.parameters import PARAMETERS
from tests.conftest import assert_one_clear_line
from tests.sitl.crtp.scripted_crazyflie import ARMED, AUTO, FLYING, URI, ScriptedCrazyflie, connect

WRITTEN = sum(parameter.writable for parameter in PARAMETERS) + 1  # and the number of the firmware


STATION = "mimopilot.sitl.mavlink.ground_station"
#: Further waits (s) that are shorter here: a scripted vehicle answers at once.
WAITS = {"crazyflie_link.AGAIN_S": 0.02, "parameter_protocol.TRY_S": 0.05, "set_switch.TAKE_S": 0.1}


@pytest.fixture
def mimopilot(monkeypatch, quick_mimopilot):
    for name, seconds in WAITS.items():
        monkeypatch.setattr(f"{STATION}.{name}", seconds)
    return quick_mimopilot


def on_vehicle(values):
    return {crazyflie_name(name): value for name, value in values.items()}


def held(vehicle, names):
    return {name: vehicle.values[crazyflie_name(name)] for name in names}


def upload(mimopilot, file, *more):
    return mimopilot("upload", file, "--connect", URI, "--yes", "--timeout", "3", *more)


@pytest.mark.parametrize("enabled", [0.0, 1.0])
def test_gains_arrive_are_taken_and_stored_with_the_switch_last(mimopilot, monkeypatch, certified, old, new, enabled):
    vehicle = connect(monkeypatch, ScriptedCrazyflie(old, enabled=enabled))
    done = upload(mimopilot, certified)
    assert done.returncode == 0, done.stderr
    assert f"{WRITTEN} parameters verified, {WRITTEN} of them written" in done.stdout
    assert "stored: the vehicle acknowledged it" in done.stdout
    assert held(vehicle, new) == new
    assert vehicle.values["mimo.EN"] == enabled
    assert (vehicle.values[STATE], vehicle.taken == vehicle.gains()) == ((1.0, True) if enabled else (0.0, False))
    assert vehicle.stored == on_vehicle(new) | {"mimo.EN": enabled}
    saved = {name: old[name] for name in (*new, "MIMO_FW_ID")}
    assert read_parameters(certified.with_name("my.before-1.params")) == saved
    assert vehicle.connections == 0
    again = upload(mimopilot, certified)
    assert f"{WRITTEN} parameters verified, 0 of them written" in again.stdout


def test_a_part_of_a_set_never_flies_and_is_never_started_with(mimopilot, monkeypatch, certified, old, new):
    old = old | {"MIMO_SET_ID": old["MIMO_FW_ID"]}  # of an earlier upload
    vehicle = connect(monkeypatch, ScriptedCrazyflie(old))
    sets = [on_vehicle({name: values[name] for name in new}) for values in (old, new)]
    vehicle.stored = sets[0] | {"mimo.EN": 1.0}
    seen, write, store = [], vehicle.write, vehicle.store

    def watched(step, *arguments):
        found = step(*arguments)
        seen.append((dict(vehicle.values), dict(vehicle.stored)))
        return found

    monkeypatch.setattr(vehicle, "write", lambda *arguments: watched(write, *arguments))
    monkeypatch.setattr(vehicle, "store", lambda *arguments: watched(store, *arguments))
    assert upload(mimopilot, certified).returncode == 0
    whole = {**on_vehicle(old)}, {**on_vehicle(old), **on_vehicle(new)}
    for values, stored in seen:
        if values["mimo.EN"] == 1.0:
            assert {name: values[name] for name in on_vehicle(old)} in whole
        # It starts with what is stored, if its number is right, even if somebody switches it on.
        assert stored["mimo.SET_ID"] == 0.0 or {name: stored[name] for name in sets[0]} in sets
    assert any(stored["mimo.SET_ID"] == 0.0 for _, stored in seen)
    assert vehicle.stored == sets[1] | {"mimo.EN": 1.0}


@pytest.mark.parametrize(
    ("fault", "after", "words"),
    [
        ("clamps", 0, ("MIMO_RP_PP: ",)),
        ("ignores", 0, ("MIMO_RP_PP: reads back as",)),
        ("refuses the set", 0, ("MIMO_STATE is 3: it refused the set, and the one that it took before flies",)),
        ("takes off", 9, ("the vehicle was armed",)),
    ],
)
def test_after_a_fault_the_old_set_is_back(mimopilot, monkeypatch, certified, old, new, fault, after, words):
    faulty = "" if fault in ("takes off", "refuses the set") else "MIMO_RP_PP"
    old = old | {"MIMO_SET_ID": old["MIMO_FW_ID"]}  # of an earlier upload
    vehicle = connect(monkeypatch, ScriptedCrazyflie(old, fault, faulty, after))
    if fault in ("clamps", "ignores"):
        # The fault is of the first write only: the old value can be written back.
        write = vehicle.write

        def once(number, name, data):
            done = write(number, name, data)
            vehicle.fault = "" if name == "mimo.RP_PP" else vehicle.fault
            return done

        monkeypatch.setattr(vehicle, "write", once)
    failed = upload(mimopilot, certified)
    assert held(vehicle, new) == {name: old[name] for name in new}
    assert vehicle.values["mimo.EN"] == 1.0
    # A vehicle that refuses every set, or flies, has not taken the old one by its switch, so that is said.
    outcome = "the old values were written" if fault == "refuses the set" else "restored and read back"
    assert_one_clear_line(failed, *words, outcome, code=1)


def test_lost_packets_are_sent_again(mimopilot, monkeypatch, certified, old, new):
    vehicle = connect(monkeypatch, ScriptedCrazyflie(old, loss=0.1, seed=1))
    done = mimopilot("upload", certified, "--connect", URI, "--yes")
    assert done.returncode == 0, done.stderr
    assert held(vehicle, new) == new


def test_a_link_that_dies_in_between_leaves_the_stock_controller_and_says_what_is_left(
    mimopilot, monkeypatch, certified, old, new
):
    vehicle = connect(monkeypatch, ScriptedCrazyflie(old, "dies", after=12))
    failed = upload(mimopilot, certified)
    changed = [name for name in new if held(vehicle, new)[name] != old[name]]
    assert changed
    snapshot = certified.with_name("my.before-1.params")
    parts = [f"{name} holds" for name in (*changed, "MIMO_EN")]
    assert_one_clear_line(failed, "the link was lost", *parts, f"restore {snapshot} --connect {URI}", code=1)
    assert (vehicle.values["mimo.EN"], vehicle.stored) == (0.0, {"mimo.EN": 0.0, "mimo.SET_ID": 0.0})
    vehicle.fault = ""
    back = mimopilot("restore", snapshot, "--connect", URI, "--yes")
    assert back.returncode == 0, back.stderr
    assert held(vehicle, new) == {name: old[name] for name in new}


def test_a_vehicle_that_does_not_store_is_no_success_and_the_next_upload_stores_all(
    mimopilot, monkeypatch, certified, old, new
):
    vehicle = connect(monkeypatch, ScriptedCrazyflie(old, "does not store"))
    failed = upload(mimopilot, certified)
    assert_one_clear_line(failed, "MIMO_EN: 0 was not stored; the old values were restored", code=1)
    assert held(vehicle, new) == {name: old[name] for name in new}
    vehicle.fault = ""
    again = upload(mimopilot, certified)
    assert f"{WRITTEN} parameters verified, {WRITTEN} of them written" in again.stdout
    assert vehicle.stored == on_vehicle(new) | {"mimo.EN": 1.0}


def test_a_vehicle_that_holds_the_set_but_flies_another_one_takes_it(mimopilot, monkeypatch, certified, old, new):
    vehicle = connect(monkeypatch, ScriptedCrazyflie(old))
    vehicle.values |= on_vehicle(new)
    vehicle.update()
    assert vehicle.values[STATE] == ControllerState.CHANGED
    assert upload(mimopilot, certified).returncode == 0
    assert vehicle.values[STATE] == ControllerState.FLIES


REFUSALS = {
    "flying": (
        lambda v: setattr(v, "state_bits", v.state_bits | FLYING),
        "is armed: nothing was written",
        1,
    ),
    "armed by hand": (lambda v: setattr(v, "state_bits", v.state_bits & ~AUTO | ARMED), "the vehicle is armed", 1),
    "another period": (lambda v: v.values.update({"mimo.TS": 0.004}), "MIMO_TS: the vehicle has 0.004", 2),
    "another unit": (lambda v: v.values.update({"mimo.SCALE_P": 0.5}), "moment_scale: the gains are for", 2),
    "a switch that is no number": (
        lambda v: v.values.update({"mimo.EN": math.nan}),
        "MIMO_EN: the vehicle holds nan",
        2,
    ),
    "old firmware": (lambda v: setattr(v, "protocol", 11), "version 11 of CRTP", 2),
    "silent": (
        lambda v: setattr(v, "fault", "silent"),
        "no Crazyflie answers at radio://0/80/2M: is it on",
        1,
    ),
}


@pytest.mark.parametrize("case", REFUSALS)
def test_nothing_is_written_to_a_vehicle_that_the_gains_are_not_for(mimopilot, monkeypatch, gains, tmp_path, old, case):
    change, words, code = REFUSALS[case]
    file = tmp_path / "my.gains.toml"
    gains = replace(gains, filters=replace(gains.filters, Ts=0.002))
    gains.with_certificate(Certificate(Verdict.CERTIFIED, "by this test")).save(file)
    vehicle = connect(monkeypatch, ScriptedCrazyflie(old | {"MIMO_TS": 0.002}))
    change(vehicle)
    failed = mimopilot("upload", file, "--connect", URI, "--yes", "--timeout", "1.5")
    assert_one_clear_line(failed, words, code=code)
    assert vehicle.writes == 0


def test_a_set_of_another_firmware_gets_the_number_of_this_one_and_its_snapshot_is_not_restored_on_a_third(
    mimopilot, monkeypatch, certified, old, new
):
    vehicle = connect(monkeypatch, ScriptedCrazyflie(old | {"MIMO_SET_ID": 7.0}))
    assert vehicle.values[STATE] == ControllerState.OTHER_FIRMWARE
    assert upload(mimopilot, certified).returncode == 0
    assert vehicle.values[STATE] == ControllerState.FLIES
    assert vehicle.stored["mimo.SET_ID"] == vehicle.values["mimo.FW_ID"] == new["MIMO_SET_ID"]
    vehicle.values["mimo.FW_ID"] = 8.0
    snapshot = certified.with_name("my.before-1.params")
    refused = mimopilot("restore", snapshot, "--connect", URI, "--yes", "--timeout", "3")
    assert_one_clear_line(refused, "MIMO_FW_ID: the vehicle has 8, the values are those of a firmware with 123456")


def test_a_firmware_without_a_number_is_to_be_generated_again(mimopilot, monkeypatch, certified, old):
    vehicle = connect(monkeypatch, ScriptedCrazyflie(old))
    vehicle.names = [name for name in vehicle.names if not name.endswith("_ID")]
    refused = upload(mimopilot, certified)
    assert_one_clear_line(refused, "MIMO_FW_ID: the vehicle does not have it", "generate it again", code=1)
    assert vehicle.writes == 0


def test_stock_firmware_is_told_what_to_flash(mimopilot, monkeypatch, certified, old):
    vehicle = connect(monkeypatch, ScriptedCrazyflie(old, "stock firmware"))
    failed = upload(mimopilot, certified)
    assert_one_clear_line(failed, "has none of our parameters; for mimo, flash the firmware of `mimopilot generate`")
    assert vehicle.writes == 0


def test_gains_of_a_vehicle_are_compared_and_written_to_a_file(mimopilot, monkeypatch, certified, old, new):
    connect(monkeypatch, ScriptedCrazyflie(old | new))
    assert mimopilot("params", certified, "--connect", URI).returncode == 0
    shown = mimopilot("params", "--connect", URI)
    assert "MIMO_RP_RR" in shown.stdout


def test_a_link_that_cannot_be_is_refused_with_what_to_do(mimopilot, monkeypatch, certified, old):
    connect(monkeypatch, ScriptedCrazyflie(old))
    wrong = mimopilot("upload", certified, "--connect", "bluetooth://0", "--yes")
    assert_one_clear_line(wrong, "--connect bluetooth://0: expected radio://0/80/2M", "usb://0")
    assert_one_clear_line(mimopilot("logs", "--connect", URI), "only upload, restore and params", "mimo.EX_AX")
    assert_one_clear_line(mimopilot("experiment", "--connect", URI, "--yes"), "only upload, restore and params")
    (certified.parent / "key").write_bytes(bytes(32))
    signed = upload(mimopilot, certified, "--signing-key", "key")
    assert_one_clear_line(signed, "--signing-key: a Crazyflie's link cannot be signed")


def test_without_a_dongle_the_message_names_it_and_cflib_is_imported_only_then(tmp_path, certified):
    """In a process of its own: no hardware is needed to import cflib."""
    program = (
        "import sys, mimopilot.cli.main\n"
        "import mimopilot.sitl.mavlink.ground_station.session\n"
        "assert 'cflib' not in sys.modules\n"
        "import cflib.crtp; cflib.crtp.init_drivers()\n"
        "from mimopilot.sitl.crtp.driver import CrtpDriver\n"
        "try: CrtpDriver('usb://0')\n"
        "except Exception as error: print(type(error).__name__, error)\n"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "SitlError --connect usb://0: cannot be opened: " in done.stdout
