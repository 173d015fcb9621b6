"""The loop outside the measured band: bounds, and structural modes."""

import dataclasses

import numpy as np
import pytest

from mimopilot.tuning.analysis.beyond_band import find_structural_mode, loop_gain_above
from mimopilot.tuning.analysis.certify import certify
from mimopilot.tuning.certificate import Verdict
from mimopilot.tuning.plant.frequency_response import PlantResponse
from tests.tuning.analysis.loops import (
    MODELS,
    defaults,
    exact,
    grid,
    integrating,
    plain,
    truth,
)
from tests.tuning.truth import TS


@pytest.mark.parametrize(("reached", "verdict"), [(0.45, Verdict.CERTIFIED), (0.55, Verdict.NOT_CERTIFIED)])
def test_above_the_band_the_loop_gain_may_reach_one_half(reached, verdict):
    """15 / s: if the excitation ends at 15 / 0.45 rad/s the gain may reach 0.45 above."""
    gains, omega = plain(), grid(60.0)
    plant = integrating(omega * 15 / reached / omega[-1])
    assert loop_gain_above(gains, plant) == pytest.approx(15 / plant.omega, rel=1e-9)
    found = certify(gains, plant, *MODELS)
    assert found.verdict == verdict
    if verdict == Verdict.NOT_CERTIFIED:
        end = f"excitation ends at {plant.omega[-1]:.0f} rad/s"
        assert f"{end}, where the loop's gain may still reach 0.55" in found.reason


def test_the_bound_above_the_band_is_that_of_a_plant_falling_like_an_integrator():
    gains, plant = plain(kd=0.004), integrating(grid(50.0))
    w = np.linspace(50, np.pi / TS, 20000)
    z, a = np.exp(1j * w * TS), np.exp(-2 * np.pi * 30 * TS)
    controller = 0.15 + 0.004 * (1 - a) * (z - 1) / (TS * (z - a))
    assert loop_gain_above(gains, plant)[-1] == pytest.approx(np.max(100 / w * np.abs(controller)), rel=0.01)


def test_the_bound_above_the_band_is_less_sensitive_to_noise_than_its_last_value():
    """w |G| does not rise: a fit with that constraint is closer to the truth than the last value alone."""
    gains = defaults()
    plant, rng = exact(truth("adam0").plant, np.linspace(2.0, 110.0, 50)), np.random.default_rng(3)
    true = loop_gain_above(gains, plant)[-1]
    fitted, last = [], []
    for _ in range(200):
        shape = (50, 2, 2)
        noise = (rng.normal(size=shape) + 1j * rng.normal(size=shape)) * 0.1
        noisy = dataclasses.replace(plant, G_i=plant.G_i + noise * np.abs(plant.G_i).max(axis=(1, 2), keepdims=True))
        fitted.append(loop_gain_above(gains, noisy)[-1] / true - 1)
        last.append(loop_gain_above(gains, noisy.at([-1]))[-1] / true - 1)
    assert np.std(fitted) < 0.8 * np.std(last)
    assert abs(np.mean(fitted)) < abs(np.mean(last))


def test_a_large_attitude_path_above_the_band_is_not_certified():
    """The rate loop's gain is 0.3 there, and the attitude path adds 0.8."""
    omega = grid(30.0)
    gains, plant = plain(kp=0.3 * omega[-1] / 100, outer=0.8 / 0.3 * omega[-1]), integrating(omega)
    found = certify(gains, plant, *MODELS)
    assert found.verdict == Verdict.NOT_CERTIFIED
    assert "where the whole cascade's gain may still reach 1" in found.reason


@pytest.mark.parametrize(("sensitivity", "measured"), [(1.4, True), (1.51, False)])
def test_the_frequencies_at_which_the_loop_amplifies_must_be_measured(sensitivity, measured):
    """S = s^2 / (s^2 + 15 s + 459)."""
    w = np.linspace(1.0, 30.0, 20000)
    start = w[np.argmax(np.abs(w**2 / (459 - w**2 + 15j * w)) >= sensitivity)]
    found = certify(plain(outer=459 / 15), integrating(grid(60.0, start)), *MODELS)
    text = f"excitation begins at {start:.1f} rad/s, where the sensitivity is still {sensitivity:.2f}"
    assert (text in found.reason) != measured


@pytest.mark.parametrize(("Ki", "verdict"), [(0.2, Verdict.CERTIFIED), (-0.01, Verdict.UNSTABLE)])
def test_an_integral_that_diverges_below_the_excitation_is_not_certified(Ki, verdict):
    found = certify(plain(ki=Ki), integrating(grid(60.0)), *MODELS)
    assert found.verdict == verdict
    assert ("the rate loop alone is unstable" in found.reason) == (Ki < 0)


def test_too_few_known_frequencies_are_not_certified():
    found = certify(plain(), integrating(np.arange(1.0, 8.0)), *MODELS)
    assert (found.verdict, found.band) == (Verdict.NOT_CERTIFIED, (0.0, 0.0))
    assert "fewer than 8 frequencies in a row" in found.reason
    apart = integrating(np.array([*np.arange(1.0, 6.0), *np.arange(20.0, 25.0), *np.arange(50.0, 55.0)]))
    found = certify(plain(), apart, *MODELS)
    assert found.verdict == Verdict.NOT_CERTIFIED
    assert "the excitation reaches fewer than 8 frequencies in a row" in found.reason


def with_peak(at, size, error=0.0, coherence=(0.0, 0.0)):
    """15 / s in the band, and loop gain `size` at one frequency above it, with an `error` of each element."""
    band = integrating(grid(100.0))
    one = integrating(np.array([at]), 0.0)
    one = dataclasses.replace(one, G_i=np.full((1, 2, 2), size / 0.15) * np.eye(2), coherence=np.array([coherence]))
    one.root[:, 2, 2] = one.root[:, 3, 3] = error / 0.15
    return PlantResponse(
        Ts=TS, **{k: np.concatenate([v, vars(one)[k]]) for k, v in vars(band).items() if k not in ("Ts", "angle_noise")}
    )


def test_a_structural_mode_is_found_with_its_frequency_and_gain_plus_error():
    assert find_structural_mode(plain(), integrating(grid(100.0))) is None
    assert find_structural_mode(plain(), with_peak(150.0, 0.45)) is None
    assert find_structural_mode(plain(), with_peak(150.0, 0.6)) == pytest.approx((150.0, 0.6))
    # sqrt(4) deviations of an element.
    assert find_structural_mode(plain(), with_peak(150.0, 0.45, 0.04)) == pytest.approx((150.0, 0.53))
    assert find_structural_mode(plain(), with_peak(150.0, 0.45, 0.02)) is None


def test_a_gain_counts_if_one_axis_is_coherent_or_its_error_is_small():
    assert find_structural_mode(plain(), with_peak(150.0, 0.6, 0.4)) is None
    for coherence in ((0.8, 0.0), (0.0, 0.8)):
        found = find_structural_mode(plain(), with_peak(150.0, 0.6, 0.4, coherence))
        assert found == pytest.approx((150.0, 1.4))
    # 2 * 0.11 is less than 0.4 of 0.6, but more than the 30 % below which a response is known.
    assert find_structural_mode(plain(), with_peak(150.0, 0.6, 0.11)) == pytest.approx((150.0, 0.82))
    assert find_structural_mode(plain(), with_peak(150.0, 0.6, 0.16)) is None


@pytest.mark.parametrize(("ratio", "counts"), [(1.2, False), (1.35, True), (2.5, True)])
def test_a_gain_above_the_limit_counts_only_well_above_the_crossover(ratio, counts):
    """15 / s is below one half from 30 rad/s on."""
    plant = integrating(grid(120.0))
    k = int(np.argmin(np.abs(plant.omega - 30 * ratio)))
    plant.G_i[k] *= 0.55 / (15 / plant.omega[k])
    assert (find_structural_mode(plain(), plant) is not None) == counts


def test_a_structural_mode_is_not_certified_and_a_remedy_is_given():
    found = certify(plain(), with_peak(157.0, 0.6), *MODELS)
    assert found.verdict == Verdict.NOT_CERTIFIED
    assert "at 157 rad/s (25 Hz) the loop's gain may reach 0.60 again" in found.reason
    assert "a mode of the frame" in found.reason


def test_a_band_that_begins_above_the_crossover_says_nothing_about_the_margins():
    """The loop is 15 / s and more slowly that of the attitude; at 45 rad/s the sensitivity is below its limit there."""
    gains = plain()
    found = certify(gains, integrating(grid(120.0, start=45.0, step=1.01)), *MODELS)
    assert found.verdict == Verdict.NOT_CERTIFIED
    assert "excitation begins at 45.0 rad/s, where the loop's gain is 0.33 in its weakest direction" in found.reason
    assert "the crossover is not measured" in found.reason


def test_the_widest_band_in_octaves_is_the_known_one_whatever_the_number_of_its_frequencies():
    """Two octaves of ten frequencies against a tenth of an octave of a hundred."""
    wide, dense = np.geomspace(5.0, 20.0, 10), np.linspace(600.0, 640.0, 100)
    plant = integrating(np.concatenate([wide, [100.0], dense]))
    coherence = plant.coherence.copy()
    coherence[10] = 0.0
    reach = plant.reach.copy()
    reach[10] *= 1e9
    known = dataclasses.replace(plant, coherence=coherence, reach=reach).known_run()
    assert known.tolist() == list(range(10))
