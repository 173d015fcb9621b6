"""The fault table: its figures computed by hand, its commands run again."""

import json
import shlex
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import binomtest

from mimopilot.sitl.autopilot.autopilot import RECORD
from mimopilot.sitl.errors import SitlError
from mimopilot.sitl.faults.kinds import parse_fault
from mimopilot.sitl.flight.fault_recovery import recovery
from mimopilot.sitl.flight.scenario import hover
from mimopilot.sitl.flight.simulator import TRUTH, Flight
from mimopilot.sitl.physics.airframe import load_airframe
from mimopilot.sitl.studies.fault_table import FaultTableRequest, fault_table
from mimopilot.sitl.studies.standard_faults import standard_faults
from tests.conftest import assert_one_clear_line

TS = 0.004
ADAM0 = FaultTableRequest("adam0", (), "roll", 15.0, 0.42)


def quiet(*faults):
    """An uneventful flight of 2 s to be modified; its rates never repeat."""
    scenario = replace(hover("roll", 2.0, TS), faults=tuple(map(parse_fault, faults)))
    record, truth = np.zeros(500, RECORD), np.zeros(500, TRUTH)
    record["rates"] = np.arange(500)[:, None]
    truth["position"][:, 2] = -10.0
    return Flight(scenario, record, truth, np.ones(500, np.int64))


def test_the_figures_are_those_of_their_definitions():
    sound, flight = quiet(), quiet("gyro-bias=0.1@0.4")
    flight.truth["attitude"][150:250, 1] = -np.radians(3.0)
    flight.truth["attitude"][150:300, 0] = np.radians(2.0)
    flight.truth["attitude"][300:, 0] = np.radians(0.9)
    flight.truth["attitude"][:100] = 1.0  # before the fault nothing counts
    flight.record["unallocated"][90:110, 2] = 1
    flight.record["moment"][3, 1] = 0.5
    flight.record["commands"][7, 5] = np.inf
    found = recovery(flight, sound)
    assert found.lost_at_s is None
    assert found.deviation_peak_deg == pytest.approx(3.0)
    assert found.deviation_rms_deg == pytest.approx(np.sqrt((100 * 9 + 50 * 4 + 200 * 0.81) / 400))
    assert found.recovery_s == pytest.approx(200 * TS)
    assert found.saturated_since == 10
    assert found.nonfinite == 1


def test_a_lost_vehicle_has_not_recovered_and_is_judged_up_to_its_loss():
    sound, flight = quiet(), quiet("motor:1=0@0.4")
    flight.truth["attitude"][200:, 0] = np.radians(70.0)
    flight.truth["attitude"][400:, 0] = np.radians(170.0)
    found = recovery(flight, sound)
    assert found.lost_at_s == pytest.approx((200 + 74) * TS)  # 0.3 s of it
    assert found.recovery_s is None
    assert found.deviation_peak_deg == pytest.approx(70.0)


def tell(flight, how):
    record = flight.record
    if how == "input":
        record["fault"][160:] = 64
    elif how == "clock":
        flight.runs[120:130] = 0
    elif how == "stuck":
        record["rates"][140:, 1] = 140.0
    elif how == "motors":
        record["unallocated"][150:, 0] = -1
    elif how == "altitude":
        flight.truth["position"][140:, 2] = -7.9
    elif how == "attitude":
        record["attitude"][150:, 1] = -1.1
    return flight


@pytest.mark.parametrize(
    ("how", "sample"),
    # The tick after the gap; the 25th repetition; the 25th sample without authority; 0.3 s beyond 60 degrees.
    [
        ("input", 160),
        ("clock", 130),
        ("stuck", 165),
        ("motors", 174),
        ("altitude", 140),
        ("attitude", 224),
        ("set-point", 225),
    ],
)
def test_each_fault_is_detected_at_the_first_possible_sample(how, sample):
    fault = "stale@0.4" if how == "set-point" else "gyro-noise=1@0.4"
    flight = tell(quiet(fault), how)
    found = recovery(flight, quiet())
    assert found.detected_by == how
    assert found.detected_s == pytest.approx((sample - 100) * TS)


def test_short_disturbances_are_not_detections():
    flight = quiet("stale@0.4+0.5")
    flight.record["unallocated"][150:174, 0] = 1
    flight.record["unallocated"][174:190, 1] = 1
    flight.record["rates"][200:225, 2] = 7
    flight.record["attitude"][300:374, 0] = 1.1
    flight.truth["position"][300:374, 2] = -8.1
    found = recovery(flight, quiet())
    assert (found.detected_s, found.detected_by) == (None, "")


@pytest.fixture(scope="module")
def table():
    return fault_table(ADAM0, range(12), workers=1)


def test_the_table_is_the_same_for_any_number_of_workers(table):
    assert fault_table(ADAM0, range(12), workers=2) == table


def test_every_fault_is_flown_with_every_seed_and_all_outputs_are_finite(table):
    assert [row.fault for row in table.rows] == [str(f) for f in standard_faults(load_airframe("adam0").airframe)]
    assert {row.fault.split(":")[0].split("=")[0].split("@")[0] for row in table.rows} == {
        *("motor", "battery", "mass", "delay", "jitter", "loss", "duplicate", "skip", "clock", "link", "stale"),
        *("gyro-stuck", "gyro-bias", "gyro-noise", "gyro-nan", "gain"),
    }
    assert {row.runs for row in table.rows} == {12}
    assert table.nonfinite == 0
    assert table.lost_without == {"default": 0}
    assert table.alarms_without == {"default": 0}


def rows(table):
    return {row.fault.split("@")[0] if "+" not in row.fault else row.fault: row for row in table.rows}


def test_a_vehicle_without_a_motor_is_always_detected_and_lost(table):
    row = rows(table)["motor:3=0"]
    assert (row.survived, row.detected) == (0, 12)
    bounds = binomtest(0, 12).proportion_ci(method="wilson")
    assert row.survival_interval == pytest.approx((bounds.low, bounds.high))
    assert row.detected_by == "motors"
    assert row.recovered == 0
    assert row.detected_s < 0.5


def test_larger_faults_cause_larger_deviations(table):
    peak = {name: row.peak_deg for name, row in rows(table).items()}
    for names in (
        ("motor:3=0.9", "motor:3=0.7", "motor:3=0.5", "motor:3=0"),
        ("delay=0.02", "delay=0.028", "delay=0.036"),
        ("gyro-stuck@1.1+0.1", "gyro-stuck@1.1+0.2", "gyro-stuck@1.1+0.4"),
        ("gain:Kp_i=0.5", "gain:Kp_i=0.25"),
        ("gain:Kp_i=2", "gain:Kp_i=4"),
        ("gyro-nan@1.1+0.001", "gyro-nan@1.1+0.2"),
    ):
        sizes = [peak[name] for name in names]
        assert sizes == sorted(sizes), names
    assert peak["gyro-nan@1.1+0.001"] < 0.1
    # 0.2 rad/s over Kp_o = 6.5 1/s.
    assert peak["gyro-bias:roll=0.2"] == pytest.approx(np.degrees(0.2 / 6.5), rel=0.03)


def test_detectable_faults_are_detected_in_time(table):
    found = rows(table)
    known = {"skip=5": "clock", "link@1.1+0.2": "clock", "stale@1.1+1": "set-point", "gyro-stuck@1.1+0.2": "stuck"}
    for name, how in known.items():
        assert found[name].detected == 12
        assert found[name].detected_by == how
    # 25 samples are replaced by the last good one, the next raises the flag.
    assert found["gyro-nan@1.1+0.2"].detected_by == "input"
    assert found["gyro-nan@1.1+0.2"].detected_s == pytest.approx(25 * TS)
    assert found["gyro-bias:roll=0.2"].detected == 0


@pytest.mark.parametrize("name", ["motor:3=0", "loss=0.5", "gain:Kp_i=0.25"])
def test_the_printed_command_repeats_the_flight_with_the_worst_seed(mimopilot, table, name):
    row = rows(table)[name]
    program, *words = shlex.split(row.replay)
    assert program == "mimopilot"
    result = mimopilot(*words, "--json")
    assert result.returncode == (1 if name == "motor:3=0" else 0)
    found = json.loads(result.stdout)
    assert found["seed"] == row.worst_seed
    assert found["deviation_peak_deg"] == row.worst_peak_deg
    assert (found["lost_at_s"] is None) == (name != "motor:3=0")


def test_gain_sets_are_compared_and_the_command_prints_the_same_table(mimopilot, tmp_path):
    own = load_airframe("adam0").default_gains()
    own.save(tmp_path / "one.gains.toml")
    replace(own, Kp_i=0.5 * own.Kp_i).save(tmp_path / "half.gains.toml")
    files = ("--gains", "one.gains.toml", "--gains", "half.gains.toml")
    result = mimopilot("faults", "adam0", *files, "--runs", 3, "--fault", "motor:3=0.7@1.1", "--fault", "loss=0.5@1.1")
    assert result.returncode == 0, result.stderr
    lines = [line.split()[:3] for line in result.stdout.splitlines() if line.startswith((" motor", " loss"))]
    assert lines == [[f, g, "3/3"] for f in ("motor:3=0.7@1.1", "loss=0.5@1.1") for g in ("one", "half")]
    assert "mimopilot fly adam0 --gains half.gains.toml --axis roll" in result.stdout
    found = json.loads(mimopilot("faults", "adam0", "--runs", 3, "--fault", "loss=0.5@1.1", "--json").stdout)
    table = fault_table(replace(ADAM0, faults=(parse_fault("loss=0.5@1.1"),)), range(3), workers=1)
    assert found == json.loads(json.dumps(table.as_json()))


def test_two_gain_files_of_one_name_and_an_impossible_fault_are_refused(mimopilot, tmp_path):
    own = load_airframe("adam0").default_gains()
    for folder in ("a", "b"):
        own.save(tmp_path / folder / "x.gains.toml")
    twice = mimopilot("faults", "adam0", "--gains", "a/x.gains.toml", "--gains", "b/x.gains.toml")
    assert_one_clear_line(twice, "--gains", "same name")
    with pytest.raises(SitlError, match="has motors 1 to 4"):
        fault_table(replace(ADAM0, faults=(parse_fault("motor:9=0@1"),)), range(2), workers=2)
