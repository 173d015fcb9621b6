"""The scan of rate-loop models: predicted doublets and the recommendation."""

import dataclasses

import numpy as np
import pytest

import mimopilot.tuning.design.advise as advisor
from mimopilot.sitl.autopilot.autopilot import Autopilot
from mimopilot.sitl.flight.scenario import doublet
from mimopilot.sitl.flight.simulator import fly
from mimopilot.sitl.physics.airframe import load_airframe
from mimopilot.tuning.certificate import Verdict
from mimopilot.tuning.design.advise import Doublet, advise, predict_doublet
from mimopilot.tuning.design.cascade import tune
from mimopilot.tuning.errors import TuningError
from mimopilot.tuning.law import Filters
from mimopilot.tuning.plant.frequency_response import plant_response
from mimopilot.tuning.spec import TuningSpec
from tests.tuning.analysis.test_certify import experiment
from tests.tuning.truth import thesis

TS = 0.004


@pytest.fixture(scope="module")
def log():
    return experiment("adam0")


def rms(signal):
    return float(np.sqrt(np.mean(signal**2)))


def test_the_predicted_doublet_matches_the_flown_one(log):
    airframe = load_airframe("adam0").airframe
    plant = plant_response(log, log.u_bar, 300.0)
    spec = thesis()
    for gains in (log.flown, tune(log, thesis())):
        follow, offaxis, effort = predict_doublet(gains, plant, spec, Doublet(amplitude_deg=10.0, period_s=0.8))
        for column, axis in enumerate(("roll", "pitch")):
            task = doublet(axis, np.radians(10.0), 0.8, TS, tail=0.8)
            flight = fly(airframe, Autopilot(airframe, gains), task, noise=False)
            rows = slice(task.window[0], task.window[0] + round(1.6 / TS))
            model = spec.models("outer", TS)[column].response(task.setpoint[:, column])
            angles, moments = flight.truth["attitude"][rows], flight.record["moment"][rows, :2]
            away = np.degrees(angles[:, column] - model[rows])
            assert follow[column] == pytest.approx(rms(away), rel=0.1)
            # The edges of the torque contain frequencies above those measured.
            assert effort[column] == pytest.approx(np.sqrt(2) * rms(moments), rel=0.15)
            # The off-axis angle is small: it is predicted to a few hundredths of a degree.
            assert offaxis[column] == pytest.approx(rms(np.degrees(angles[:, 1 - column])), rel=0.15, abs=0.06)


def test_the_recommended_model_is_certified_and_follows_better_than_that_of_the_thesis(log, monkeypatch):
    monkeypatch.setattr(advisor, "BANDWIDTHS", (20.0, 30.0))
    monkeypatch.setattr(advisor, "DAMPINGS", (0.4, 1.0))
    monkeypatch.setattr(advisor, "DELAYS", (0, 2))
    found = advise(log, TuningSpec(derivative_cutoff_hz=30.0))
    candidates, best = found.candidates, found.recommended
    assert found.zero is None
    assert len(candidates) == 8
    thesis = next(c for c in candidates if c.inner == (20.0, 0.4, 0))
    assert best.verdict == Verdict.CERTIFIED
    assert np.hypot(*best.follow_deg) < 0.6 * np.hypot(*thesis.follow_deg)
    for other in candidates:
        if other.verdict == Verdict.CERTIFIED and np.hypot(*other.follow_deg) <= np.hypot(*best.follow_deg):
            assert np.hypot(*other.effort) >= np.hypot(*best.effort)


def test_without_a_certified_candidate_nothing_is_recommended(log, monkeypatch):
    monkeypatch.setattr(advisor, "BANDWIDTHS", (60.0,))
    monkeypatch.setattr(advisor, "DAMPINGS", (0.2,))
    monkeypatch.setattr(advisor, "DELAYS", (0,))
    with pytest.raises(TuningError, match="none of 1 rate loops is certified"):
        advise(log, TuningSpec(derivative_cutoff_hz=30.0))


def test_the_scan_tries_no_rate_loop_faster_than_half_of_the_zero(monkeypatch):
    monkeypatch.setattr(advisor, "BANDWIDTHS", (20.0, 40.0))
    monkeypatch.setattr(advisor, "DAMPINGS", (1.0,))
    monkeypatch.setattr(advisor, "DELAYS", (0,))
    log = experiment("adam0")
    spec = TuningSpec(derivative_cutoff_hz=30.0)
    assert [c.inner[0] for c in advise(log, spec).candidates] == [20.0, 40.0]
    monkeypatch.setattr(advisor, "slowest_zero", lambda models: 50.0)
    found = advise(log, spec)
    assert found.zero == 50.0
    assert [c.inner[0] for c in found.candidates] == [20.0]
    monkeypatch.setattr(advisor, "slowest_zero", lambda models: 20.0)
    with pytest.raises(TuningError, match=r"zero at 20\.0 rad/s, too slow"):
        advise(log, spec)


def test_the_scan_tries_lower_derivative_cutoffs_than_the_flown_one(monkeypatch):
    monkeypatch.setattr(advisor, "BANDWIDTHS", (20.0,))
    monkeypatch.setattr(advisor, "DAMPINGS", (1.0,))
    monkeypatch.setattr(advisor, "DELAYS", (0,))
    log = experiment("adam0")
    assert [c.cutoff_hz for c in advise(log, thesis()).candidates] == [30.0, 10.0, 5.0]
    eight = dataclasses.replace(log, flown=dataclasses.replace(log.flown, filters=Filters(log.flown.Ts, 8.0)))
    found = advise(eight, thesis())
    assert [c.cutoff_hz for c in found.candidates] == [8.0, 5.0]
    for c in found.candidates:
        assert c.gains.derivative_cutoff_hz == c.cutoff_hz
        assert c.delta[0] == c.gains.certificate.figures["delta"]
