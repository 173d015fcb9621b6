"""Airframe files, the unit of the torque, and the gyro filter."""

import dataclasses

import numpy as np
import pytest

from mimopilot.common.errors import InputFileError
from mimopilot.sitl.autopilot.autopilot import Autopilot
from mimopilot.sitl.errors import SitlError
from mimopilot.sitl.flight.scenario import doublet
from mimopilot.sitl.flight.simulator import fly
from mimopilot.sitl.physics.airframe import FOLDER, known_airframes, load_airframe
from mimopilot.sitl.physics.moment_scale import check_moment_scale
from mimopilot.tuning.certificate import Certificate, Verdict
from mimopilot.tuning.errors import TuningError
from mimopilot.tuning.gains_file import load_gains
from mimopilot.tuning.provenance import Provenance
from tests.conftest import assert_one_clear_line

TS = 0.004

KNOWN = [
    *("adam0", "adam0_boom", "adam0_flexible", "adam0_nominal", "adam0_perturbed", "adam0_thesis"),
    *("adam0_thesis_flown", "adam0_thesis_perturbed", "antr", "antr_thesis", "cf2", "cf2_brushless", "px4_sih"),
]


def test_each_airframe_has_default_gains_in_its_unit_of_torque():
    assert known_airframes() == KNOWN
    for name in known_airframes():
        vehicle = load_airframe(name)
        assert vehicle.airframe.name == name
        check_moment_scale(vehicle.default_gains(), vehicle.airframe.moment_scale(), name)


def test_an_unknown_airframe_lists_the_known_ones():
    with pytest.raises(SitlError, match=f"unknown airframe 'adam1'.*{', '.join(KNOWN)}"):
        load_airframe("adam1")


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("mass = 1.45", "mass = -1", "mass: got -1, expected greater than 0"),
        ("mass = 1.45", "", "mass: missing"),
        ("mass = 1.45", "mass = nan", "mass: .*"),
        ("drag = 0.3", "drag = 0.3\ncolour = 'red'", "colour: unknown entry"),
        ('"ccw"', '"up"', "direction"),
        ("[0.0172, 0.0016, 0.0]", "[0.0172, 0.5, 0.0]", "symmetric"),
        ("mass = 1.45", "mass = = 1", "not a TOML file"),
    ],
)
def test_a_wrong_entry_of_an_airframe_file_is_named(tmp_path, old, new, message):
    path = tmp_path / "mine.toml"
    text = (FOLDER / "adam0.toml").read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))
    with pytest.raises((SitlError, InputFileError), match=rf"mine.toml: .*{message}"):
        load_airframe(str(path))


def test_gains_for_another_unit_of_torque_are_refused(gains):
    airframe = load_airframe("adam0").airframe
    with pytest.raises(SitlError, match=r"3\.6, 3\.6, 0\.2736 N m per unit, adam0 has 2\.546"):
        other = dataclasses.replace(gains, moment_scale=(3.6, 3.6, 0.2736))
        check_moment_scale(other, airframe.moment_scale(), airframe.name)
    with pytest.raises(SitlError, match="do not say"):
        check_moment_scale(dataclasses.replace(gains, moment_scale=None), airframe.moment_scale(), airframe.name)


def test_the_gyro_filter_is_a_butterworth_low_pass_on_the_measured_rates():
    from scipy.signal import butter, lfilter

    vehicle = load_airframe("px4_sih")
    plain = vehicle.airframe.model_copy(update={"gyro_cutoff_hz": 0.0})
    gains = vehicle.default_gains()
    scenario = doublet("roll", 0.2, 0.8, TS)
    bodies = (vehicle.airframe, plain)
    flights = {body.gyro_cutoff_hz: fly(body, Autopilot(body, gains), scenario, 3) for body in bodies}
    filtered, raw = flights[40.0], flights[0.0]
    b, a = butter(2, 40.0, fs=250)
    assert raw.record["rates"] == pytest.approx(raw.truth["rates"], abs=0.1)
    # The measured rates are those of the true ones and the same noise, filtered.
    noise = raw.record["rates"].astype(float) - raw.truth["rates"]
    expected = lfilter(b, a, filtered.truth["rates"] + noise, axis=0)
    assert filtered.record["rates"] == pytest.approx(expected, abs=2e-6)


def test_a_gyro_cutoff_at_half_of_the_sampling_rate_is_refused():
    vehicle = load_airframe("adam0")
    body = vehicle.airframe.model_copy(update={"gyro_cutoff_hz": 125.0})
    with pytest.raises(SitlError, match=r"gyro_cutoff_hz: got 125 Hz, expected 0 .* below 125 Hz"):
        fly(body, Autopilot(body, vehicle.default_gains()), doublet("roll", 0.2, 0.8, TS))


def test_converted_gains_give_the_same_torque_in_newton_metres_and_keep_their_certificate():
    scale = load_airframe("px4_sih").airframe.moment_scale()
    assert scale == pytest.approx((2.88, 2.88, 0.2))
    original = load_airframe("adam0").default_gains()
    certified = original.with_certificate(Certificate(Verdict.CERTIFIED, ""))
    converted = certified.with_moment_scale(scale)
    for name in ("Kp_i", "Ki_i", "Kd_i"):
        moments = [np.array(g.moment_scale[:2])[:, None] * getattr(g, name) for g in (original, converted)]
        assert moments[0] == pytest.approx(moments[1], rel=1e-12)
    assert np.array_equal(converted.Kp_o, original.Kp_o)
    assert converted.yaw.Kp_o == original.yaw.Kp_o
    assert converted.limits.rate_max == original.limits.rate_max
    assert max(converted.limits.moment_max) <= 1.0
    assert converted.verdict() == ("certified", "")
    edited = dataclasses.replace(certified, Kp_o=1.1 * certified.Kp_o)
    assert edited.with_moment_scale(scale).verdict()[0] == "void"
    assert certified.with_moment_scale((2.08, 2.5, 0.4)).verdict()[0] == "none"  # its figures would differ
    known = dataclasses.replace(original, provenance=Provenance(standard_deviation={"Kp_i": [[1.0, 2.0], [3.0, 4.0]]}))
    deviation = known.with_moment_scale(scale).provenance.standard_deviation["Kp_i"]
    assert deviation == pytest.approx(np.array([[1.0, 2.0], [3.0, 4.0]]) * original.moment_scale[0] / scale[0])
    back = converted.with_moment_scale(original.moment_scale)
    assert back.Kp_i == pytest.approx(original.Kp_i, rel=1e-12)
    with pytest.raises(TuningError, match="is not known"):
        dataclasses.replace(original, moment_scale=None).with_moment_scale(scale)


def test_convert_writes_gains_that_the_airframe_accepts(mimopilot, tmp_path):
    mine = tmp_path / "mine.gains.toml"
    load_airframe("adam0").default_gains().save(mine)
    assert_one_clear_line(mimopilot("fly", "px4_sih", "--gains", mine), "mimopilot convert", "moment_scale")
    scale = load_airframe("px4_sih").airframe.moment_scale()
    result = mimopilot("convert", mine, "px4_sih", "--out", "theirs.gains.toml")
    assert result.returncode == 0, result.stderr
    assert "2.546, 2.546, 0.2736 N m, now for 2.88, 2.88, 0.2" in result.stdout
    check_moment_scale(load_gains(tmp_path / "theirs.gains.toml"), scale, "px4_sih")
