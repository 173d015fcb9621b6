import json

import numpy as np
import pytest

from mimopilot.tuning.logs.inspection import inspect_log
from tests.conftest import assert_one_clear_line
from tests.tuning.logs.flights import (
    ardupilot_messages,
    dataflash_bytes,
    injected,
    make_flight,
    microseconds,
    px4_topics,
    table,
    write_csv,
    write_ulog,
)


@pytest.fixture(scope="module")
def flight():
    return make_flight(20.0)


def test_rates_gaps_ranges_and_saturation_are_those_of_the_log(tmp_path, flight):
    keep = (flight.t < 13) | (flight.t > 13.164)
    topics = px4_topics(flight)
    u = flight.u.copy()
    u[:200, 1] = 1.0
    topics[0][2]["xyz"][:, :2] = u
    topics[0] = (*topics[0][:2], {name: values[keep] for name, values in topics[0][2].items()})
    found = inspect_log(write_ulog(tmp_path / "x.ulg", topics))
    torque = found.signals["u"]
    assert torque.source == "vehicle_torque_setpoint"
    assert torque.rate_hz == pytest.approx(250)
    assert torque.gaps == 1
    assert torque.longest_gap_s == pytest.approx(0.168, abs=0.005)
    assert torque.saturated == pytest.approx((0, 200 / keep.sum()), abs=1e-3)
    assert found.signals["y_o"].maximum == pytest.approx(flight.y_o.max(axis=0), abs=1e-6)
    assert found.seconds == pytest.approx(20, abs=0.01)
    assert len(found.experiment.segments) == 2
    assert found.reason is None


def test_setpoint_rates_are_those_of_the_log_even_if_few_setpoints_are_used(tmp_path, flight):
    topics = px4_topics(flight)
    slow = {name: values[::10] for name, values in topics[0][2].items()}
    topics[0] = (*topics[0][:2], slow)
    found = inspect_log(write_ulog(tmp_path / "x.ulg", topics))
    assert found.signals["u"].rate_hz == pytest.approx(25)
    assert found.signals["r_o"].rate_hz == pytest.approx(250)
    assert found.signals["r_o"].longest_gap_s == pytest.approx(0.004)


def test_a_log_without_signals_is_as_long_as_its_messages(tmp_path, flight):
    stamps = microseconds(flight.t[::25])
    barometer = ("BARO", "Qf", ("TimeUS", "Alt"), [stamps, np.zeros(len(stamps))])
    events = ("EV", "QB", ("TimeUS", "Id"), [microseconds([12.0, 18.0]), [28, 18]])
    (tmp_path / "x.bin").write_bytes(dataflash_bytes([barometer, events]))
    found = inspect_log(tmp_path / "x.bin")
    assert found.seconds == pytest.approx(19.9)
    assert found.airborne == ((2.0, 8.0),)
    stamps = {"timestamp": microseconds(flight.t[:500]), "landed": np.zeros(500, np.uint8)}
    found = inspect_log(write_ulog(tmp_path / "x.ulg", [("vehicle_land_detected", 0, stamps)]))
    assert found.seconds == pytest.approx(1.996)
    assert found.airborne == ((0.0, pytest.approx(1.996)),)


def test_band_and_rms_of_the_excitation_are_given_for_each_axis(tmp_path):
    def both(t):
        noise = 0.02 * np.random.default_rng(0).standard_normal(len(t))
        return np.column_stack([0.1 * np.sin(2 * np.pi * 4 * t), noise])

    flight = make_flight(20.0, inject=both)
    found = inspect_log(write_ulog(tmp_path / "x.ulg", px4_topics(flight, debug_vect=injected(flight))))
    roll, pitch = found.excitation["u_bar roll"], found.excitation["u_bar pitch"]
    assert roll.rms == pytest.approx(0.0707, rel=0.01)
    assert roll.band_hz == pytest.approx((4, 4), abs=0.2)
    assert pitch.rms == pytest.approx(0.02, rel=0.05)
    assert pitch.band_hz == pytest.approx((6.25, 118.75), abs=3)


def test_an_axis_that_is_not_excited_is_the_reason(tmp_path, flight):
    columns = table(flight)
    columns["pitch_sp"] = np.zeros(len(flight.t))
    found = inspect_log(write_csv(tmp_path / "x.csv", columns))
    assert found.reason.startswith("not excited on pitch")
    assert found.experiment is not None


def test_a_log_without_setpoints_and_injection_cannot_be_used_for_tuning(tmp_path, flight):
    columns = {name: values for name, values in table(flight).items() if not name.endswith("_sp")}
    assert "no excitation" in inspect_log(write_csv(tmp_path / "x.csv", columns)).reason


def test_the_command_prints_signals_and_reason_and_exits_with_0_when_the_log_can_be_read(mimopilot, tmp_path, flight):
    stamps = microseconds(flight.t[::25])
    pidr = ("PIDR", "Qf", ("TimeUS", "Act"), [stamps, np.zeros(len(stamps))])
    (tmp_path / "x.bin").write_bytes(dataflash_bytes([pidr]))
    result = mimopilot("inspect", "x.bin")
    assert result.returncode == 0, result.stderr
    assert "torque u" in result.stdout
    assert "not logged" in result.stdout
    assert "gains cannot be tuned from it: lacks message RATE" in result.stdout
    assert "LOG_BITMASK" in result.stdout


def test_the_command_prints_one_json_object(mimopilot, tmp_path, flight):
    (tmp_path / "x.bin").write_bytes(dataflash_bytes(ardupilot_messages(flight)))
    result = mimopilot("inspect", "x.bin", "--json")
    assert result.returncode == 0, result.stderr
    found = json.loads(result.stdout)
    assert found["tunable"] is True
    assert found["reason"] is None
    assert found["signals"]["u"]["source"] == "RATE"
    assert found["signals"]["y_o"]["source"] == "ANG"
    assert found["experiment"]["Ts"] == 0.004
    assert found["excitation"]["r_o roll"]["rms"] == pytest.approx(0.2, rel=0.05)
    assert found["flown"] is None


def test_the_column_file_is_used_by_inspect_and_by_tune(mimopilot, tmp_path, flight):
    columns = table(flight)
    columns["gx"] = np.degrees(columns.pop("p"))
    write_csv(tmp_path / "x.csv", columns)
    (tmp_path / "c.toml").write_text('p = { column = "gx", unit = "deg/s" }\n')
    assert_one_clear_line(mimopilot("tune", "x.csv", "--out", "x.toml"), "lacks column p and q")
    found = json.loads(mimopilot("inspect", "x.csv", "--columns", "c.toml", "--json").stdout)
    assert found["signals"]["y_i"]["maximum"] == pytest.approx(flight.y_i.max(axis=0).tolist(), rel=1e-6)
    # With known columns, the next missing item is requested.
    result = mimopilot("tune", "x.csv", "--columns", "c.toml", "--out", "x.toml")
    assert_one_clear_line(result, "which yaw gains flew", "derivative_cutoff_hz", "--spec")


def test_a_file_that_cannot_be_read_is_one_clear_line(mimopilot, tmp_path):
    (tmp_path / "x.mat").write_bytes(b"MATLAB 5.0 MAT-file" + bytes(40))
    assert_one_clear_line(mimopilot("inspect", "x.mat"), "x.mat", "damaged MATLAB file")
    (tmp_path / "x.bin").write_bytes(bytes(100))
    assert_one_clear_line(mimopilot("inspect", "x.bin", "--json"), "x.bin", "not a flight log")
