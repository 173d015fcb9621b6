"""Gains of stock controllers from parameter files, logs and a vehicle: numbers computed by hand, and refusals."""

import dataclasses
import json
import math

import numpy as np
import pytest

from mimopilot.common.errors import Error
from mimopilot.sitl.mavlink.ground_station.profiles import make_plan
from mimopilot.sitl.mavlink.wire.parameter_files import FORMATS, parameter_text
from mimopilot.tuning.gains_file import load_gains
from mimopilot.tuning.logs.imported_gains import DEFAULTS, import_gains, needed_names, read_source
from mimopilot.tuning.logs.reader import read_log
from mimopilot.tuning.logs.stock_controllers import ARDUPILOT, PX4
from tests.conftest import assert_one_clear_line, stock_gains
from tests.tuning.logs.flights import (
    ardupilot_messages,
    dataflash_bytes,
    injected,
    make_flight,
    microseconds,
    px4_topics,
    write_ulog,
)

#: No value twice, so that no two are exchanged unseen; exact in single precision or rounded to a short decimal.
PX4_VALUES = {
    "MC_ROLL_P": 6.5,
    "MC_PITCH_P": 6.0,
    "MC_YAW_P": 2.8,
    "MC_YAW_WEIGHT": 0.35,
    "MC_ROLLRATE_P": 0.15,
    "MC_ROLLRATE_I": 0.2,
    "MC_ROLLRATE_D": 0.003,
    "MC_ROLLRATE_FF": 0.01,
    "MC_ROLLRATE_K": 1.5,
    "MC_PITCHRATE_P": 0.16,
    "MC_PITCHRATE_I": 0.21,
    "MC_PITCHRATE_D": 0.004,
    "MC_PITCHRATE_FF": 0.02,
    "MC_PITCHRATE_K": 2.0,
    "MC_YAWRATE_P": 0.25,
    "MC_YAWRATE_I": 0.1,
    "MC_YAWRATE_D": 0.001,
    "MC_YAWRATE_FF": 0.03,
    "MC_YAWRATE_K": 0.5,
    "MC_ROLLRATE_MAX": 220.0,
    "MC_PITCHRATE_MAX": 210.0,
    "MC_YAWRATE_MAX": 200.0,
    "MC_RR_INT_LIM": 0.3,
    "MC_PR_INT_LIM": 0.31,
    "MC_YR_INT_LIM": 0.32,
    "IMU_DGYRO_CUTOFF": 25.0,
    "IMU_GYRO_RATEMAX": 400.0,
}
ARDUPILOT_VALUES = {
    **{f"ATC_ANG_{axis}_P": value for axis, value in (("RLL", 4.5), ("PIT", 4.6), ("YAW", 3.5))},
    **{
        f"ATC_RAT_{axis}_{term}": value
        for axis, values in (
            ("RLL", (0.135, 0.1, 0.0036, 0.0, 0.5)),
            ("PIT", (0.145, 0.11, 0.0046, 0.01, 0.4)),
            ("YAW", (0.18, 0.018, 0.0, 0.02, 0.6)),
        )
        for term, value in zip(("P", "I", "D", "FF", "IMAX"), values, strict=True)
    },
    **{f"ATC_RATE_{axis}_MAX": value for axis, value in (("R", 180.0), ("P", 90.0), ("Y", 0.0))},
    "ATC_RAT_RLL_FLTD": 20.0,
    "SCHED_LOOP_RATE": 400.0,
}


def from_file(path, values, form="mavproxy", **options):
    path.write_text(parameter_text(form, values, checksum=False))
    return import_gains(read_source(path), **options)


@pytest.mark.parametrize("form", FORMATS)
def test_px4s_parameters_become_our_gains_by_hand(tmp_path, form):
    found = from_file(tmp_path / "x.params", PX4_VALUES, form)
    gains = found.gains
    assert gains.Kp_o.tolist() == [[6.5, 0.0], [0.0, 6.0]]
    # P, I and D times K; the feed-forward is not multiplied (PX4, MulticopterRateControl::parameters_updated).
    assert gains.Kp_i == pytest.approx(np.diag([0.225, 0.32]), rel=1e-12)
    assert gains.Ki_i == pytest.approx(np.diag([0.3, 0.42]), rel=1e-12)
    assert gains.Kd_i == pytest.approx(np.diag([0.0045, 0.008]), rel=1e-12)
    assert gains.Kff_i.tolist() == [[0.01, 0.0], [0.0, 0.02]]
    yaw = gains.yaw
    assert (yaw.Kp_o, yaw.Kp_i, yaw.Ki_i, yaw.Kd_i, yaw.Kff_i) == pytest.approx((2.8, 0.125, 0.05, 0.0005, 0.03))
    assert gains.limits.rate_max == pytest.approx((220 * math.pi / 180, 210 * math.pi / 180, 200 * math.pi / 180))
    assert (gains.limits.integral_max, gains.limits.moment_max) == ((0.3, 0.31, 0.32), (1.0, 1.0, 1.0))
    assert (gains.Ts, gains.derivative_cutoff_hz) == (0.0025, 25.0)
    assert (gains.moment_scale, gains.certificate, gains.provenance.method) == (None, None, "imported")
    assert found.defaults == ()
    assert gains.filters.yaw_weight == 0.35


def test_ardupilots_parameters_become_our_gains_by_hand(tmp_path):
    found = from_file(tmp_path / "x.param", ARDUPILOT_VALUES, "missionplanner")
    gains = found.gains
    assert gains.Kp_o.tolist() == [[4.5, 0.0], [0.0, 4.6]]
    assert gains.Kp_i.tolist() == [[0.135, 0.0], [0.0, 0.145]]
    assert gains.Ki_i.tolist() == [[0.1, 0.0], [0.0, 0.11]]
    assert gains.Kd_i.tolist() == [[0.0036, 0.0], [0.0, 0.0046]]
    assert gains.Kff_i.tolist() == [[0.0, 0.0], [0.0, 0.01]]
    yaw = gains.yaw
    assert (yaw.Kp_o, yaw.Kp_i, yaw.Ki_i, yaw.Kd_i, yaw.Kff_i) == (3.5, 0.18, 0.018, 0.0, 0.02)
    assert gains.limits.rate_max == pytest.approx((math.pi, math.pi / 2, 3.5))
    assert gains.limits.integral_max == (0.5, 0.4, 0.6)
    assert (gains.Ts, gains.derivative_cutoff_hz) == (0.0025, 20.0)
    assert "ATC_RATE_Y_MAX 0: no limit; our law needs one, 3.5 rad/s" in found.not_carried


def test_what_cannot_be_carried_over_is_named(tmp_path):
    more = {
        "ATC_RAT_RLL_SMAX": 50.0,
        "ATC_RAT_YAW_FLTE": 2.5,
        "ATC_RAT_PIT_FLTD": 30.0,
        "ATC_INPUT_TC": 0.15,
        "ATC_RAT_PIT_NEF": 1.0,
        "INS_HNTCH_ENABLE": 1.0,
        "ATC_RAT_RLL_FLTE": 0.0,
    }
    text = "\n".join(from_file(tmp_path / "x.param", ARDUPILOT_VALUES | more).not_carried)
    for words in (
        "ATC_RAT_RLL_SMAX 50: limit of the slew rate",
        "ATC_RAT_YAW_FLTE 2.5 Hz: low-pass of the rate error",
        "ATC_RAT_PIT_FLTD 30 Hz: our law has one derivative filter, that of roll (20 Hz)",
        "ATC_INPUT_TC 0.15 s",
        "ATC_RAT_PIT_NEF 1: notch filter of the error",
        "INS_HNTCH_ENABLE 1: filters of the gyro",
        "D: ArduPilot's acts on the error",
    ):
        assert words in text
    assert "RLL_FLTE" not in text
    px4 = PX4_VALUES | {"MC_YAW_TQ_CUTOFF": 2.0, "IMU_GYRO_NF0_FRQ": 80.0, "MC_BAT_SCALE_EN": 0.0}
    text = "\n".join(from_file(tmp_path / "x.param", px4).not_carried)
    assert "MC_YAW_TQ_CUTOFF 2 Hz: low-pass of the yaw torque" in text
    assert "IMU_GYRO_NF0_FRQ 80: filters of the gyro" in text
    assert "MC_BAT_SCALE_EN" not in text


def test_whole_numbers_of_qgroundcontrols_files_and_start_up_lines_are_read(tmp_path):
    lines = [f"1\t1\t{name}\t{value!r}\t9" for name, value in PX4_VALUES.items() if name != "IMU_GYRO_RATEMAX"]
    (tmp_path / "x.params").write_text("# Vehicle\n" + "\n".join([*lines, "1\t1\tIMU_GYRO_RATEMAX\t1000\t6"]) + "\n")
    assert import_gains(read_source(tmp_path / "x.params")).gains.Ts == 0.001
    script = "".join(f"param set-default {name} {value}\n" for name, value in PX4_VALUES.items())
    (tmp_path / "config.txt").write_text(script)
    assert import_gains(read_source(tmp_path / "config.txt")).gains.Kp_i[0, 0] == pytest.approx(0.225)


@pytest.mark.parametrize(("stock", "values"), [(PX4, PX4_VALUES), (ARDUPILOT, ARDUPILOT_VALUES)])
def test_no_parameter_gets_a_silent_default(tmp_path, stock, values):
    assert set(needed_names(stock)) <= set(values)
    for name in needed_names(stock):
        rest = {key: value for key, value in values.items() if key != name}
        with pytest.raises(Error, match=rf"lacks {name}; no gain gets a silent default"):
            from_file(tmp_path / "x.parm", rest)
    without = {key: value for key, value in values.items() if key != stock.rate}
    assert from_file(tmp_path / "x.parm", without, rate=500.0).gains.Ts == 0.002


def test_named_defaults_fill_what_is_missing_and_are_listed(tmp_path):
    found = from_file(tmp_path / "x.parm", {"MC_ROLLRATE_P": 0.1, "MC_PITCHRATE_K": 2.0}, defaults="px4-v1.16")
    gains = found.gains
    assert gains.Kp_i == pytest.approx(np.diag([0.1, 0.3]))
    assert (gains.Kp_o.tolist(), gains.yaw.Kp_i, gains.Ts) == ([[6.5, 0.0], [0.0, 6.5]], 0.2, 1 / 800)
    assert "MC_ROLLRATE_P" not in found.defaults
    assert len(found.defaults) == len(needed_names(PX4)) - 2
    assert gains.provenance.details["defaulted"] == list(found.defaults)
    assert any("defaults of px4-v1.16; those of the vehicle's airframe may differ" in text for text in found.warnings)
    assert set(needed_names(PX4)) <= set(DEFAULTS["px4-v1.16"])


@pytest.mark.parametrize(
    ("values", "options", "message"),
    [
        ({"SYS_AUTOSTART": 4001.0}, {}, "holds no gains of a multirotor"),
        ({"MIMO_RP_RR": 0.15}, {}, r"holds no gains of a multirotor .*; those of our own module \(MIMO_\*\) are not"),
        ({"SYS_AUTOSTART": 4001.0}, {"defaults": "px4-v1.16"}, "holds no gains of a multirotor"),
        (PX4_VALUES | ARDUPILOT_VALUES, {}, "of PX4 and of ArduPilot"),
        (ARDUPILOT_VALUES | {"RLL2SRV_TCONST": 0.5}, {}, "parameters of ArduPlane"),
        (ARDUPILOT_VALUES | {"JS_GAIN_DEFAULT": 0.5}, {}, "parameters of ArduSub"),
        (ARDUPILOT_VALUES | {"FRAME_CLASS": 6.0}, {}, "a helicopter"),
        (PX4_VALUES | {"MAV_TYPE": 1.0}, {}, "a fixed wing"),
        (PX4_VALUES | {"MC_RR_INT_LIM": 0.0}, {}, "MC_RR_INT_LIM: got 0, expected more than 0"),
        (PX4_VALUES | {"MC_YAWRATE_MAX": -5.0}, {}, "MC_YAWRATE_MAX: got -5, expected more than 0"),
        (PX4_VALUES | {"IMU_DGYRO_CUTOFF": -1.0}, {}, "IMU_DGYRO_CUTOFF: got -1, expected at least 0"),
        (PX4_VALUES | {"IMU_GYRO_RATEMAX": 0.0}, {}, "IMU_GYRO_RATEMAX: got 0 Hz, expected more than 0"),
        (PX4_VALUES, {"rate": -3.0}, "--rate: got -3 Hz"),
        (PX4_VALUES, {"rate": 1e6}, "cannot run at this control rate"),
        (PX4_VALUES, {"defaults": "px4-v1.15"}, "--defaults: got 'px4-v1.15', expected one of px4-v1.16"),
        (ARDUPILOT_VALUES, {"defaults": "px4-v1.16"}, "is of ArduPilot; leave it out"),
    ],
)
def test_parameters_that_are_no_gains_are_refused_by_name(tmp_path, values, options, message):
    with pytest.raises(Error, match=message):
        from_file(tmp_path / "x.parm", values, **options)


@pytest.fixture(scope="module")
def flight():
    return make_flight(20.0)


def test_a_log_gives_the_gains_that_its_reader_says_flew(tmp_path, flight):
    logged = PX4_VALUES | {"IMU_GYRO_RATEMAX": 250.0}
    path = write_ulog(tmp_path / "x.ulg", px4_topics(flight, debug_vect=injected(flight)), logged)
    found, flown = import_gains(read_source(path)), read_log(path).flown
    assert found.gains.elements() == flown.for_our_law().elements()
    exact = import_gains(read_source(path), profile="px4-stock").gains
    assert exact.filters == dataclasses.replace(flown.filters, Ts=exact.Ts)
    assert [text for text in found.warnings if "logged every" in text] == []
    values = ARDUPILOT_VALUES | {"SCHED_LOOP_RATE": 1 / read_log(path).Ts}
    parm = ("PARM", "QNf", ("TimeUS", "Name", "Value"))
    rows = [microseconds([9.0] * len(values)), [name.encode() for name in values], list(values.values())]
    (tmp_path / "x.bin").write_bytes(dataflash_bytes([(*parm, rows), *ardupilot_messages(flight)]))
    assert import_gains(read_source(tmp_path / "x.bin")).gains.elements() == (
        read_log(tmp_path / "x.bin").flown.for_our_law().elements()
    )


def test_stock_gains_are_imported_beside_those_of_our_module_and_after_a_change(tmp_path, flight):
    logged = PX4_VALUES | {"MIMO_RP_RR": 0.9, "MIMO_EN": 0.0} | {f"MIMO_SCALE_{a}": 2.5 for a in "RPY"}
    path = write_ulog(tmp_path / "x.ulg", px4_topics(flight), logged, [(12.0, "MC_ROLL_P", 5.0)])
    found = import_gains(read_source(path))
    assert found.gains.Kp_i[0, 0] == pytest.approx(0.225)
    assert (found.gains.Kp_o[0, 0], found.gains.moment_scale) == (5.0, (2.5, 2.5, 2.5))
    assert any("MC_ROLL_P from 6.5 to 5" in text for text in found.warnings)
    assert any("logged every 0.004 s, IMU_GYRO_RATEMAX is 400 Hz" in text for text in found.warnings)


@pytest.mark.parametrize(
    ("profile", "rate"), [("px4-stock", "IMU_GYRO_RATEMAX"), ("ardupilot-stock", "SCHED_LOOP_RATE")]
)
def test_what_an_upload_writes_is_what_an_import_reads(tmp_path, profile, rate):
    gains = stock_gains(profile)
    values = make_plan(gains, profile).values | {rate: 400.0}
    back = from_file(tmp_path / "x.parm", values, profile=profile).gains
    assert back.controller == profile
    for name in ("Kp_o", "Kp_i", "Ki_i", "Kd_i", "Kff_i"):
        assert getattr(back, name) == pytest.approx(getattr(gains, name), rel=1e-6)
        assert getattr(back.yaw, name) == pytest.approx(getattr(gains.yaw, name), rel=1e-6)
    found, wanted = (dataclasses.asdict(one.filters.stock) for one in (back, gains))
    assert {name: found[name] for name in found if name != "controller"} == {
        name: pytest.approx(wanted[name], rel=1e-6) for name in wanted if name != "controller"
    }
    other = {"px4-stock": "ardupilot-stock", "ardupilot-stock": "px4-stock"}[profile]
    with pytest.raises(Error, match=f"--profile: got '{other}', but x.parm is of .*: give mimo or {profile}"):
        from_file(tmp_path / "x.parm", values, profile=other)


def test_a_stock_set_needs_the_parameters_of_its_filters(tmp_path):
    complete = dict.fromkeys(ARDUPILOT.filter_names, 20.0) | ARDUPILOT_VALUES
    assert from_file(tmp_path / "z.parm", complete, profile="ardupilot-stock").gains.controller == "ardupilot-stock"
    lacking = {name: value for name, value in complete.items() if name != "ATC_RAT_PIT_FLTE"}
    assert from_file(tmp_path / "x.parm", lacking).gains.controller == "mimo"
    with pytest.raises(Error, match="lacks ATC_RAT_PIT_FLTE; no gain gets"):
        from_file(tmp_path / "x.parm", lacking, profile="ardupilot-stock")
    older = {name: value for name, value in PX4_VALUES.items() if name != "MC_YAW_TQ_CUTOFF"}
    assert from_file(tmp_path / "y.parm", older, profile="px4-stock").gains.filters.stock.torque_hz == (0.0, 0.0, 0.0)


def test_the_command_writes_a_file_shows_both_sides_and_refuses_to_overwrite(tmp_path, mimopilot):
    (tmp_path / "quad.params").write_text(parameter_text("qgc", PX4_VALUES, checksum=False))
    result = mimopilot("import-params", "quad.params")
    assert result.returncode == 0, result.stderr
    for words in ("MC_ROLLRATE_P x MC_ROLLRATE_K", "0.15 x 1.5", "not in the gains file", "quad.gains.toml"):
        assert words in result.stdout
    assert "moment_scale is unknown" in result.stderr
    assert load_gains(tmp_path / "quad.gains.toml").verdict()[0] == "none"
    assert_one_clear_line(mimopilot("import-params", "quad.params"), "quad.gains.toml: exists; give --out")
    as_json = mimopilot("import-params", "quad.params", "--out", "b.gains.toml", "--json")
    found = json.loads(as_json.stdout)
    assert (found["elements"]["RP_RR"], found["parameters"]["MC_ROLLRATE_K"]) == (pytest.approx(0.225), 1.5)
    assert (tmp_path / "quad.gains.toml").read_bytes() == (tmp_path / "b.gains.toml").read_bytes()
    assert_one_clear_line(mimopilot("generate", "b.gains.toml", "--out", "cpp"), "no certificate")


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"MC_ROLLRATE_P nan\n", ("line 1: MC_ROLLRATE_P: got 'nan', expected a finite number",)),
        (b"MC_ROLL_P 6.5\nMC_ROLLRATE_P high\n", ("line 2: MC_ROLLRATE_P: got 'high'",)),
        (b"\x7fELF\xff\xfe", ("not UTF-8 text",)),
        (b"FMT, 128, 89, FMT\n", ("an ArduPilot log as text",)),
        (b"MATLAB 5.0 MAT-file", ("holds no parameters",)),
        (b"t,u_roll\n0,1\n", ("line 1", "expected a parameter name")),
        (b"ULog\x01\x12\x35 cut short", ("x.any",)),
    ],
)
def test_bad_files_get_one_clear_message(tmp_path, mimopilot, content, words):
    (tmp_path / "x.any").write_bytes(content)
    assert_one_clear_line(mimopilot("import-params", "x.any"), *words)


def test_a_missing_file_and_no_source_get_one_clear_message(mimopilot):
    assert_one_clear_line(mimopilot("import-params", "none.params"), "none.params: no such file")
    assert_one_clear_line(mimopilot("import-params"), "give either")
