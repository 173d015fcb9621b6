"""Crazyflie's logs: signs and units, the reasons of refusals, damage."""

import re
import struct
import zlib

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mimopilot.tuning.crazyflie_names import LOG_VARIABLES
from mimopilot.tuning.errors import TuningError
from mimopilot.tuning.logs.crazyflie import LAYOUTS, YAW_LAYOUTS, record_usd
from mimopilot.tuning.logs.crazyflie_file import read_usd_log
from mimopilot.tuning.logs.inspection import inspect_log
from mimopilot.tuning.logs.reader import open_log, read_log, unchecked_experiment
from tests.conftest import assert_one_clear_line
from tests.tuning.logs.crazyflie_logs import mimo_variables, stock_variables, usd_bytes, write_csv_block
from tests.tuning.logs.flights import make_flight, pulses


@pytest.fixture(scope="module")
def flight():
    return make_flight(8.0, Ts=0.002, inject=lambda t: pulses(t, begin=11.0))


def written(path, content):
    path.write_bytes(content)
    return path


@pytest.mark.parametrize("version", [1, 2])
def test_a_usd_log_of_our_controller_is_an_experiment_at_500_hz(flight, tmp_path, version):
    events = [(7, "estTDOA", 12.0), (7, "estTDOA", 12.0005)]
    path = written(tmp_path / "log00", usd_bytes(flight.t, mimo_variables(flight), version, events))
    experiment = read_log(path)
    assert experiment.Ts == pytest.approx(0.002, rel=1e-6)
    assert experiment.warnings == ()
    # The experiment begins with the excitation.
    first = int(np.argmax(np.abs(flight.u_bar).max(axis=1) > 0))
    used = slice(first, first + len(experiment.u))
    for name in ("u", "u_bar", "y_i", "y_o", "r_o"):
        assert getattr(experiment, name) == pytest.approx(getattr(flight, name)[used], abs=1e-6)


def test_our_log_variables_are_those_that_the_firmware_has():
    names = {f"mimo.{variable.name}" for variable in LOG_VARIABLES}
    read = {name for places in (*LAYOUTS.values(), *YAW_LAYOUTS.values()) for place in places for name, _ in place}
    assert {name for name in read if name.startswith("mimo.")} <= names
    assert "mimo.state" in names


def test_every_axis_of_the_stock_firmware_has_its_sign_and_unit(tmp_path):
    # By hand, for a vehicle that rolls right, pitches up and yaws left: gyro x > 0, y (left) < 0, z (up) > 0; angles of
    # the firmware: roll > 0, pitch > 0 (nose up: inverted), yaw > 0 (left). FRD: yaw to the left is negative.
    values = {
        "gyro.x": 180.0,
        "gyro.y": -90.0,
        "gyro.z": 45.0,
        "stabilizer.roll": 90.0,
        "stabilizer.pitch": 45.0,
        "stabilizer.yaw": 30.0,
        "controller.roll": 9.0,
        "controller.pitch": 18.0,
        "controller.yaw": 36.0,
        "controller.rollRate": 90.0,
        "controller.pitchRate": 18.0,
        "controller.yawRate": 9.0,
        # Both left motors up, both front motors up, both motors that turn counterclockwise up (body turns right).
        "controller.cmd_roll": 13107.0,
        "controller.cmd_pitch": 6553.5,
        "controller.cmd_yaw": 3276.75,
        "controller.r_roll": 1.0,
    }
    time = np.arange(5) * 0.002
    path = written(tmp_path / "log00", usd_bytes(time, {name: ("f", np.full(5, v)) for name, v in values.items()}))
    found = record_usd(path)
    pi = np.pi
    expected = {
        "u": (0.2, 0.1, 0.1),
        "y_i": (pi, pi / 2, -pi / 4),
        "y_o": (pi / 2, pi / 4, -pi / 6),
        "r_o": (pi / 20, pi / 10, -pi / 5),
        "r_i": (pi / 2, pi / 10, -pi / 20),
    }
    for name, (roll, pitch, yaw) in expected.items():
        assert found.signals[name].values[0] == pytest.approx((roll, pitch), rel=1e-6), name
        assert found.yaw[name].values[0] == pytest.approx((yaw,), rel=1e-6), name
    assert "u_bar" not in found.signals


def test_a_stock_flight_is_read_with_the_true_reason_why_it_cannot_be_tuned(flight, tmp_path):
    path = written(tmp_path / "log00", usd_bytes(flight.t, stock_variables(flight)))
    experiment = read_log(path)
    assert experiment.y_i == pytest.approx(flight.y_i[: len(experiment.y_i)], abs=1e-5)
    assert experiment.u_bar is None
    some = {name: values for name, values in stock_variables(flight).items() if "cmd" not in name}
    with pytest.raises(TuningError, match=r"lacks mimo.uR and mimo.uP or controller.cmd_roll and .*config.txt.*gyro.x"):
        read_log(written(tmp_path / "log01", usd_bytes(flight.t, some)))


def test_a_log_of_our_variables_while_the_stock_pid_flew_is_no_experiment_of_ours(flight, tmp_path):
    off = mimo_variables(flight) | {"mimo.state": ("B", np.zeros(len(flight.t), int))}
    with pytest.raises(TuningError, match=r"lacks controller.cmd_roll.*the stock PID flew.*set mimo.EN to 1"):
        read_log(written(tmp_path / "log00", usd_bytes(flight.t, off)))
    both = off | stock_variables(flight)
    found = read_log(written(tmp_path / "log01", usd_bytes(flight.t, both)))
    assert found.u_bar is None
    assert any("the stock PID flew" in warning for warning in found.warnings)
    wrong = off | {"mimo.state": ("B", np.full(len(flight.t), 5))}
    with pytest.raises(TuningError, match=r"mimo.state is 5: the gains are for another rate"):
        read_log(written(tmp_path / "log02", usd_bytes(flight.t, wrong)))


@pytest.fixture
def flown_twice(flight, tmp_path):
    """Reads a log of a flight from 2 s to 4 s after its begin, and one from 5 s on, with this state in each."""

    def read(first, second, between=0):
        since = flight.t - flight.t[0]
        state = np.select([since < 3.9, since < 5.0], [first, between], second)
        flying = ((since > 2.0) & (since < 4.0)) | (since > 5.0)
        added = {"mimo.state": ("B", state), "supervisor.info": ("H", np.where(flying, 0x1F, 0x0F))}
        return open_log(written(tmp_path / "log00", usd_bytes(flight.t, mimo_variables(flight) | added))), flight.t[0]

    return read


def test_a_flight_of_the_stock_pid_beside_one_of_ours_is_not_used(flown_twice):
    found, begin = flown_twice(0, 1)
    assert found.airborne == ((pytest.approx(begin + 5.0, abs=0.003), np.inf),)
    assert found.evidence == "supervisor.info and mimo.state"
    assert any(re.search("the stock PID flew for [34]. % of the flight", warning) for warning in found.warnings)


@pytest.mark.parametrize(("first", "second"), [(0, 4), (0, 0)])
def test_a_switch_that_waits_for_the_ground_does_not_fly_our_controller(flown_twice, first, second):
    found, _ = flown_twice(first, second)
    assert "u" not in found.signals
    assert any("the stock PID flew, our controller gave no torque" in warning for warning in found.warnings)


def test_a_switch_off_that_waits_for_the_ground_still_flies_our_controller(flown_twice):
    found, _ = flown_twice(1, 4, between=1)
    assert "u" in found.signals and not found.warnings and len(found.airborne) == 2


def test_what_flew_while_a_switch_waits_from_the_begin_of_the_log_on_is_not_known(flown_twice):
    found, _ = flown_twice(4, 4, between=4)
    assert "u" not in found.signals and any("state is 4 from the begin of the log on" in one for one in found.warnings)
    found, begin = flown_twice(4, 1)  # off on the ground
    assert found.airborne == ((pytest.approx(begin + 5.0, abs=0.003), np.inf),)
    assert any("does not tell whether our controller flew" in one and "not used" in one for one in found.warnings)


def test_a_set_stored_for_another_firmware_leaves_the_stock_pid_flying(flown_twice):
    found, _ = flown_twice(6, 6, between=6)
    assert "u" not in found.signals and any("the stock PID flew" in one for one in found.warnings)


def test_a_part_that_flies_rates_has_no_attitude_setpoint_and_is_not_used(flight, tmp_path):
    variables, rates = mimo_variables(flight), (flight.t > flight.t[0] + 5.0) & (flight.t < flight.t[0] + 7.0)
    for name in ("mimo.rollSp", "mimo.pitchSp"):
        variables[name] = "f", np.where(rates, np.nan, variables[name][1])
    found = unchecked_experiment(open_log(written(tmp_path / "log01", usd_bytes(flight.t, variables))))
    (_, before), (after, _) = found.segments
    assert after - before == np.count_nonzero(rates)
    assert any("rollSp is NaN for 25 % of the log: rates were flown" in one for one in found.warnings)
    variables |= {name: ("f", np.full(len(flight.t), np.nan)) for name in ("mimo.rollSp", "mimo.pitchSp")}
    found = read_log(written(tmp_path / "log02", usd_bytes(flight.t, variables)))
    assert found.r_o is None and any("NaN for 100 % of the log: rates" in one for one in found.warnings)


@pytest.mark.parametrize(("state", "why"), [(2, "a parameter had changed since"), (3, "the parameters were refused")])
def test_a_log_of_another_set_than_the_parameters_says_so(flown_twice, state, why):
    found, _ = flown_twice(state, state, between=state)
    assert any(f"mimo.state is {state} for 100 % of the flight: {why}" in warning for warning in found.warnings)


@pytest.mark.parametrize(("name", "letter", "value"), [("supervisor.info", "H", 0x1F), ("sys.isFlying", "B", 1)])
def test_the_time_in_the_air_is_the_supervisors(flight, tmp_path, name, letter, value):
    flying = (flight.t > 11.0) & (flight.t < 15.0)
    state = {name: (letter, np.where(flying, value, value & 0xF if value > 1 else 0))}
    found = open_log(written(tmp_path / "log00", usd_bytes(flight.t, mimo_variables(flight) | state)))
    assert found.evidence == name
    assert found.airborne == ((pytest.approx(11.0, abs=0.003), pytest.approx(15.0, abs=0.003)),)


def test_log_blocks_of_one_connection_are_read_together(flight, tmp_path):
    variables = mimo_variables(flight)
    parts = [("uR", "uP", "p", "q", "roll", "pitch"), ("ubR", "ubP", "rollSp", "pitchSp")]
    paths = [
        write_csv_block(
            tmp_path / f"{number}-20261129T20-00-00.csv",
            flight.t,
            {f"mimo.{name}": variables[f"mimo.{name}"] for name in part},
            every=5,
        )
        for number, part in enumerate(parts)
    ]
    write_csv_block(tmp_path / "another.csv", flight.t + 1000, variables)
    found = open_log(paths[0])
    assert found.signals.keys() == {"u", "y_i", "y_o", "r_o", "u_bar"}
    assert found.beside == (paths[1],)
    experiment = read_log(paths[0])
    assert experiment.Ts == pytest.approx(0.01)
    paths[1].write_text(paths[1].read_text().replace("mimo.ubR", "mimo.ubX"))
    assert read_log(paths[0]).sha256 != experiment.sha256
    paths[1].write_text(paths[1].read_text().replace("\n", "\nx", 1))
    alone = read_log(paths[0])
    assert alone.u_bar is None
    assert any(f"not read: {paths[1].name}, line 2" in warning for warning in alone.warnings)


def test_a_slow_or_incomplete_block_is_refused_with_what_to_do(flight, tmp_path):
    variables = mimo_variables(flight)
    path = write_csv_block(tmp_path / "slow.csv", flight.t, variables, every=10)
    with pytest.raises(TuningError, match=r"too slow: .*50.0 Hz.*26 bytes a block.*uSD deck"):
        read_log(path)
    path.write_text("Timestamp,stabilizer.roll,stabilizer.pitch\n10,1.5,2\n20,2,3\n")
    with pytest.raises(TuningError, match=r"lacks mimo.uR and mimo.uP or .*gyro.x and gyro.y"):
        read_log(path)
    assert inspect_log(path).seconds == pytest.approx(0.01)


def rearranged(text):
    return "".join(",".join([*cells[1:], cells[0]]) + "\n" for cells in (line.split(",") for line in text.splitlines()))


@pytest.mark.parametrize(
    "change",
    [
        lambda text: "\ufeff" + text.replace("\n", "\r\n"),
        lambda text: text.replace(",", ";").replace(".", ",").replace("mimo,", "mimo."),  # with a decimal comma
        lambda text: text.replace(",", "\t"),
        lambda text: '"' + text.strip().replace(",", '","').replace("\n", '"\n"') + '"\n',
        rearranged,
    ],
)
def test_a_csv_file_that_a_spreadsheet_has_written_is_the_same(flight, tmp_path, change):
    path = write_csv_block(tmp_path / "a.csv", flight.t, mimo_variables(flight), every=5)
    expected = open_log(path)
    path.write_text(change(path.read_text()), "utf-8")
    found = open_log(path)
    assert found.signals.keys() == expected.signals.keys()
    for name, series in found.signals.items():
        assert (series.values == expected.signals[name].values).all()
        assert (series.time == expected.signals[name].time).all()


def test_a_csv_file_of_two_logs_or_with_ambiguous_commas_is_refused(flight, tmp_path):
    path = write_csv_block(tmp_path / "a.csv", flight.t, mimo_variables(flight), every=100)
    text = path.read_text()
    path.write_text(text + text)
    with pytest.raises(TuningError, match="another log begins at line 42"):
        open_log(path)
    path.write_text(text.replace(".", ",").replace("mimo,", "mimo."))
    with pytest.raises(TuningError, match=r"line 2: its numbers have a decimal comma, the mark that separates"):
        open_log(path)


def test_time_stamps_of_an_sd_card_log_that_begin_again_go_on(flight, tmp_path):
    data = bytearray(usd_bytes(flight.t, {"mimo.p": ("f", flight.y_i[:, 0])}, version=1))
    row = struct.calcsize("<HIf")
    for place in range(len(data) - 4 - row * len(flight.t), len(data) - 4, row):
        (time,) = struct.unpack_from("<I", data, place + 2)
        struct.pack_into("<I", data, place + 2, (time - 15_000) % 2**32)
    data[-4:] = struct.pack("<I", zlib.crc32(data[:-4]))
    (block,) = read_usd_log(written(tmp_path / "log00", bytes(data)))
    assert np.diff(block.time) == pytest.approx(np.full(len(flight.t) - 1, 0.002), abs=0.0011)


def test_a_csv_file_that_ends_within_a_line_is_used_up_to_there_and_other_damage_is_refused(flight, tmp_path):
    path = write_csv_block(tmp_path / "a.csv", flight.t, mimo_variables(flight), every=2)
    whole = path.read_text()
    path.write_text(whole[:-40])
    assert any("the file ends inside a message" in warning for warning in read_log(path).warnings)
    path.write_text(whole.replace("\n", "\nx", 1))
    with pytest.raises(TuningError, match=r"a.csv, line 2: expected 11 numbers"):
        read_log(path)
    path.write_bytes(whole.encode().replace(b"0.", b"\xff.", 1))
    with pytest.raises(TuningError, match=r"a.csv: not a text: byte"):
        read_log(path)
    path.write_text(whole.splitlines()[0] + "\n")
    with pytest.raises(TuningError, match=r"no samples below the header line"):
        read_log(path)


def test_time_stamps_that_begin_again_after_24_bits_go_on_and_a_status_that_is_no_number_is_no_flight(tmp_path):
    status = ("f", np.array([0x1F, 0x1F, np.nan, 0x0F]))
    path = write_csv_block(tmp_path / "a.csv", 16777.210 + 0.01 * np.arange(4), {"supervisor.info": status})
    path.write_text(path.read_text().replace("16777220", "4").replace("16777230", "14").replace("16777240", "24"))
    found = open_log(path)
    assert found.span == pytest.approx((16777.21, 16777.24))
    assert found.airborne == ((-np.inf, pytest.approx(16777.23)),)


LITTLE = usd_bytes(np.arange(4) * 0.002, {"gyro.x": ("f", np.arange(4.0)), "sys.isFlying": ("B", np.ones(4, int))})


@given(st.integers(0, len(LITTLE) - 1), st.integers(1, 255), st.booleans(), st.booleans())
@settings(max_examples=60, deadline=None)
def test_any_damage_of_a_usd_log_is_one_message(tmp_path_factory, place, bits, cut, sealed):
    """Cut, or one byte changed; also if the checksum were right by accident."""
    data = bytearray(LITTLE[: place + 1] if cut else LITTLE)
    if not cut:
        data[place] ^= bits
    if sealed and len(data) > 4:
        data[-4:] = struct.pack("<I", zlib.crc32(data[:-4]))
    path = tmp_path_factory.getbasetemp() / "damaged"
    path.write_bytes(data)
    try:
        open_log(path)
        assert sealed or bytes(data) == LITTLE
    except TuningError as error:
        assert str(path) in str(error)
        assert "\n" not in str(error)


def test_a_damaged_or_later_log_ends_the_command_with_one_line(mimopilot, tmp_path):
    written(tmp_path / "log00", LITTLE[:-9])
    assert_one_clear_line(mimopilot("inspect", "log00"), "log00", "the checksum at its end is wrong", "usd.logging")
    written(tmp_path / "log01", b"\xbc\x03" + LITTLE[2:])
    assert_one_clear_line(mimopilot("tune", "log01", "--out", "x"), "version 3, known are 1 and 2")
