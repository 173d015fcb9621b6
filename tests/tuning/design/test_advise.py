"""The table of alternatives around the designed gains."""

import dataclasses

import numpy as np
import pytest

import mimopilot.tuning.design.advise as advisor
from mimopilot.tuning.design.advise import advise
from mimopilot.tuning.design.cascade import tune
from mimopilot.tuning.law_filters import Filters
from mimopilot.tuning.spec import TuningSpec
from tests.tuning.analysis.test_certify import experiment


@pytest.fixture(scope="module")
def log():
    return experiment("adam0_boom")


@pytest.fixture(scope="module")
def found(log):
    return advise(log, TuningSpec())


def figures(found, name):
    return next(one for one in found.candidates if one.name == name).prediction


def test_the_recommended_gains_are_those_of_tune(log, found):
    tuned, best = tune(log), found.recommended.gains
    for name in ("Kp_o", "Kp_i", "Ki_i", "Kd_i"):
        assert np.array_equal(getattr(best, name), getattr(tuned, name))
    assert [one.name for one in found.candidates] == [
        "recommended",
        "flown",
        "SISO",
        "slower",
        "faster",
        "quieter",
        "D filter 20 Hz",
        "D filter 10 Hz",
    ]
    assert found.refused == {}
    assert found.zero is None


def test_each_alternative_differs_as_its_name_says(log, found):
    best = figures(found, "recommended")
    assert np.hypot(*figures(found, "SISO").offaxis_deg) > 3 * np.hypot(*best.offaxis_deg)
    siso = next(one.gains for one in found.candidates if one.name == "SISO")
    assert siso.Kp_i[0, 1] == siso.Kd_i[1, 0] == 0.0
    assert np.hypot(*figures(found, "slower").disturbance_deg) > 1.1 * np.hypot(*best.disturbance_deg)
    bandwidths = {one.name: one.bandwidth for one in found.candidates}
    assert bandwidths["slower"] < bandwidths["recommended"] < bandwidths["faster"]
    flown = np.array(figures(found, "flown").noise)
    assert np.max(figures(found, "quieter").noise / flown) <= 1.01
    assert np.max(best.noise / flown) == pytest.approx(1.5, rel=0.03)
    for one in found.candidates:
        hertz = {"D filter 20 Hz": 20.0, "D filter 10 Hz": 10.0}.get(one.name, 30.0)
        assert one.gains.derivative_cutoff_hz == hertz


def test_lower_derivative_filters_than_the_flown_one_are_shown(log):
    fifteen = dataclasses.replace(log, flown=dataclasses.replace(log.flown, filters=Filters(log.flown.Ts, 15.0)))
    names = [one.name for one in advise(fifteen, TuningSpec()).candidates]
    assert [name for name in names if name.startswith("D filter")] == ["D filter 10 Hz"]


def test_a_zero_of_the_plant_is_reported(log, monkeypatch):
    monkeypatch.setattr(advisor, "slowest_zero", lambda models: 50.0)
    assert advise(log, TuningSpec()).zero == 50.0
