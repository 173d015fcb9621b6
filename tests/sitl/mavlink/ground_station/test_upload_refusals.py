"""upload and restore with faulty vehicles, storage and files: their messages and exit codes."""

import json

import pytest

from mimopilot.sitl.errors import SitlError
from mimopilot.sitl.mavlink.ground_station.connection import Connection
from mimopilot.sitl.mavlink.ground_station.events import ParameterValue
from mimopilot.sitl.mavlink.wire.parameter_files import read_parameters
from mimopilot.sitl.mavlink.wire.signing import read_key
from mimopilot.tuning.certificate import Certificate, Verdict
from mimopilot.tuning.parameters import PARAMETERS, ROWS
from tests.conftest import assert_one_clear_line, stock_gains
from tests.sitl.mavlink.running import wait_for
from tests.sitl.mavlink.scripted_vehicle import ScriptedVehicle, UdpVehicle, float32

WRITTEN = sum(parameter.writable for parameter in PARAMETERS) + 1  # and the number of the firmware
#: Those without a default; the last two of the table have one.
REQUIRED = sum(len(row.codes) for row in ROWS if row.writable and row.default is None)


KEY = bytes(range(32))


@pytest.fixture
def mimopilot(quick_mimopilot):
    return quick_mimopilot


def upload(mimopilot, certified, link, *extra):
    return mimopilot("upload", certified, "--connect", link.url, "--yes", *extra)


def held_gains(vehicle, new):
    return {name: vehicle.values[name] for name in new}


class StoringVehicle(ScriptedVehicle):
    """`event` happens at the storage command and returns the messages that the vehicle then sends."""

    def __init__(self, values, event):
        super().__init__(values)
        self.event, self.before = event, dict(self.values)

    def answer(self, order):
        answers = super().answer(order)
        return (
            [*answers, *(self.event(self) or [])]
            if self.stored == 1 and type(order).__name__ == "StoreParameters"
            else answers
        )


def restarts(vehicle):
    vehicle.values.update(vehicle.before)


def clamps(vehicle):
    vehicle.values["MIMO_RP_RR"] = float32(0.1)


def is_written(vehicle):
    return [ParameterValue(1, 1, "MIMO_RP_RR", 0.5), ParameterValue(1, 1, "MIMO_RP_RR", vehicle.values["MIMO_RP_RR"])]


def arms(vehicle):
    vehicle.armed = True
    return vehicle.heartbeat()


@pytest.mark.parametrize(
    ("event", "parts"),
    [
        (restarts, ("MIMO_AP_RR: reads back as 5.25, expected 6.0",)),
        (clamps, ("MIMO_RP_RR: reads back as 0.1, expected 0.15",)),
        (is_written, ("MIMO_RP_RR: 0.5, after the vehicle reported 0.15",)),
        (arms, ("the vehicle was armed before the last reading", "although the vehicle was armed")),
    ],
)
def test_an_event_during_storage_is_rolled_back_with_exit_code_1(mimopilot, certified, old, new, event, parts):
    vehicle = StoringVehicle(old, event)
    with UdpVehicle(vehicle) as link:
        failed = upload(mimopilot, certified, link)
    assert_one_clear_line(failed, *parts, "the old values were restored and read back", code=1)
    assert vehicle.values == old


@pytest.mark.parametrize(("result", "word", "said"), [(2, "denied", "DENIED"), (4, "failed", "FAILED")])
def test_refused_storage_is_reported(mimopilot, certified, old, new, result, word, said):
    vehicle = ScriptedVehicle(old, storage=result)
    with UdpVehicle(vehicle) as link:
        failed = upload(mimopilot, certified, link, "--json")
        assert_one_clear_line(failed, "all values were read back, but not stored", f"MAV_RESULT_{said}", code=1)
        assert (json.loads(failed.stdout)["state"], json.loads(failed.stdout)["storage"]) == ("verified", word)
        assert held_gains(vehicle, new) == new
        vehicle.values.update(old)
        vehicle.fault, vehicle.faulty = "echoes one", "MIMO_RP_RR"
        failed = upload(mimopilot, certified, link)
        assert_one_clear_line(failed, "restored and read back; not stored", f"MAV_RESULT_{said}", code=1)


def test_a_second_vehicle_with_the_same_system_number_is_never_written(mimopilot, certified, old, new):
    first, second = ScriptedVehicle(old), ScriptedVehicle(new)
    with UdpVehicle(first) as link:
        other = UdpVehicle(second)
        other.ground = link.ground
        write, transmit, started, sent = first.write, other.transmit, [], []
        other.transmit = lambda data: sent.append(transmit(data))

        def appear(name, value):
            if first.writes == 9:
                started.append(other.__enter__())
                wait_for(lambda: sent)
            return write(name, value)

        first.write = appear
        try:
            failed = upload(mimopilot, certified, link)
        finally:
            assert started
            other.__exit__()
        addresses = [f"127.0.0.1:{vehicle.port_number}" for vehicle in (link, other)]
    assert_one_clear_line(failed, "system 1 is heard from two addresses", *addresses, "restored and read back", code=1)
    assert first.values == old
    assert (second.writes, second.stored, second.values) == (0, 0, new)


@pytest.mark.parametrize(
    ("autopilot", "kind", "profile", "parts"),
    [
        (3, 1, "mimo", ("a plane with ArduPilot", "no profile fits")),
        (12, 1, "px4-stock", ("a plane with PX4", "no profile fits")),
        (3, 10, "ardupilot-stock", ("a rover with ArduPilot", "no profile fits")),
        (12, 10, "mimo", ("a rover with PX4",)),
        (3, 2, "mimo", ("a quadrotor with ArduPilot", "the profile that fits is ardupilot-stock")),
        (3, 14, "px4-stock", ("an octorotor with ArduPilot", "the profile that fits is ardupilot-stock")),
        (12, 13, "ardupilot-stock", ("a hexarotor with PX4", "the profile that fits is px4-stock or mimo")),
        (0, 2, "px4-stock", ("a quadrotor with generic autopilot", "the profile that fits is mimo")),
    ],
)
def test_a_vehicle_that_does_not_fit_the_profile_is_refused_with_the_one_that_fits(
    mimopilot, certified, old, tmp_path, autopilot, kind, profile, parts
):
    vehicle = ScriptedVehicle(old)
    vehicle.autopilot, vehicle.type = autopilot, kind
    stock = () if profile == "mimo" else ("--profile", profile, "--moment-scale", "flown")
    gains = certified
    if stock:
        gains = tmp_path / "stock.gains.toml"
        stock_gains(profile).with_certificate(Certificate(Verdict.CERTIFIED, "examined")).save(gains)
    with UdpVehicle(vehicle) as link:
        refused = upload(mimopilot, gains, link, *stock)
    assert_one_clear_line(refused, *parts, "nothing was written")
    assert (vehicle.reads, vehicle.writes) == (0, 0)


def test_a_stock_px4_is_distinguished_from_a_vehicle_that_receives_nothing(mimopilot, certified):
    for values, parts, code in [
        ({"MC_ROLL_P": 6.5}, ("a quadrotor with PX4 and its stock controllers", "px4-stock"), 2),
        ({}, ("MIMO_AP_RR", "no answer in 2 s"), 1),
    ]:
        with UdpVehicle(ScriptedVehicle(values)) as link:
            refused = upload(mimopilot, certified, link, "--timeout", "2")
        assert_one_clear_line(refused, *parts, "nothing was written", code=code)


def test_a_slow_signing_clock_is_distinguished_from_another_key(mimopilot, certified, old, tmp_path):
    (tmp_path / "key").write_bytes(KEY)
    for key, late, parts in [
        (KEY, 3600.0, ("signed with this key, 36", "s behind this computer's clock")),
        (KEY[::-1], 0.0, ("not signed with this key",)),
    ]:
        with UdpVehicle(ScriptedVehicle(old), key=key, late=late) as link:
            refused = upload(mimopilot, certified, link, "--signing-key", "key", "--timeout", "2")
        assert_one_clear_line(refused, "no HEARTBEAT", *parts, code=1)


def test_an_incomplete_or_out_of_range_snapshot_is_refused_before_contacting_the_vehicle(
    mimopilot, certified, old, new, tmp_path
):
    vehicle = ScriptedVehicle(old)
    with UdpVehicle(vehicle) as link:
        assert upload(mimopilot, certified, link).returncode == 0
        text, reads, writes = (tmp_path / "my.before-1.params").read_text(), vehicle.reads, vehicle.writes
        lines = text.splitlines(keepends=True)
        unsealed = "".join(lines[1:])
        for content, parts in [
            ("".join(lines[:-5]), (f"holds {WRITTEN - 4} parameters, but its first line says {WRITTEN + 1}",)),
            (text[:-4], ("it was cut short",)),
            (text.replace("0.13125", "0.13126"), ("damaged or edited",)),
            ("".join(lines[1:-5]), (f"holds {REQUIRED - 1} of our {REQUIRED} gains", "lacks MIMO_D_POLE")),
            (unsealed.replace("\t0.13125001\t", "\t99\t"), ("MIMO_RP_RR: got 99, expected",)),
        ]:
            (tmp_path / "bad.params").write_text(content)
            refused = mimopilot("restore", "bad.params", "--connect", link.url, "--yes")
            assert_one_clear_line(refused, "bad.params", *parts)
            assert (vehicle.reads, vehicle.writes) == (reads, writes)
        (tmp_path / "bad.params").write_text("".join(line for line in lines[1:] if "MIMO_FW_ID" not in line))
        refused = mimopilot("restore", "bad.params", "--connect", link.url, "--yes")
        assert_one_clear_line(refused, "our gains without MIMO_FW_ID", "mimopilot upload", "nothing was written")
        assert vehicle.writes == writes
        (tmp_path / "unsealed.params").write_text(unsealed)
        assert mimopilot("restore", "unsealed.params", "--connect", link.url, "--yes").returncode == 0
        assert held_gains(vehicle, new) == {name: old[name] for name in new}
    assert read_parameters(tmp_path / "my.before-1.params") == {name: old[name] for name in (*new, "MIMO_FW_ID")}


def test_a_value_that_restore_would_refuse_is_not_overwritten(mimopilot, certified, old):
    vehicle = ScriptedVehicle(old | {"MIMO_RP_RR": 99.0})
    with UdpVehicle(vehicle) as link:
        refused = upload(mimopilot, certified, link)
    assert_one_clear_line(refused, "MIMO_RP_RR: the vehicle holds 99, expected", "set it by hand first")
    assert vehicle.writes == 0


@pytest.mark.parametrize("content", [b"", b"secret", bytes(31), b"zz" * 32, b"00" * 31])
def test_an_invalid_signing_key_is_refused(tmp_path, content):
    (tmp_path / "key").write_bytes(content)
    with pytest.raises(SitlError, match="not a signing key"):
        read_key(tmp_path / "key")


def test_gains_for_another_vehicle_are_refused_before_writing(mimopilot, certified, old, gains):
    for change, parts, extra in [
        ({"MIMO_TS": 0.002}, ("MIMO_TS: the vehicle has 0.002", "the gains are for 0.004"), ()),
        ({"MIMO_SCALE_P": 3.6}, ("moment_scale", "2.546, 2.546, 0.2736 N m per unit", "2.546, 3.6, 0.2736"), ()),
        ({}, ("moment_scale", "the vehicle has 1, 1, 1"), ("--moment-scale", "1,1,1")),
        ({"MIMO_RP_RR": float("nan")}, ("MIMO_RP_RR: the vehicle holds nan",), ()),
    ]:
        with UdpVehicle(ScriptedVehicle(old | change)) as link:
            refused = mimopilot("upload", certified, "--connect", link.url, "--yes", *extra)
            assert_one_clear_line(refused, *parts)
            assert link.vehicle.writes == 0


def test_uncertified_gains_are_refused_before_contacting_the_vehicle(mimopilot, gains, old, new, tmp_path):
    gains.save(tmp_path / "plain.gains.toml")
    unstable = Certificate(Verdict.UNSTABLE, "by this test")
    gains.with_certificate(unstable).save(tmp_path / "bad.gains.toml")
    with UdpVehicle(ScriptedVehicle(old)) as link:
        for name, word in (("plain", "no certificate"), ("bad", "unstable")):
            refused = mimopilot("upload", f"{name}.gains.toml", "--connect", link.url, "--yes")
            assert_one_clear_line(refused, word, "--uncertified")
            assert link.vehicle.reads == 0
        forced = mimopilot("upload", "plain.gains.toml", "--connect", link.url, "--yes", "--uncertified")
        assert forced.returncode == 0
        assert "never examined" in forced.stderr
        assert held_gains(link.vehicle, new) == new


URLS = ["udpin:127.0.0.1", "udpin:127.0.0.1:0", "tcp::1", "udpout:127.0.0.1:70000", "", "x", "/dev/null,fast"]


@pytest.mark.parametrize("url", URLS)
def test_an_invalid_url_is_refused_with_the_valid_forms(url):
    with pytest.raises(SitlError, match="expected udpin:HOST:PORT"):
        Connection(url)


def test_mistakes_are_one_clear_line(mimopilot, certified, tmp_path):
    (tmp_path / "empty.params").write_text("")
    for arguments, parts, code in [
        (("upload", certified, "--connect", "tcp:127.0.0.1:9"), ("no terminal to ask", "--yes"), 2),
        (("upload", certified, "--connect", "tcp:127.0.0.1:9", "--yes"), ("cannot be opened", "refused"), 1),
        (("upload", certified, "--connect", "/dev/nowhere,57600", "--yes"), ("/dev/nowhere", "cannot be opened"), 1),
        (("upload", certified, "--connect", "udpin:127.0.0.1:9999", "--yes", "--timeout", "3"), ("no HEARTBEAT",), 1),
        (("upload", certified, "--connect", "x", "--yes", "--moment-scale", "1,2"), ("--moment-scale: got '1,2'",), 2),
        (("upload", certified, "--connect", "x", "--yes", "--profile", "x"), ("--profile: got 'x'",), 2),
        (("upload", "none.toml", "--connect", "x"), ("none.toml",), 2),
        (("restore", "none.params", "--connect", "x"), ("none.params",), 2),
        (("restore", "empty.params", "--connect", "x"), ("holds no parameters",), 2),
        (("params",), ("give a gains file", "--connect"), 2),
        (("params", certified, "--format", "xml"), ("--format: got 'xml'", "mavproxy"), 2),
        (("params", certified, "--json"), ("--json",), 2),
        (("params", certified, "--connect", "x", "--out", "y"), ("--out",), 2),
        (("params", "--connect", "x", "--format", "c-header"), ("c-header",), 2),
    ]:
        assert_one_clear_line(mimopilot(*arguments), *parts, code=code)


def test_with_two_vehicles_on_a_link_system_must_be_given(mimopilot, certified, old, new):
    vehicle = ScriptedVehicle(old)
    beat = vehicle.heartbeat
    vehicle.heartbeat = lambda: [*beat(), *(m._replace(system=9) for m in beat())]
    with UdpVehicle(vehicle) as link:
        arguments = ("upload", certified, "--connect", link.url, "--yes")
        assert_one_clear_line(mimopilot(*arguments), "systems 1, 9", "--system")
        assert vehicle.writes == 0
        assert mimopilot(*arguments, "--system", "1").returncode == 0
        assert held_gains(vehicle, new) == new
