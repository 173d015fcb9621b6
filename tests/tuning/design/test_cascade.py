"""Tuning of the whole cascade from one flight: gains, their errors, and logs that are refused."""

import dataclasses

import numpy as np
import pytest

from mimopilot.sitl.autopilot.autopilot import Autopilot
from mimopilot.sitl.flight.metrics import performance
from mimopilot.sitl.flight.scenario import doublet
from mimopilot.sitl.flight.simulator import fly
from mimopilot.sitl.physics.airframe import load_airframe
from mimopilot.tuning.design.cascade import tune
from mimopilot.tuning.design.cascade_estimate import estimate
from mimopilot.tuning.design.quality_checks import check_estimates, check_saturation
from mimopilot.tuning.errors import TuningError
from mimopilot.tuning.reference_model import second_order
from tests.tuning.analysis.test_certify import experiment
from tests.tuning.truth import thesis

TS = 0.004


@pytest.fixture(scope="module")
def log():
    return experiment("adam0")


@pytest.fixture(scope="module")
def tuned(log):
    return {method: tune(log, thesis(method=method)) for method in ("mimo", "siso")}


def test_the_rate_gains_have_the_structure_of_the_inertia(tuned):
    airframe = load_airframe("adam0").airframe
    J = np.array(airframe.inertia)[:2, :2]
    Kp = tuned["mimo"].Kp_i
    # K_p is proportional to the inertia, so that the torque decouples the axes.
    assert Kp / Kp[0, 0] == pytest.approx(J / J[0, 0], abs=0.01)
    # mu = M_max/J, d and the motor's lag give the ideal 400 (s + d)(tau s + 1)/(mu s (s + 16)) at low frequency.
    assert Kp[0, 0] == pytest.approx(0.1464, rel=0.02)


def test_siso_gains_are_diagonal(tuned):
    for name in ("Kp_o", "Kp_i", "Ki_i", "Kd_i"):
        matrix = getattr(tuned["siso"], name)
        assert matrix[0, 1] == matrix[1, 0] == 0
        assert (np.diag(matrix) != 0).all()


def test_refined_attitude_gains_follow_the_outer_model_better(log, tuned):
    airframe = load_airframe("adam0").airframe
    plain = tune(log, thesis(refine=False))
    inner, outer = second_order(20, 0.4, 0, TS), second_order(10, 0.7, 0, TS)
    for axis in ("roll", "pitch"):
        task = doublet(axis, np.radians(22.5), 0.42, TS)
        figures = {
            name: performance(fly(airframe, Autopilot(airframe, g), task, 3), inner, outer)
            for name, g in (("plain", plain), ("refined", tuned["mimo"]), ("siso", tuned["siso"]))
        }
        assert figures["refined"].J_M_o < 0.8 * figures["plain"].J_M_o
        assert figures["refined"].offaxis_peak_deg < figures["siso"].offaxis_peak_deg / 5


def test_the_pull_moves_the_estimate_towards_the_flown_gains(log, tuned):
    flown = log.flown.Kp_i
    near = tune(log, thesis(pull=1e4))
    assert near.Kp_i == pytest.approx(flown, abs=1e-3)
    slight = tune(log, thesis(pull=1e-9))
    assert slight.Kp_i == pytest.approx(tuned["mimo"].Kp_i, rel=1e-3)


def test_a_log_without_the_flown_gains_needs_a_specification(log):
    unknown = dataclasses.replace(log, flown=None)
    with pytest.raises(TuningError, match="yaw gains"):
        tune(unknown, thesis())
    yaw = {"Kp_o": 1.5, "Kp_i": 0.5, "Ki_i": 0.1, "Kd_i": 0.0}
    with pytest.raises(TuningError, match="derivative_cutoff_hz"):
        tune(unknown, thesis(yaw=yaw))
    gains = tune(unknown, thesis(yaw=yaw, derivative_cutoff_hz=30.0, moment_scale=(2.5, 2.5, 0.3)))
    assert gains.yaw.Kp_i == 0.5
    assert gains.moment_scale == (2.5, 2.5, 0.3)


def test_a_flight_without_excitation_or_on_one_axis_only_is_refused(log):
    with pytest.raises(TuningError, match="no excitation"):
        tune(dataclasses.replace(log, u_bar=None, r_o=None), thesis())
    one_axis = log.u_bar * [1.0, 0.0]
    for method in ("mimo", "siso"):
        with pytest.raises(TuningError, match="not excited on pitch"):
            tune(dataclasses.replace(log, u_bar=one_axis), thesis(method=method))


def test_a_log_of_noise_is_refused_by_the_quality_checks(log):
    rng = np.random.default_rng(0)
    noise = dataclasses.replace(log, u=0.1 * rng.standard_normal(log.u.shape), y_i=rng.standard_normal(log.u.shape))
    with pytest.raises(TuningError, match="not excited: the response from torque to rates is known at 0 frequencies"):
        tune(noise, thesis())
    found = estimate(noise, thesis())
    explained = r"the excitation explains .* of the signals that the roll gains are found from"
    with pytest.raises(TuningError, match=explained):
        check_estimates("log", found.stretches, found.inner, noise.Ts)


def test_a_saturated_flight_is_refused_and_occasional_saturation_gives_a_warning(log):
    limit = 0.999 * log.flown.limits.moment_max[0]
    often, sometimes = log.u.copy(), log.u.copy()
    often[::3] = limit + 0.01
    sometimes[::20] = limit + 0.01
    with pytest.raises(TuningError, match="saturated: the roll torque is at its limit for 33%"):
        check_saturation(dataclasses.replace(log, u=often))
    assert len(check_saturation(dataclasses.replace(log, u=sometimes))) == 2
    assert check_saturation(log) == []


def test_a_vibration_gives_a_warning_and_is_not_refused(log):
    """A tone of 110 Hz on the gyro: signals below it are explained as before."""
    t = np.arange(len(log.u)) * log.Ts
    tone = 3.0 * np.sin(2 * np.pi * 110 * t)[:, None] * np.ones(2)
    gains = tune(dataclasses.replace(log, y_i=log.y_i + tone), thesis())
    warnings = [text for text in gains.provenance.warnings if "a vibration" in text]
    assert warnings
    assert "of it below 40 Hz" in warnings[0]
