"""Logs of Betaflight and INDIflight as the usual tools decode them to CSV."""

import dataclasses
import math

import numpy as np
import pytest

from mimopilot.tuning.design.many_logs import find_logs
from mimopilot.tuning.errors import TuningError
from mimopilot.tuning.logs.flown_gains import flown_gains
from mimopilot.tuning.logs.inspection import inspect_log
from mimopilot.tuning.logs.reader import open_log, read_log
from tests.tuning.logs.blackbox_logs import (
    SETTINGS,
    TS,
    betaflight_flight,
    quaternion,
    table,
    write_decoded,
    write_exported,
)

FRD = np.array([1.0, -1.0])


@pytest.fixture(scope="module")
def flight():
    return betaflight_flight()


@pytest.fixture(scope="module")
def log(flight, tmp_path_factory):
    """As blackbox_decode --save-headers writes it."""
    return write_decoded(tmp_path_factory.mktemp("log") / "btfl.01.csv", table(flight), settings=SETTINGS)


def short(flight, seconds=1.0):
    """The first part of a flight, for readers that do not need all of it."""
    count = round(seconds / TS)
    return dataclasses.replace(flight, **{name: values[2000 : 2000 + count] for name, values in vars(flight).items()})


def test_torque_rates_and_angles_are_in_si_units_forward_right_down(flight, log):
    signals = open_log(log).signals
    np.testing.assert_allclose(signals["u"].values, flight.torque, atol=1e-12)
    np.testing.assert_allclose(signals["y_i"].values, np.radians(flight.rates) * FRD, atol=np.radians(0.51))
    np.testing.assert_allclose(signals["y_o"].values, flight.angles * FRD, atol=2e-4)
    np.testing.assert_allclose(signals["r_i"].values, np.radians(flight.setpoint) * FRD, atol=np.radians(0.51))
    np.testing.assert_allclose(signals["u"].time, flight.t, atol=1e-9)


def test_the_chirp_is_the_injected_rate_and_the_log_can_be_tuned_from(log):
    found = inspect_log(log)
    assert found.reason is None
    assert found.external == {"roll": "r_bar", "pitch": "r_bar"}
    assert found.experiment.amplitude < math.radians(60)
    acceleration = np.gradient(found.experiment.y_i, found.experiment.Ts, axis=0)
    for axis in range(2):
        assert np.corrcoef(found.experiment.u[:-1, axis], acceleration[1:, axis])[0, 1] > 0.5


def test_the_injected_rate_has_the_size_and_shape_of_the_setpoint(flight, log):
    """By the header's amplitude; without a header by the setpoint itself."""
    bare = write_decoded(log.with_name("bare.csv"), table(flight))
    for path, tolerance in ((log, 0.05), (bare, 0.15)):
        signals = open_log(path).signals
        part, whole = signals["r_bar"].values, signals["r_i"].values + 2.0 * signals["y_o"].values
        for axis in range(2):
            on = part[:, axis] != 0
            error = part[on, axis] - whole[on, axis]
            assert np.sqrt(np.mean(error**2)) < tolerance * np.std(whole[on, axis])


def test_a_chirp_of_which_only_the_phase_is_logged_is_found(flight, log):
    columns = table(flight)
    columns |= {f"debug[{i}]": 0 * columns["time"] for i in (1, 2, 3)}
    part = open_log(write_decoded(log.with_name("phase.csv"), columns)).signals["r_bar"].values
    known = open_log(log).signals["r_bar"].values
    for axis in range(2):
        assert np.corrcoef(part[:, axis], known[:, axis])[0, 1] > 0.95


@pytest.mark.parametrize("factor", [3.0, 0.1])
def test_another_debug_mode_is_no_chirp(flight, log, factor):
    columns = table(short(flight, 4.0))
    columns |= {f"debug[{i}]": np.round(factor * 500 * np.sin(columns["time"] * 1e-6 * (i + 1))) for i in range(4)}
    found = open_log(write_decoded(log.with_name("other.csv"), columns))
    assert "r_bar" not in found.signals
    assert "no chirp in debug[0] to debug[3]" in found.warnings[0]


@pytest.mark.parametrize("unit", ["deg/s", "rad/s", "ms", "s", "explorer", "high resolution", "imu"])
def test_every_tool_and_unit_gives_the_same_signals(flight, tmp_path, unit):
    part, path = short(flight), tmp_path / "log.csv"
    reference = open_log(write_decoded(tmp_path / "reference.csv", table(part))).signals
    columns, tolerance = table(part), 1e-9
    rates = [f"gyroADC[{i}]" for i in range(3)]
    if unit == "explorer":
        write_exported(path, columns)
    elif unit == "high resolution":
        tolerance = np.radians(1.0)
        write_exported(path, table(part, resolution=10.0), SETTINGS | {"blackbox_high_resolution": "1"})
    elif unit == "imu":
        tolerance = 3e-4
        write_decoded(path, table(part, attitude="degrees"))
    elif unit in ("ms", "s"):
        columns["time"] = columns["time"] / {"ms": 1e3, "s": 1e6}[unit]
        write_exported(path, columns)
        path.write_text(path.read_text().replace('"time"', f'"time ({unit})"'))
    else:
        factor = np.pi / 180 if unit == "rad/s" else 1.0
        columns |= {name: np.round(columns[name] * factor, 6) for name in rates}
        tolerance = 1e-5
        write_decoded(path, columns, dict.fromkeys(rates, unit))
    found = open_log(path).signals
    assert set(found) == set(reference)
    for name, series in reference.items():
        if name != "r_bar":
            np.testing.assert_allclose(found[name].values, series.values, atol=tolerance)
        np.testing.assert_allclose(found[name].time, series.time, atol=1e-6)


def test_sticks_in_acro_mode_are_the_external_signal(tmp_path):
    def sticks(t):
        steps = np.random.default_rng(3).uniform(-1, 1, (len(t) // 200 + 1, 2)).repeat(200, axis=0)[: len(t)]
        return 80 * steps + 60 * steps**3

    flown = betaflight_flight(4.0, sticks=sticks)
    columns = table(flown)
    steps = np.random.default_rng(3).uniform(-1, 1, (len(flown.t) // 200 + 1, 2)).repeat(200, axis=0)[: len(flown.t)]
    columns |= {f"rcCommand[{i}]": np.round(500 * steps[:, i]) for i in range(2)}
    signals = open_log(write_decoded(tmp_path / "acro.csv", columns)).signals
    np.testing.assert_array_equal(signals["r_bar"].values, signals["r_i"].values)
    columns |= {f"setpoint[{i}]": np.round(3 * np.degrees(flown.angles[:, i])) for i in range(2)}  # angle mode
    assert "r_bar" not in open_log(write_decoded(tmp_path / "angle.csv", columns)).signals


def test_the_file_of_the_settings_is_no_log(log):
    with pytest.raises(TuningError, match=r"it holds the settings of btfl\.01\.csv; give that file"):
        open_log(log.with_name("btfl.01.headers.csv"))
    assert find_logs([log.parent]) == sorted(set(log.parent.glob("*.csv")) - {log.with_name("btfl.01.headers.csv")})


def test_flown_gains_are_those_of_the_header(log):
    gains = read_log(log).flown
    degree = math.pi / 180
    assert gains.controller == "betaflight"
    np.testing.assert_allclose(np.diag(gains.Kp_o), 5.0)
    np.testing.assert_allclose(np.diag(gains.Kp_i), np.array([45, 47]) * 0.032029 / 1000 / degree)
    np.testing.assert_allclose(np.diag(gains.Ki_i), np.array([80, 84]) * 0.244381 / 1000 / degree)
    np.testing.assert_allclose(np.diag(gains.Kd_i), np.array([30, 34]) * 0.000529 / 1000 / degree)
    assert gains.filters.stock.derivative_hz == (75.0,) * 3
    assert gains.filters.stock.derivative2_hz == (150.0,) * 3
    assert gains.limits.moment_max == (0.5, 0.5, 0.4)
    assert gains.limits.integral_max == pytest.approx((0.4, 0.4, 0.32))
    assert gains.provenance.details["loop_rate_hz"] == 4000


def test_up_to_4_5_the_flown_d_is_d_min(flight, tmp_path):
    settings = {name: value for name, value in SETTINGS.items() if name != "d_max"} | {"d_min": "20,0,0"}
    parameters = open_log(write_exported(tmp_path / "old.csv", table(short(flight)), settings)).parameters
    assert (parameters["d_roll"], parameters["d_pitch"]) == (20.0, 34.0)


def test_gains_behind_a_filter_that_is_not_modelled_are_not_read(flight, tmp_path):
    settings = SETTINGS | {"dterm_lpf1_type": "1"}
    found = open_log(write_exported(tmp_path / "biquad.csv", table(short(flight)), settings))
    assert any("dterm_lpf1_type is not PT1" in note for note in found.notes)
    flown = flown_gains(found.parameters, TS)
    assert flown.controller == "mimo"
    assert flown.provenance.details == {"lacking_parameters": ["dterm_lpf1_static_hz"]}


@pytest.mark.parametrize(
    ("lost", "message"),
    [
        ("imuQuaternion", "lacks the attitude: imuQuaternion.*blackbox_disable_attitude = OFF.*--simulate-imu"),
        ("axisP", "lacks axisP.*blackbox_disable_pids = OFF"),
        ("gyroADC", r"lacks gyroADC\[0\], gyroADC\[1\]"),
        ("time", "no column 'time' in s, ms or us"),
    ],
)
def test_what_a_log_lacks_is_told_with_the_setting(flight, tmp_path, lost, message):
    columns = {name: column for name, column in table(short(flight)).items() if not name.startswith(lost)}
    with pytest.raises(TuningError, match=message):
        read_log(write_decoded(tmp_path / "lacks.csv", columns))


def another_log(text):
    header, _, rows = text.partition("\n")
    return f"{text}{header}\n{rows}"


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (
            lambda text: text.replace(".", ",").replace(", ", ";"),
            "separated by semicolons, so a spreadsheet has written",
        ),
        (lambda text: text.replace(", ", "\t"), "separated by tabs"),
        (another_log, "another log begins at line 502; give each log in a file of its own"),
        (lambda text: text + text.partition("\n")[2], "the time begins again at row 501 below the column names"),
        (
            lambda _: "\xff" * 20 + "H Product:Blackbox flight data\nH Field I name:loopIteration\n",
            "a Betaflight log; make",
        ),
        (lambda _: "time (us), GPS_fixType, GPS_numSat\n1, 2, 3\n", "the positions of a blackbox log"),
        (lambda _: '{"name":"Sync beep", "time":1}\n', "the events of a blackbox log"),
    ],
)
def test_what_is_no_table_of_one_log_is_refused_with_its_true_cause(flight, tmp_path, change, reason):
    path = write_decoded(tmp_path / "log.csv", table(short(flight)))
    path.write_text(change(path.read_text()), "latin-1")
    with pytest.raises(TuningError, match=reason):
        open_log(path)


def test_a_wrong_time_stamp_is_not_another_log_and_merged_positions_change_nothing(flight, tmp_path):
    columns = table(short(flight))
    columns["time"][100] += 5e6
    path = write_decoded(tmp_path / "log.csv", columns | {"GPS_speed": columns["time"] * 0}, units={"GPS_speed": "m/s"})
    assert len(open_log(path).signals["u"].time) == len(columns["time"]) - 1


def test_a_log_without_setpoints_says_so(flight, tmp_path):
    columns = {name: column for name, column in table(flight).items() if not name.startswith("setpoint")}
    found = read_log(write_decoded(tmp_path / "log.csv", columns))
    assert any("no setpoint[0] to setpoint[2], so no excitation" in one for one in found.warnings)


def test_a_slow_log_is_refused(flight, tmp_path):
    columns = {name: column[::10] for name, column in table(flight).items()}
    with pytest.raises(TuningError, match=r"too slow: .* 50\.0 Hz.*blackbox_sample_rate"):
        read_log(write_decoded(tmp_path / "slow.csv", columns))


def test_a_cut_last_line_is_ignored_and_a_file_without_samples_refused(flight, tmp_path):
    path = write_decoded(tmp_path / "cut.csv", table(short(flight)))
    text = path.read_text()
    path.write_text(text[:-90])
    found = open_log(path)
    assert found.warnings[0] == "the last line is incomplete and ignored"
    assert len(found.signals["u"].time) == round(1.0 / TS) - 1
    path.write_text(text.partition("\n")[0] + "\n")
    with pytest.raises(TuningError, match="no samples below the column names"):
        open_log(path)


@pytest.mark.parametrize("gyro", [1.0, -1.0])
@pytest.mark.parametrize("si", [True, False])
def test_indiflight_is_read_with_motors_as_torque(flight, tmp_path, gyro, si):
    """Attitude is forward, right, down; the gyro's pitch has had either sign."""
    torque, rates, frd = flight.torque, np.radians(flight.rates) * FRD, flight.angles * FRD
    motors = 0.4 + np.column_stack(
        [s * torque[:, 0] + p * torque[:, 1] for s, p in ((-1, -1), (-1, 1), (1, -1), (1, 1))]
    )
    w = np.sqrt(1 - np.sum((quaternion(frd) / 32767) ** 2, axis=1)) * 32767
    scale, degrees = (1.0, 1.0) if si else (32767.0, 180 / np.pi)
    columns = {"loopIteration": np.arange(len(flight.t))}
    columns |= {"timeUs": flight.t * 1e6, "timeS": flight.t} if si else {"time": np.round(flight.t * 1e6)}
    columns |= {f"u[{i}]": motors[:, i] * scale for i in range(4)}
    columns |= {f"quat[{i}]": q for i, q in enumerate(np.column_stack([w, quaternion(frd)]).T * scale / 32767)}
    three = np.column_stack([rates[:, 0], gyro * rates[:, 1], 0 * rates[:, 0]]) * degrees
    columns |= {f"gyroADC[{i}]": three[:, i] for i in range(3)}
    found = open_log(write_decoded(tmp_path / "indi.csv", columns))
    np.testing.assert_allclose(found.signals["u"].values, torque, atol=1e-4)
    np.testing.assert_allclose(found.signals["y_i"].values, rates, atol=1e-4)
    np.testing.assert_allclose(found.signals["y_o"].values, frd, atol=2e-4)
    assert found.format.startswith("blackbox CSV, INDIflight")
