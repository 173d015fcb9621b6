"""Verdicts against the exact loop, their reasons, and their seal."""

import dataclasses
import re

import numpy as np
import pytest

from mimopilot.sitl.physics.airframe import Frame
from mimopilot.tuning.analysis.certify import UNSTABLE_RADIUS, certify
from mimopilot.tuning.analysis.closed_loop import cascade_loop, model_spectral_radius
from mimopilot.tuning.analysis.stability_figures import GRID_STEP
from mimopilot.tuning.certificate import ACCEPTED, Thresholds, Verdict
from mimopilot.tuning.design.cascade import certify_from_log, tune
from mimopilot.tuning.errors import TuningError
from mimopilot.tuning.gains import gains_to_toml
from mimopilot.tuning.gains_file import gains_from_toml
from mimopilot.tuning.plant.frequency_response import DRAWS
from mimopilot.tuning.plant.plant_estimates import PlantEstimates
from mimopilot.tuning.spec import TuningSpec, load_spec
from mimopilot.tuning.statespace import StateSpace
from tests.tuning.analysis.loops import (
    MODELS,
    RIGID,
    airframe,
    defaults,
    flown,
    grid,
    integrating,
    plain,
    random_set,
    random_sets,
    scaled,
    truth,
)
from tests.tuning.truth import TS, Truth, experiment


@pytest.mark.parametrize("name", [*RIGID, "adam0_flexible"])
def test_no_unstable_set_is_certified_and_well_damped_ones_are(name):
    unstable, damped = random_sets(name, 12, 7)
    plant = flown(name).response
    assert [g for g in unstable if certify(g, plant, *MODELS).verdict in ACCEPTED] == []
    if name in RIGID:
        certified = [certify(g, plant, *MODELS).verdict == Verdict.CERTIFIED for g in damped]
        assert sum(certified) >= 0.95 * len(damped)


def test_well_damped_sets_are_certified_from_stronger_and_longer_flights_too():
    _, damped = random_sets("px4_sih", 12, 11)
    for log in (experiment("px4_sih", amplitude=0.25, bandwidth=60.0), experiment("px4_sih", seconds=40.0)):
        plant = PlantEstimates(log).response
        assert sum(certify(g, plant, *MODELS).verdict == Verdict.CERTIFIED for g in damped) >= 11


@pytest.mark.parametrize(
    "frame",
    [
        Frame(frequency_hz=hz, damping=0.02, gain=gain)
        for hz, gain in ((12.0, 0.4), (25.0, 0.2), (25.0, 0.4), (25.0, 0.8), (30.0, 0.4))
    ],
    ids=str,
)
def test_a_structural_mode_is_never_certified_and_its_frequency_is_reported(frame):
    """Gains that are well damped on a rigid frame, flown on a flexible one."""
    base, bending = defaults(), truth("adam0", frame)
    plant, named = flown("adam0", frame).response, 0
    for factor in (0.6, 1.0, 1.5, 2.0, 3.0):
        gains = scaled(base, factor)
        stable = bending.spectral_radius(gains) < 1
        peak = bending.margins(gains)[0] if stable else np.inf
        found = certify(gains, plant, *MODELS)
        if peak > 1.8:
            assert found.verdict != Verdict.CERTIFIED
        if peak > 2.6:
            assert found.verdict not in ACCEPTED
        place = re.search(r"at (\d+) rad/s \((\d+) Hz\) the loop's gain may reach", found.reason)
        if place:
            named += 1
            assert float(place[1]) == pytest.approx(2 * np.pi * frame.frequency_hz, rel=0.02)
            assert float(place[2]) == pytest.approx(frame.frequency_hz, abs=0.51)
    assert named >= 1


def test_a_loop_whose_peak_lies_between_two_frequencies_is_not_certified():
    """The loop oscillates, and no measured frequency is close to the peak."""
    plant = flown("adam0").response
    gains = dataclasses.replace(
        defaults(),
        Kp_o=np.array([[3.60637712, 0.5622347], [-0.21474633, 2.40205198]]),
        Kp_i=np.array([[0.04127214, 0.01336016], [-0.00997128, 0.0399068]]),
        Ki_i=np.array([[0.42462993, 0.01774655], [-0.0068396, 0.37196562]]),
        Kd_i=np.array([[0.00359859, -0.00103487], [-0.00096178, 0.00885978]]),
    )
    assert truth("adam0").spectral_radius(gains) > 1
    coarse = np.linalg.inv(np.eye(2) + cascade_loop(gains, plant).L_u)
    fine = np.linalg.inv(np.eye(2) + cascade_loop(gains, plant.interpolated(GRID_STEP)).L_u)
    seen, there = (np.linalg.norm(S, ord=2, axis=(1, 2)).max() for S in (coarse, fine))
    assert there > 1.5 * seen
    assert certify(gains, plant, *MODELS).verdict not in ACCEPTED


def test_a_loop_that_is_unstable_below_the_excitation_is_not_certified():
    """With little gain it oscillates at 0.75 rad/s, below the measured band."""
    gains = dataclasses.replace(
        defaults("adam0_perturbed"),
        Kp_o=np.array([[3.9007844, -0.984454], [0.2805008, 2.474772]]),
        Kp_i=np.array([[0.01589068, 0.003974913], [0.01549479, 0.02283862]]),
        Ki_i=np.array([[0.006566379, 0.02338456], [-0.006409221, 0.01000748]]),
        Kd_i=np.array([[0.002297327, 9.970663e-05], [0.0004827753, 0.00801818]]),
    )
    assert truth("adam0_perturbed").spectral_radius(gains) > 1.0005
    certificate = certify(gains, flown("adam0_perturbed").response, *MODELS)
    assert certificate.verdict == Verdict.UNSTABLE
    assert "is unstable" in certificate.reason


def test_each_verdict_is_given_with_its_reason():
    plant, base, exactly = flown("adam0").response, defaults(), truth("adam0")
    assert certify(base, plant, *MODELS).verdict == Verdict.CERTIFIED
    reversed_axis = base.with_elements({"RP_PP": -0.15})
    assert exactly.spectral_radius(reversed_axis) > 1
    found = certify(reversed_axis, plant, *MODELS)
    assert (found.verdict, "rate loop" in found.reason) == (Verdict.UNSTABLE, True)
    fast_outer = base.with_elements({"AP_RR": 30.0, "AP_PP": 30.0})
    assert exactly.spectral_radius(fast_outer) > 1
    found = certify(fast_outer, plant, *MODELS)
    assert (found.verdict, "whole cascade" in found.reason) == (Verdict.UNSTABLE, True)
    found = certify(base, plant.at(plant.omega < 12), *MODELS)
    assert found.verdict == Verdict.NOT_CERTIFIED
    assert "excitation ends at" in found.reason


def test_a_set_that_is_unstable_on_some_drawn_plants_is_not_certified():
    """One percent below the exact limit of the attitude gain some of the drawn plants are unstable."""
    exactly, plant, base = truth("adam0"), flown("adam0").response, defaults()
    low, high = 1.0, 10.0
    for _ in range(40):
        middle = (low + high) / 2
        low, high = (middle, high) if exactly.spectral_radius(scaled(base, outer=middle)) < 1 else (low, middle)
    doubtful = dataclasses.replace(plant, root=15 * plant.root)
    found = certify(scaled(base, outer=0.99 * low), doubtful, *MODELS)
    assert found.verdict == Verdict.NOT_CERTIFIED
    count = re.search(rf"too close to instability: (\d+) of {DRAWS} plants", found.reason)
    assert count
    assert 0 < int(count[1]) < DRAWS
    assert certify(scaled(base, outer=1.6 * low), plant, *MODELS).verdict == Verdict.UNSTABLE


def noisy_body():
    """A loop whose figures have errors: Ms of 0.07, the phase margins of 7 degrees and more."""
    return plain(), integrating(grid(80.0), 0.15)


def test_the_error_of_the_peak_is_two_deviations_over_drawn_plants():
    """400 plants drawn from the same error, at the response's own frequencies."""
    gains, plant = noisy_body()
    rng = np.random.default_rng(9)
    S = [np.linalg.inv(np.eye(2) + cascade_loop(gains, plant.draw(rng)).L_u) for _ in range(400)]
    peaks = np.linalg.norm(S, ord=2, axis=(2, 3)).max(axis=1)
    assert certify(gains, plant, *MODELS).figures["Ms_error"] == pytest.approx(2 * np.std(peaks), rel=0.3)


def test_the_default_thresholds_are_those_of_the_documentation():
    assert Thresholds() == Thresholds(Ms=1.8, phase_deg=40.0, thin_Ms=2.5, thin_phase_deg=25.0)
    for wrong in ({"Ms": 3.0}, {"phase_deg": 20.0}, {"Ms": 1.0}, {"thin_Ms": float("inf")}, {"other": 1.0}):
        with pytest.raises(ValueError, match="validation error"):
            Thresholds(**wrong)


def model_with_radius(radius):
    """An integrator with the gain that gives the set of `plain` this spectral radius."""
    for K in np.linspace(50, 20000, 4000):
        model = StateSpace(np.eye(2), K * TS * np.eye(2), np.eye(2), np.zeros((2, 2)), TS)
        if model_spectral_radius(plain(), model) >= radius:
            return model
    raise AssertionError


def test_the_identified_model_is_computed_only_if_the_response_leaves_the_verdict_open():
    gains, asked = plain(), []

    def certified(plant, model):
        def given():
            asked.append(model)
            return model

        return certify(gains, plant, *MODELS, model=given)

    wide, narrow = integrating(grid(60.0)), integrating(grid(20.0))
    growing = model_with_radius(1.05)
    assert certified(wide, growing).verdict == Verdict.CERTIFIED
    assert not asked  # identification takes seconds and would change nothing
    found = certified(narrow, growing)
    assert found.verdict == Verdict.UNSTABLE
    assert re.match(r"around the model identified .* spectral radius is 1\.05\d\d; excitation ends at", found.reason)
    calm = StateSpace(np.eye(2), 100 * TS * np.eye(2), np.eye(2), np.zeros((2, 2)), TS)
    assert model_spectral_radius(gains, calm) < 1
    assert certified(narrow, calm).verdict == Verdict.NOT_CERTIFIED
    assert certified(narrow, None).verdict == Verdict.NOT_CERTIFIED
    assert len(asked) == 3
    assert UNSTABLE_RADIUS < 1.001


def test_the_spectral_radius_around_a_model_is_that_of_the_exact_loop():
    """With the exact sampled plant; the angle is integrated by the trapezoidal rule, not exactly."""
    exactly = truth("adam0").plant
    rates = StateSpace(exactly.A, exactly.B, exactly.C[:2], exactly.D[:2], TS)
    rng, compared = np.random.default_rng(2), 0
    while compared < 20:
        gains = random_set(defaults(), rng)
        radius = truth("adam0").spectral_radius(gains)
        if radius > 1.0005:
            compared += 1
            around = model_spectral_radius(gains, rates)
            inner = truth("adam0").spectral_radius(dataclasses.replace(gains, Kp_o=1e-9 * gains.Kp_o))
            assert around == pytest.approx(max(radius, inner), abs=2e-4)


def test_a_gains_file_keeps_the_verdict_and_its_thresholds():
    log = flown("adam0").experiment
    spec = TuningSpec(certificate=Thresholds(Ms=1.1, thin_Ms=3.0))
    tuned = certify_from_log(log, defaults(), spec)
    assert tuned.verdict()[0] == Verdict.THIN
    assert tuned.certificate.thresholds["Ms"] == 1.1
    assert tuned.certificate.log_sha256 == log.sha256
    read = gains_from_toml(gains_to_toml(tuned), "x")
    assert read.verdict() == tuned.verdict()
    assert certify_from_log(log, defaults()).verdict()[0] == Verdict.CERTIFIED
    assert dataclasses.replace(tuned, certificate=None).verdict()[0] == "none"
    other_unit = dataclasses.replace(tuned, moment_scale=(25.0, 25.0, 2.7))
    assert other_unit.verdict()[0] == "void"
    with pytest.raises(TuningError, match=r"u = 1 stands for 2\.546, 2\.546 N m .* not for 25, 25; convert"):
        certify_from_log(log, other_unit)
    with pytest.raises(TuningError, match=r"u = 1 stands for 2\.546, 2\.546 N m .* leave moment_scale out"):
        tune(log, load_spec(moment_scale=(0.01, 0.01, 0.002)))


def test_gains_that_the_log_makes_unstable_are_not_written():
    """Logs with strong gusts: a set may be refused or not certified, but no unstable one is certified."""
    for seed in range(4):
        log = experiment("adam0", seed, seconds=10.0, gusts=0.05, late=4)
        try:
            tuned = tune(log)
        except TuningError:
            continue
        radius = Truth.of(airframe("adam0"), late=4).spectral_radius(tuned)
        assert radius < 1 or tuned.verdict()[0] not in ACCEPTED


def test_model_following_changes_the_answer_to_the_setpoint_and_not_the_loops():
    """Without feed-forward T_o is that without a model times the model; feed-forward adds G (C_r Kff_o w + Kaff al)."""
    omega = np.geomspace(0.5, 200, 60)
    plant, gains = integrating(omega), plain()
    off = cascade_loop(gains, plant)
    filters = dataclasses.replace(gains.filters, model_omega=8.0, model_damping=0.6)
    model = dataclasses.replace(gains, filters=filters)
    on = cascade_loop(model, plant)
    z = np.exp(1j * omega * gains.Ts)
    q, c = (8.0 * gains.Ts) ** 2, 2 * 0.6 * 8.0 * gains.Ts
    M = (q * z**2 / (z**2 - (2 - c - q) * z + 1 - c))[:, None, None]
    assert (on.L_u == off.L_u).all() and (on.L_i == off.L_i).all()
    assert on.T_o == pytest.approx(off.T_o * M, rel=1e-12)
    fed = dataclasses.replace(model, Kff_o=np.diag([1.0, 0.5]), Kaff_i=np.array([[0.01, 0.002], [0.0, 0.01]]))
    w = ((z - 1) / (z * gains.Ts))[:, None, None] * M
    al = ((z - 1) / (z * gains.Ts))[:, None, None] * w
    # Plain P: C_r = Kp_i.
    extra = gains.Kp_i @ fed.Kff_o * w + fed.Kaff_i * al
    found = cascade_loop(fed, plant)
    assert found.U_o - on.U_o == pytest.approx(np.linalg.solve(np.eye(2) + off.L_u, extra), abs=1e-12)
    assert found.T_o == pytest.approx(plant.G_o @ found.U_o, rel=1e-12)
    assert (found.L_u == off.L_u).all()
