"""Gains at another control rate than the log's, against the exact loop at that rate."""

import dataclasses
import json
import subprocess
import sys

import numpy as np
import pytest

from mimopilot.codegen.targets import find_target
from mimopilot.common.errors import Error
from mimopilot.sitl.physics.airframe import load_airframe
from mimopilot.tuning.analysis.certify import certify
from mimopilot.tuning.certificate import ACCEPTED, Verdict
from mimopilot.tuning.design.cascade import at_rate, certify_from_log
from mimopilot.tuning.gains_file import load_gains
from mimopilot.tuning.logs.reader import read_log
from mimopilot.tuning.spec import TuningSpec
from tests.conftest import assert_one_clear_line, following_gains
from tests.tuning.analysis.loops import airframe, exact, flown, random_set, scaled
from tests.tuning.truth import TS, Truth, linear_plant

FASTER, SLOWER = (400, 500, 1000), (200, 125)


def examined(gains, response):
    """Certificate at the gains' own rate."""
    models = TuningSpec().models("inner", gains.Ts), TuningSpec().models("outer", gains.Ts)
    return certify(gains, response, *models)


def true_peak(gains, truth):
    """Ms of the exact loop at the gains' rate; infinite if it is unstable."""
    if truth.spectral_radius(gains) >= 1:
        return np.inf
    S = np.linalg.inv(np.eye(2) + truth.return_ratio(gains, np.geomspace(0.05, 0.999 * np.pi / gains.Ts, 4000)))
    return float(np.linalg.norm(S, ord=2, axis=(1, 2)).max())


def judged(name, hertz, sets):
    """Certificate and true Ms of gain sets at a rate, from a log of 250 Hz."""
    response, truth = flown(name).response, Truth(linear_plant(airframe(name), Ts=1 / hertz))
    for gains in sets:
        carried = at_rate(gains, hertz)
        yield examined(carried, response), true_peak(carried, truth)


@pytest.fixture(scope="module")
def sets():
    """Flown gains, with scaled loops, and random ones: well damped to unstable."""
    found = {}
    for name in ("adam0", "antr"):
        base, rng = flown(name).experiment.flown, np.random.default_rng(5)
        near = [scaled(base, inner, outer) for inner, outer in ((1.0, 0.7), (1.3, 0.8), (0.6, 0.4), (1.0, 1.5))]
        found[name] = [base, *near, *(random_set(base, rng) for _ in range(8))]
    return found


@pytest.mark.parametrize("name", ["adam0", "antr"])
@pytest.mark.parametrize("hertz", [*FASTER, *SLOWER])
def test_no_certificate_at_another_rate_is_optimistic(sets, name, hertz):
    accepted = 0
    for found, Ms in judged(name, hertz, sets[name]):
        if found.verdict in ACCEPTED:
            accepted += 1
            # 0.3 %: what it is off at the log's own rate, by the motors' square law.
            assert Ms <= 1.003 * (found.figures["Ms"] + found.figures["Ms_error"])
        if not np.isfinite(Ms):
            assert found.verdict in (Verdict.UNSTABLE, Verdict.NOT_CERTIFIED)
        if hertz > 250:
            assert found.verdict != Verdict.UNSTABLE  # the true delay is shorter: it is not known
    assert accepted >= (1 if hertz == 125 else 3)


@pytest.mark.parametrize("name", ["adam0", "antr"])
@pytest.mark.parametrize("hertz", SLOWER)
def test_at_a_slower_rate_the_peak_is_that_of_the_exact_loop(sets, name, hertz):
    for found, Ms in judged(name, hertz, sets[name][:5]):
        if Ms < 3:
            # The longer hold also attenuates, which is left out: up to 4 % on the safe side.
            assert 0.997 * Ms < found.figures["Ms"] < 1.04 * Ms


def test_margins_that_are_lost_at_a_slower_rate_are_refused(sets):
    base = sets["antr"][0]
    for hertz, verdict in ((250, Verdict.THIN), (200, Verdict.THIN), (125, Verdict.NOT_CERTIFIED)):
        ((found, Ms),) = judged("antr", hertz, [base])
        assert found.verdict == verdict
    assert Ms > 3.5
    assert "the margin is too thin" in found.reason
    assert found.reason.endswith(
        "carried from 250 to 125 Hz: the torque is taken 6.0 ms later, as after one period of computing"
    )


def test_the_response_is_turned_by_the_exact_delay_and_its_error_with_it():
    """Without noise, and below the alias of the slower hold, it is the exact response at the slower rate."""
    body, omega = airframe("adam0"), np.geomspace(1.0, 700.0, 200)
    measured = exact(linear_plant(body), omega)
    slower, faster = measured.at_period(1 / 125), measured.at_period(1 / 500)
    assert slower.omega[-1] < 125 * np.pi
    assert (len(faster.omega), faster.Ts, slower.Ts) == (200, 1 / 500, 1 / 125)
    assert np.array_equal(faster.G_i, measured.G_i)
    low = slower.omega < 60
    true = exact(linear_plant(body, Ts=1 / 125), slower.omega[low])
    for got, wanted in ((slower.G_i[low], true.G_i), (slower.G_o[low], true.G_o)):
        # The longer hold attenuates by up to 1 %, which is left out.
        assert np.abs(got / wanted - 1).max() < 0.02
        assert np.abs(np.angle(got / wanted)).max() < np.radians(0.5)
    noisy = flown("adam0").response
    late = noisy.at_period(1 / 125)
    assert late.deviation() == pytest.approx(noisy.deviation()[: len(late.omega)], rel=1e-9)
    assert late.relative_error() == pytest.approx(noisy.relative_error()[: len(late.omega)], rel=1e-9)
    assert noisy.at_period(TS * 1.01) is noisy


def test_only_the_period_changes_and_what_holds_for_one_rate_is_left_out():
    gains = flown("adam0").experiment.flown
    details = {"predicted": {"tuned": []}, "better_than_flown": True, "note": "kept"}
    gains = dataclasses.replace(gains, provenance=dataclasses.replace(gains.provenance, details=details))
    carried = at_rate(certify_from_log(flown("adam0").experiment, gains), 400)
    assert {n for n, v in carried.elements().items() if v != gains.elements()[n]} == {"TS", "D_POLE"}
    assert carried.filters.derivative_pole == pytest.approx(np.exp(-2 * np.pi * gains.derivative_cutoff_hz / 400))
    assert carried.certificate is None
    assert carried.provenance.details == {"note": "kept", "carried_from_Ts": TS}
    with pytest.raises(Error, match=r"model_omega: got 9\.0 rad/s, expected at most 0\.25/Ts"):
        at_rate(following_gains(), 30)
    for hertz in (0, -5, np.nan, np.inf):
        with pytest.raises(Error, match="rate: got"):
            at_rate(gains, hertz)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Logs of the command at 250 and 1000 Hz."""
    path = tmp_path_factory.mktemp("rates")
    at_rate(load_airframe("adam0").default_gains(), 1000).save(path / "fast.gains.toml")
    for extra in (("--out", "f.ulg"), ("--gains", "fast.gains.toml", "--out", "fast.ulg")):
        command = [sys.executable, "-m", "mimopilot", "experiment", "adam0", "--seconds-per-axis", "10", *extra]
        subprocess.run(command, check=True, capture_output=True, cwd=path)
    return path


def test_the_command_carries_and_certifies_and_the_certificate_is_of_the_new_rate(folder, mimopilot, tmp_path):
    load_airframe("adam0").default_gains().save(folder / "my.gains.toml")
    arguments = ("certify", folder / "f.ulg", "--gains", folder / "my.gains.toml", "--rate")
    done = mimopilot(*arguments, 400, "--out", "my400.gains.toml", "--json")
    assert done.returncode == 0, done.stderr
    assert "carried from 250 to 400 Hz: the torque is taken as late as in the log" in json.loads(done.stdout)["reason"]
    flight = mimopilot("fly", "adam0", "--gains", "my400.gains.toml", "--json")
    assert json.loads(flight.stdout)["crashed_at_s"] is None
    path = tmp_path / "my400.gains.toml"
    loaded = load_gains(path)
    assert (loaded.Ts, loaded.verdict()[0]) == (1 / 400, Verdict.CERTIFIED)
    path.write_text(path.read_text().replace("Ts = 0.0025 ", "Ts = 0.002 "))
    assert load_gains(path).verdict()[0] == Verdict.VOID
    refused = mimopilot(*arguments, 40)
    assert refused.returncode == 1
    assert_one_clear_line(mimopilot(*arguments, 0), "rate: got 0 Hz")


def test_a_fast_log_certifies_slower_gains_with_the_true_peak(folder):
    log, gains = read_log(folder / "fast.ulg"), load_airframe("adam0").default_gains()
    assert pytest.approx(0.001) == log.Ts
    found = certify_from_log(log, gains).certificate
    assert found.figures["Ms"] == pytest.approx(true_peak(gains, Truth.of(airframe("adam0"))), rel=0.02)
    assert found.verdict == Verdict.CERTIFIED


def test_gains_for_another_rate_than_the_targets_are_emitted_with_a_warning(mimopilot, tmp_path):
    gains = load_airframe("adam0").default_gains()
    for hertz in (250, 400, 800, 1000, 249, 409):
        assert find_target("px4").rate_warning(at_rate(gains, hertz)) == ""
        assert find_target("native").rate_warning(at_rate(gains, hertz)) == ""
    at_rate(gains, 500).save(tmp_path / "x.gains.toml")
    start = ("generate", "x.gains.toml", "--uncertified", "--out", "cpp", "--target")
    emitted = mimopilot(*start, "px4")
    assert emitted.returncode == 0
    (told,) = (line for line in emitted.stderr.splitlines() if "Hz" in line)
    assert all(text in told for text in ("for 500 Hz", "IMU_GYRO_RATEMAX, 250, 400, 800, 1000", "--rate 400"))
    emitted = mimopilot(*start, "native")
    assert emitted.returncode == 0 and "Hz" not in emitted.stderr
