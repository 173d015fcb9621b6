"""Figures of gain sets on the true plant against an independent closed loop, and the best gains for it."""

import dataclasses

import numpy as np
import pytest

from mimopilot.sitl.autopilot.autopilot import Autopilot
from mimopilot.sitl.flight.scenario import hover
from mimopilot.sitl.flight.simulator import fly
from mimopilot.sitl.physics.airframe import load_airframe
from mimopilot.sitl.studies.true_plant import (
    TruePlant,
    gust_spectrum,
    optimum_on_true_plant,
    true_response,
)
from mimopilot.tuning.analysis.manoeuvres import manoeuvres
from mimopilot.tuning.design.prediction import predict
from mimopilot.tuning.reference_model import SecondOrder
from tests.tuning.truth import Truth

TS = 0.004


def coupled(vehicle):
    """The default gains with some coupling and feed-forward: every path of the law is used."""
    gains, some = vehicle.default_gains(), np.array([[0.0, 0.1], [-0.05, 0.0]])
    return dataclasses.replace(
        gains,
        Kp_o=gains.Kp_o + 3 * some,
        Kp_i=gains.Kp_i @ (np.eye(2) + some),
        Ki_i=gains.Ki_i @ (np.eye(2) - some),
        Kff_i=0.1 * gains.Kp_i,
    )


@pytest.mark.parametrize("name", ["adam0", "adam0_flexible", "antr", "px4_sih"])
@pytest.mark.parametrize("factor", [0.5, 1.0, 4.0])
def test_margin_and_stability_are_those_of_an_independent_closed_loop(name, factor):
    vehicle = load_airframe(name)
    gains = coupled(vehicle)
    gains = dataclasses.replace(gains, Kp_i=factor * gains.Kp_i, Kd_i=factor * gains.Kd_i)
    ours, theirs = TruePlant(vehicle.airframe, TS), Truth.of(vehicle.airframe)
    assert ours.sensitivity_peak(gains) == pytest.approx(theirs.margins(gains)[0], rel=0.02)
    assert ours.spectral_radius(gains) == pytest.approx(theirs.spectral_radius(gains), abs=1e-6)


def test_the_noise_of_the_torque_is_that_of_a_simulated_hover():
    vehicle = load_airframe("px4_sih")
    airframe, gains = vehicle.airframe, vehicle.default_gains()
    plant = true_response(airframe, TS)
    found = predict(gains, plant, manoeuvres(plant, SecondOrder(10.0, 0.7).discretise(TS), gains.filters)).noise
    flown = fly(airframe, Autopilot(airframe, gains), hover("roll", 120.0, TS), 0).record["moment"][500:, :2]
    assert found == pytest.approx(flown.std(axis=0), rel=0.05)


def test_the_variance_of_gusts_is_the_integral_of_their_spectrum():
    omega = np.linspace(0, np.pi / TS, 200_001)
    assert np.trapezoid(gust_spectrum(omega, TS, 0.1), omega) * TS / np.pi == pytest.approx(0.01, rel=1e-3)


def test_the_optimum_keeps_its_limits_on_the_true_plant_and_follows_better_than_the_flown_gains():
    vehicle = load_airframe("adam0")
    airframe, flown = vehicle.airframe, vehicle.default_gains()
    best = optimum_on_true_plant(airframe, flown)
    truth = Truth.of(airframe)
    assert best.feasible
    assert truth.spectral_radius(best.gains) < 1
    assert truth.margins(best.gains)[0] < 1.6 * 1.01
    plant = true_response(airframe, TS)
    task = manoeuvres(plant, best.model.discretise(TS), best.law.filters)
    ours, before = (predict(one, plant, task) for one in (best.gains, flown))
    assert max(np.divide(ours.noise, before.noise)) < 1.5 * 1.01
    assert np.hypot(*ours.follow_deg) < 0.8 * np.hypot(*before.follow_deg)
    # The controller decouples: a diagonal one leaves the coupling of the inertia.
    assert np.hypot(*ours.offaxis_deg) < 0.2 * np.hypot(*before.offaxis_deg)
    # A wanted bandwidth is kept.
    assert optimum_on_true_plant(airframe, flown, bandwidth=5.0).model.omega == 5.0
