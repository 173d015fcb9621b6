"""The commands upload, restore and params on real links, against scripted vehicles and `mimopilot sitl`."""

import json
import os
import signal
import subprocess

import pytest

from mimopilot.codegen.render import render
from mimopilot.sitl.mavlink.ground_station.profiles import make_plan
from mimopilot.sitl.mavlink.wire.parameter_files import read_parameters
from mimopilot.sitl.physics.airframe import load_airframe
from mimopilot.tuning.gains_file import load_gains
from mimopilot.tuning.parameters import FIRMWARE_NUMBER, PARAMETERS
from tests.conftest import assert_one_clear_line, stock_gains
from tests.readable import Printed
from tests.sitl.mavlink.running import PATIENCE_S, QUICK, Pilot, running_sitl, wait_for
from tests.sitl.mavlink.scripted_vehicle import (
    FAILING,
    ScriptedVehicle,
    SerialVehicle,
    TcpVehicle,
    UdpVehicle,
)

#: What an upload writes, and a snapshot saves.
WRITTEN = sum(parameter.writable for parameter in PARAMETERS) + 1
SAVED = [*(p.name for p in (*PARAMETERS, FIRMWARE_NUMBER) if p.writable or p is FIRMWARE_NUMBER), "MIMO_SET_ID"]


KEY = bytes(range(32))


@pytest.fixture
def mimopilot(quick_mimopilot):
    return quick_mimopilot


def read_until(process, text):
    shown = ""
    while text not in shown:
        character = process.stdout.read(1)
        assert character, process.stderr.read()
        shown += character


def named(values, names):
    return {name: values[name] for name in names}


@pytest.mark.parametrize("transport", [UdpVehicle, TcpVehicle, SerialVehicle])
def test_gains_arrive_over_udp_tcp_and_serial(mimopilot, certified, old, new, transport):
    with transport(ScriptedVehicle(old)) as link:
        done = mimopilot("upload", certified, "--connect", link.url, "--yes")
        assert done.returncode == 0, done.stderr
        assert named(link.vehicle.values, new) == new
        assert link.vehicle.stored == 1
    verified = f"{WRITTEN} parameters verified, {WRITTEN} of them written"
    assert f"{verified}; stored: the vehicle acknowledged it" in done.stdout
    assert "MIMO_RP_RR" in done.stdout
    assert done.stderr == ""
    assert read_parameters(certified.with_name("my.before-1.params")) == named(old, SAVED)


def test_a_dry_run_only_reads(mimopilot, certified, old, tmp_path, monkeypatch):
    files, printed = sorted(tmp_path.iterdir()), Printed(monkeypatch)
    with UdpVehicle(ScriptedVehicle(old)) as link:
        link.vehicle.armed = True
        shown = mimopilot("upload", certified, "--connect", link.url, "--dry-run")
        assert (shown.returncode, link.vehicle.writes, link.vehicle.stored) == (0, 0, 0)
    for word in ("armed", "on the vehicle", "MIMO_RP_RR", "0.15", "0.13125", "+0.01875"):
        assert word in shown.stdout
    assert sorted(tmp_path.iterdir()) == files
    printed.check(shown.stdout)


def test_json_is_one_object_for_success_and_for_failure(mimopilot, certified, old, new):
    with UdpVehicle(ScriptedVehicle(old)) as link:
        done = mimopilot("upload", certified, "--connect", link.url, "--yes", "--json")
    found = json.loads(done.stdout)
    assert (done.returncode, found["state"], found["storage"]) == (0, "verified", "acknowledged")
    assert {name: entry["held"] for name, entry in found["parameters"].items()} == {n: [v] for n, v in new.items()}
    with UdpVehicle(ScriptedVehicle(old, "echoes one", faulty="MIMO_RI_PR")) as link:
        failed = mimopilot("upload", certified, "--connect", link.url, "--yes", "--json")
        assert named(link.vehicle.values, new) == named(old, new)
    found = json.loads(failed.stdout)
    assert (failed.returncode, found["state"]) == (1, "rolled back")
    assert found["reason"].startswith("MIMO_RI_PR: reads back as")
    assert_one_clear_line(failed, "MIMO_RI_PR", "the old values were restored and read back", code=1)


#: After these the old values cannot be read back.
NOT_ROLLED_BACK = ("disconnects", "loses one", "writes another")


@pytest.mark.parametrize("fault", [fault for fault in FAILING if fault not in NOT_ROLLED_BACK])
def test_the_command_detects_and_rolls_back_every_fault(mimopilot, certified, old, new, fault):
    vehicle = ScriptedVehicle(old, fault, faulty="MIMO_RP_PP", after=12)
    with UdpVehicle(vehicle) as link:
        failed = mimopilot("upload", certified, "--connect", link.url, "--yes", "--timeout", "3")
        assert named(vehicle.values, new) == named(old, new)
    assert_one_clear_line(failed, "nothing was written" if fault == "integer" else "restored and read back", code=1)
    assert "verified" not in failed.stdout


def test_after_a_link_loss_each_changed_parameter_is_named_and_can_be_restored(mimopilot, certified, old, new):
    vehicle = ScriptedVehicle(old, "disconnects", after=20)
    with UdpVehicle(vehicle) as link:
        failed = mimopilot("upload", certified, "--connect", link.url, "--yes", "--timeout", "3")
        held = dict(vehicle.values)
        changed = [name for name in new if held[name] != old[name]]
        assert len(changed) == 20
        snapshot = certified.with_name("my.before-1.params")
        parts = [f"{name} holds" for name in changed]
        assert_one_clear_line(failed, *parts, f"mimopilot restore {snapshot} --connect {link.url}", code=1)
        for name in new:
            # A parameter that may hold the new value is named; the others hold the old one.
            reported = f"{name} holds" in failed.stderr
            assert reported or held[name] == old[name]
        vehicle.offline, vehicle.fault = False, ""
        back = mimopilot("restore", snapshot, "--connect", link.url, "--yes")
        assert back.returncode == 0, back.stderr
        assert f"{WRITTEN} parameters verified, 20 of them written" in back.stdout
        assert named(vehicle.values, new) == named(old, new)


def test_a_broken_connection_is_detected_at_once(mimopilot, certified, old):
    link = TcpVehicle(ScriptedVehicle(old))
    write = link.vehicle.write
    link.vehicle.write = lambda name, value: (link.vehicle.writes == 9 and link.hang_up()) or write(name, value)
    with link:
        failed = mimopilot("upload", certified, "--connect", link.url, "--yes", "--timeout", "600")
        link.stop.set()
    assert_one_clear_line(failed, "the link was lost", "MIMO_AP_RR holds", "mimopilot restore", code=1)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_ctrl_c_or_a_closed_terminal_restores_the_old_values(certified, old, new, number):
    vehicle = ScriptedVehicle(old, "ignores one", faulty="MIMO_RF_PP")
    with UdpVehicle(vehicle) as link:
        command = [*QUICK, "upload", str(certified), "--connect", link.url, "--yes"]
        with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
            wait_for(lambda: vehicle.writes >= 20)
            process.send_signal(number)
            wait_for(lambda: vehicle.values["MIMO_AP_RR"] == old["MIMO_AP_RR"])  # the roll-back has begun
            vehicle.fault = ""
            _, message = process.communicate(timeout=PATIENCE_S)
        assert process.returncode == 1
        assert "interrupted" in message
        assert "the old values were restored and read back" in message
        assert named(vehicle.values, new) == named(old, new)


@pytest.mark.parametrize(("answer", "written"), [("y\n", True), ("n\n", False)])
def test_the_user_at_a_terminal_is_asked_to_confirm(certified, old, new, answer, written):
    near, far = os.openpty()
    with UdpVehicle(ScriptedVehicle(old)) as link:
        command = [*QUICK, "upload", str(certified), "--connect", link.url]
        with subprocess.Popen(command, stdin=far, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
            read_until(process, f"Write {WRITTEN} parameters to vehicle 1?")
            os.write(near, answer.encode())
            _, told = process.communicate(timeout=PATIENCE_S)
        assert (process.returncode == 0) == written, told
        assert named(link.vehicle.values, new) == (new if written else named(old, new))
    os.close(near)
    os.close(far)


def test_values_that_change_before_the_confirmation_are_not_overwritten(certified, old, new):
    near, far = os.openpty()
    with UdpVehicle(ScriptedVehicle(old)) as link:
        command = [*QUICK, "upload", str(certified), "--connect", link.url]
        with subprocess.Popen(command, stdin=far, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
            read_until(process, f"Write {WRITTEN} parameters to vehicle 1?")
            link.vehicle.values["MIMO_RP_RR"] = 0.5
            os.write(near, b"y\n")
            _, message = process.communicate(timeout=PATIENCE_S)
        assert (process.returncode, link.vehicle.writes) == (1, 0)
        assert "changed while waiting for the answer" in message
    os.close(near)
    os.close(far)


def test_a_signed_link_asks_for_its_key(mimopilot, certified, old, new, tmp_path):
    (tmp_path / "key").write_bytes(KEY)
    (tmp_path / "hex").write_text(KEY.hex() + "\n")
    (tmp_path / "wrong").write_bytes(bytes(32))
    for name in ("key", "hex"):
        with UdpVehicle(ScriptedVehicle(old), key=KEY) as link:
            arguments = ("upload", certified, "--connect", link.url, "--yes", "--timeout", "2")
            done = mimopilot(*arguments, "--signing-key", name)
            assert done.returncode == 0, done.stderr
            assert named(link.vehicle.values, new) == new
    with UdpVehicle(ScriptedVehicle(old), key=KEY) as link:
        arguments = ("upload", certified, "--connect", link.url, "--yes", "--timeout", "3")
        assert_one_clear_line(mimopilot(*arguments), "no answer", "give --signing-key", code=1)
        wrong = mimopilot(*arguments, "--signing-key", "wrong")
        assert_one_clear_line(wrong, "no HEARTBEAT", "not signed with this key", code=1)
        assert link.vehicle.writes == 0


def test_a_vehicle_that_does_not_publish_its_unit_of_torque_needs_moment_scale(mimopilot, certified, old, new):
    silent = {name: value for name, value in old.items() if not name.startswith("MIMO_SCALE")}
    with UdpVehicle(ScriptedVehicle(silent)) as link:
        arguments = ("upload", certified, "--connect", link.url, "--yes", "--timeout", "3")
        assert_one_clear_line(
            mimopilot(*arguments), "MIMO_SCALE_R", "its unit of torque is not known", "--moment-scale flown", code=1
        )
        assert mimopilot(*arguments, "--moment-scale", "2.546,2.546,0.2736").returncode == 0
        assert named(link.vehicle.values, new) == new


@pytest.mark.parametrize(("profile", "autopilot"), [("px4-stock", 12), ("ardupilot-stock", 3)])
def test_a_stock_autopilot_receives_its_own_set(mimopilot, certified, tmp_path, profile, autopilot):
    gains = stock_gains(profile)
    gains.save(tmp_path / "stock.gains.toml")
    wanted = make_plan(gains, profile).values
    vehicle = ScriptedVehicle(dict.fromkeys(wanted, 0.25))
    vehicle.autopilot = autopilot
    with UdpVehicle(vehicle) as link:
        arguments = ("--connect", link.url, "--yes", "--profile", profile)
        assert_one_clear_line(
            mimopilot("upload", certified, *arguments), "the gains are for mimo", "tune LOG --profile"
        )
        arguments = ("upload", "stock.gains.toml", *arguments)
        assert_one_clear_line(mimopilot(*arguments), "no certificate")
        refused = mimopilot(*arguments, "--uncertified")
        assert (refused.returncode, "--moment-scale" in refused.stderr) == (2, True)
        done = mimopilot(*arguments, "--uncertified", "--moment-scale", "flown")
        assert done.returncode == 0, done.stderr
        assert link.vehicle.values == wanted


def test_an_older_snapshot_is_never_overwritten(mimopilot, certified, old, new, tmp_path):
    with UdpVehicle(ScriptedVehicle(old)) as link:
        arguments = ("upload", certified, "--connect", link.url, "--yes")
        assert mimopilot(*arguments, "--snapshot", "mine.params").returncode == 0
        assert_one_clear_line(mimopilot(*arguments, "--snapshot", "mine.params"), "mine.params", "name another file")
        link.vehicle.values.update(old)
        assert mimopilot(*arguments).returncode == 0
        link.vehicle.values["MIMO_RP_RR"] = 0.5
        assert mimopilot(*arguments).returncode == 0
        assert mimopilot(*arguments).returncode == 0  # nothing changes, so no snapshot is saved
        assert not (tmp_path / "my.before-3.params").exists()
        restored = mimopilot("restore", "my.before-1.params", "--connect", link.url, "--yes")
        assert restored.returncode == 0
        assert read_parameters(tmp_path / "my.before-3.params") == new | named(old, ["MIMO_FW_ID"])
    assert read_parameters(tmp_path / "mine.params") == named(old, SAVED)
    assert read_parameters(tmp_path / "my.before-1.params") == named(old, SAVED)
    assert read_parameters(tmp_path / "my.before-2.params") == named(old | new, SAVED) | {"MIMO_RP_RR": 0.5}


def test_parameter_files_are_written_compared_and_read_from_a_vehicle(mimopilot, certified, old, new, tmp_path):
    gains_only = [parameter.name for parameter in PARAMETERS if parameter.writable]
    for form in ("qgc", "mavproxy", "missionplanner"):
        assert mimopilot("params", certified, "--format", form, "--out", f"{form}.txt").returncode == 0
        assert read_parameters(tmp_path / f"{form}.txt") == named(new, gains_only)
    assert mimopilot("params", certified, "--format", "mavproxy").stdout == (tmp_path / "mavproxy.txt").read_text()
    header = mimopilot("params", certified, "--format", "c-header").stdout
    assert header == render(load_gains(certified))["core/parameters.h"]
    module = mimopilot("params", certified, "--format", "px4-yaml").stdout
    assert module == render(load_gains(certified), "px4")["px4/src/modules/mc_mimo_pid/module.yaml"]
    with UdpVehicle(ScriptedVehicle(old)) as link:
        assert mimopilot("params", "--connect", link.url, "--out", "held.params").returncode == 0
        numbers = {name: link.vehicle.values[name] for name in ("MIMO_FW_ID", "MIMO_SET_ID")}
        assert read_parameters(tmp_path / "held.params") == named(old, gains_only) | numbers
        differ = mimopilot("params", certified, "--connect", link.url)
        assert "MIMO_RP_RR" in differ.stdout
        assert_one_clear_line(differ, f"{len(gains_only) + 1} of {len(PARAMETERS) + 1} parameters differ", code=1)
        link.vehicle.values.update(new)
        same = mimopilot("params", certified, "--connect", link.url, "--json")
        assert (same.returncode, json.loads(same.stdout)["equal"]) == (0, True)
        assert link.vehicle.writes == 0
        back = mimopilot("restore", "held.params", "--connect", link.url, "--yes")
        assert back.returncode == 0, back.stderr
        assert named(link.vehicle.values, [*gains_only, *numbers]) == named(old, gains_only) | numbers


def test_our_sitl_accepts_gains_in_flight_only_if_forced(mimopilot, tmp_path):
    gains = load_airframe("adam0").default_gains()
    tuned = gains.with_elements({"RP_RR": 0.16, "RP_RP": 0.0123, "RP_PR": -0.004})
    tuned.save(tmp_path / "tuned.gains.toml")
    with running_sitl() as sitl:
        pilot = Pilot(f"udpin:127.0.0.1:{sitl.udp}")
        pilot.ready()
        assert pilot.command(400, 1) == 0
        url = f"tcp:127.0.0.1:{sitl.tcp}"
        arguments = ("upload", "tuned.gains.toml", "--connect", url, "--yes", "--uncertified", "--json")
        assert mimopilot(*arguments).returncode == 1
        done = mimopilot(*arguments, "--force-armed")
        found = json.loads(done.stdout)
        assert (done.returncode, found["state"], found["storage"]) == (0, "verified", "autosave")
        for name in ("MIMO_RP_RR", "MIMO_RP_RP", "MIMO_RP_PR"):
            assert found["parameters"][name]["held"] == [make_plan(tuned).values[name]]
        same = mimopilot("params", "tuned.gains.toml", "--connect", url, "--json")
        assert json.loads(same.stdout)["equal"]
        assert len(json.loads(same.stdout)["parameters"]) == len(PARAMETERS) + 1  # and the number
        back = mimopilot("restore", found["snapshot"], "--connect", url, "--yes", "--force-armed")
        assert back.returncode == 0
        assert "4 of them written" in back.stdout  # with the number of the firmware
        while pilot.take(0.0) is not None:
            pass  # empty the receive buffer, which would overflow
        assert pilot.command(400, 0) == 0
        stored = mimopilot(*arguments)
        assert json.loads(stored.stdout)["storage"] == "acknowledged"
        pilot.close()
