"""Figures and reasons of the certificate against plants whose closed loop is known exactly."""

import dataclasses
import itertools
import re
from functools import cache

import control
import numpy as np
import pytest
from mimopilot.sitl.physics.airframe import Frame, load_airframe
from mimopilot.tuning.analysis.beyond_band import find_structural_mode, loop_gain_above
from mimopilot.tuning.analysis.certificate import UNSTABLE_RADIUS, certify
from mimopilot.tuning.analysis.closed_loop import cascade_loop, model_spectral_radius
from mimopilot.tuning.analysis.stability_figures import GRID_STEP, sensitivity_peak
from mimopilot.tuning.certificate import Thresholds, Verdict
from mimopilot.tuning.design.cascade import certify_from_log, tune
from mimopilot.tuning.errors import TuningError
from mimopilot.tuning.gains_file import gains_from_toml, gains_to_toml
from mimopilot.tuning.law import Filters
from mimopilot.tuning.plant.frequency_response import DRAWS, PlantResponse
from mimopilot.tuning.plant.measured import Measured
from mimopilot.tuning.reference_model import second_order
from mimopilot.tuning.spec import TuningSpec
from mimopilot.tuning.statespace import StateSpace

from tests.tuning.truth import TS, Truth, delay, experiment, series

MODELS = ((second_order(20, 0.4, 0, TS),) * 2, (second_order(10, 0.7, 0, TS),) * 2)
RIGID = ("adam0", "adam0_boom", "adam0_nominal", "adam0_perturbed", "antr", "px4_sih")
PASSED = (Verdict.CERTIFIED, Verdict.THIN)
#: ANT-R hovers at 14 % of its thrust, where more torque is no longer linear; the rates of PX4's are noisy.
GOOD = {"antr": {"amplitude": 0.05}, "px4_sih": {"seconds": 40.0}}


def airframe(name, frame=None):
    body = load_airframe(name).airframe
    return body.model_copy(update={"frame": frame}) if frame else body


def defaults(name="adam0"):
    return load_airframe(name).default_gains()


@cache
def flown(name, frame=None):
    """Estimates from a flight with a good excitation."""
    return Measured(experiment(name, airframe=airframe(name, frame), **GOOD.get(name, {})))


@cache
def truth(name, frame=None):
    return Truth.of(airframe(name, frame))


def exact(plant, omega):
    """Response from an experiment without noise."""
    G, K = plant.frequency_response(omega), len(omega)
    nothing = np.zeros((K, 6, 6)), np.zeros((K, 2, 2))
    return PlantResponse(omega, G[:, :2], G[:, 2:], *nothing, np.ones((K, 2)), TS)


def scaled(gains, inner=1.0, outer=1.0):
    terms = {"Kp_o": outer, "Kp_i": inner, "Ki_i": inner, "Kd_i": inner, "Kff_i": inner}
    return dataclasses.replace(gains, **{name: getattr(gains, name) * factor for name, factor in terms.items()})


def random_set(base, rng):
    """A random gain set: slower and faster loops, with any coupling."""
    scale = {code: np.exp(rng.uniform(-1.2, 1.3)) for code in ("AP", "RP", "RI", "RD")}
    changes, elements = {}, base.elements()
    for code, value in elements.items():
        if code[:2] not in scale or code.endswith("Y"):
            continue
        diagonal = elements[code[:4] + code[3]]
        if code[3] == code[4]:
            changes[code] = float(value * scale[code[:2]] * np.exp(0.25 * rng.normal()))
        else:
            changes[code] = float(value + scale[code[:2]] * 0.25 * abs(diagonal) * rng.normal())
    return base.with_elements(changes)


def random_sets(name, count, seed):
    """Equally many unstable and well damped sets, by the exact loop."""
    rng, base, exactly = np.random.default_rng(seed), defaults(name), truth(name)
    unstable, damped = [], []
    while len(unstable) < count or len(damped) < count:
        gains = random_set(base, rng)
        if exactly.spectral_radius(gains) >= 1:
            if len(unstable) < count:
                unstable.append(gains)
        elif len(damped) < count:
            peak, phase = exactly.margins(gains, 400)
            if peak < 1.6 and phase >= 43:
                damped.append(gains)
    return unstable, damped


# Certified and refused sets


@pytest.mark.parametrize("name", [*RIGID, "adam0_flexible"])
def test_no_unstable_set_is_certified_and_well_damped_ones_are(name):
    unstable, damped = random_sets(name, 12, 7)
    plant = flown(name).response
    assert [g for g in unstable if certify(g, plant, *MODELS).verdict in PASSED] == []
    if name in RIGID:
        certified = [certify(g, plant, *MODELS).verdict == Verdict.CERTIFIED for g in damped]
        assert sum(certified) >= 0.95 * len(damped)


def test_well_damped_sets_are_certified_from_stronger_and_longer_flights_too():
    """The lowest frequencies are coherent but not linear: the band begins above them."""
    _, damped = random_sets("px4_sih", 12, 11)
    for log in (experiment("px4_sih", amplitude=0.25, bandwidth=60.0), experiment("px4_sih", seconds=40.0)):
        plant = Measured(log).response
        assert plant.known()[0]
        assert plant.known_run()[0] > 0
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
            assert found.verdict not in PASSED
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
    assert certify(gains, plant, *MODELS).verdict not in PASSED


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
    assert certificate.verdict == Verdict.NOT_CERTIFIED
    assert "excitation begins at 1.3 rad/s, where the sensitivity is still" in certificate.reason


# The figures


def delayed(plant, axis, samples):
    """The plant with additional delay between u and the torque of one axis."""
    late = delay(samples, TS)
    keep = [i for i in range(len(late.A)) if i % 2 == axis]
    A, B, C = late.A[np.ix_(keep, keep)], late.B[keep], late.C[:, keep]
    direct = np.diag([float(i != axis) for i in range(2)]) if samples else np.eye(2)
    return Truth(series(StateSpace(A, B, C, direct, TS), plant))


@pytest.mark.parametrize("name", ["adam0", "adam0_boom", "antr", "px4_sih"])
def test_every_figure_is_that_of_the_exact_loop(name):
    """Without noise; gain and delay margin by the poles of the changed loop, the others by independent formulas."""
    exactly, rng = truth(name), np.random.default_rng(3)
    # From 0.5 rad/s: the octaves below contribute nothing.
    omega = np.geomspace(0.5, 700, 1200)
    plant = exact(exactly.plant, omega)
    for gains in (defaults(name), *(random_sets(name, 2, 5)[1])):
        figures = certify(gains, plant, *MODELS).figures
        peak, phase = exactly.margins(gains)
        assert figures["Ms"] == pytest.approx(peak, rel=2e-3)
        assert min(figures["phase_margin_deg"].values()) == pytest.approx(phase, abs=0.2)
        errors = (figures["Ms_error"], figures["delta_error"], *figures["phase_margin_error_deg"].values())
        assert errors == pytest.approx((0, 0, 0, 0), abs=1e-9)
        L = exactly.return_ratio(gains, omega)
        S = np.linalg.inv(np.eye(2) + L)
        assert figures["distance"] == pytest.approx(np.abs(np.linalg.det(np.eye(2) + L)).min(), rel=1e-6)
        disk = 1 / max(np.linalg.svd(s - np.eye(2) / 2)[1][0] for s in S)
        assert figures["disk_margin"] == pytest.approx(disk, rel=1e-6)
        M = MODELS[0][0].frequency_response(omega)[:, None, None] * np.eye(2)
        inner = exactly.return_ratio(dataclasses.replace(gains, Kp_o=np.zeros((2, 2))), omega)
        D = M - (np.eye(2) - M) @ inner
        assert figures["delta"] == pytest.approx(max(np.linalg.svd(d)[1][0] for d in D), rel=1e-6)
        for i, axis in enumerate(("roll", "pitch")):
            loop = control.frd(1 / S[:, i, i] - 1, omega)
            _, pm, _, _, crossing, _ = control.stability_margins(loop)
            assert figures["phase_margin_deg"][axis] == pytest.approx(pm, abs=0.1)
            late = figures["delay_margin_ms"][axis] / 1e3 / TS
            assert late * TS == pytest.approx(np.radians(pm) / crossing, rel=0.01)
            assert delayed(exactly.plant, i, int(late)).spectral_radius(gains) < 1
            assert delayed(exactly.plant, i, int(late) + 1).spectral_radius(gains) > 1
            assert figures["gain_margin"][axis] == "exact"
            margin = 10 ** (figures["gain_margin_db"][axis] / 20)

            def radius(factor, row=i, gains=gains):
                factors = np.where(np.arange(2) == row, factor, 1.0)[:, None]
                names = ("Kp_i", "Ki_i", "Kd_i", "Kff_i")
                changed = {name: getattr(gains, name) * factors for name in names}
                return exactly.spectral_radius(dataclasses.replace(gains, **changed))

            assert radius(0.99 * margin) < 1
            assert radius(1 / (0.99 * margin)) < 1
            assert max(radius(1.01 * margin), radius(1 / (1.01 * margin))) > 1
        both = 10 ** (figures["simultaneous_gain_db"] / 20)
        for one, other in itertools.product((both, 1 / both, 1.0), repeat=2):
            factors = np.array([[one], [other]])
            changed = {name: getattr(gains, name) * factors for name in ("Kp_i", "Ki_i", "Kd_i", "Kff_i")}
            assert exactly.spectral_radius(dataclasses.replace(gains, **changed)) < 1
        turn = rng.uniform(-1, 1, (50, 2)) * np.radians(figures["simultaneous_phase_deg"])
        assert all(np.abs(np.linalg.det(np.eye(2) + np.exp(1j * t)[:, None] * L)).min() > 1e-3 for t in turn)


def test_the_figures_of_a_flight_are_those_of_the_exact_loop():
    """Thrust is the square of a rotor's speed, so a linear model about hover is accurate to a few percent."""
    for name in RIGID:
        figures = certify(defaults(name), flown(name).response, *MODELS).figures
        peak, phase = truth(name).margins(defaults(name))
        assert figures["Ms"] == pytest.approx(peak, rel=0.02)
        assert min(figures["phase_margin_deg"].values()) == pytest.approx(phase, abs=1.0)


def integrating(omega, error=0.0, coherence=1.0, K=100.0):
    """Response of a pure inertia, with the same relative error of every element."""
    s = 1j * omega[:, None, None]
    G, root = K / s * np.eye(2), np.zeros((len(omega), 6, 6))
    root[:, 2, 2] = root[:, 3, 3] = error * K / omega
    reach = np.tile(np.eye(2), (len(omega), 1, 1))
    return PlantResponse(omega, G, G / s, root, reach, np.full((len(omega), 2), coherence), TS)


def plain(kp=0.15, outer=4.0, ki=0.0, kd=0.0):
    """P, or PID, equal on both axes."""
    one, zero = np.eye(2), np.zeros((2, 2))
    return dataclasses.replace(
        defaults(),
        **{"Kp_o": outer * one, "Kp_i": kp * one, "Ki_i": ki * one, "Kd_i": kd * one, "Kff_i": zero},
        filters=Filters(0.004, 30.0),
    )


def grid(end, start=1.0, step=1.02):
    """Frequencies denser than `GRID_STEP`, so that nothing is interpolated."""
    return start * step ** np.arange(np.floor(np.log(end / start) / np.log(step)) + 1)


def test_the_errors_are_two_deviations_of_repeated_flights():
    """24 flights with independent noise; their mean is the true figure."""
    found = [
        certify(defaults(), Measured(experiment("adam0", seed, 0.05, seconds=10.0)).response, *MODELS).figures
        for seed in range(24)
    ]
    for axis in ("roll", "pitch"):
        phases = [f["phase_margin_deg"][axis] for f in found]
        claimed = np.sqrt(np.mean([f["phase_margin_error_deg"][axis] ** 2 for f in found]))
        assert claimed / np.std(phases, ddof=1) == pytest.approx(2.0, rel=0.4)
    for name in ("Ms", "delta"):
        claimed = np.sqrt(np.mean([f[f"{name}_error"] ** 2 for f in found]))
        assert claimed / np.std([f[name] for f in found], ddof=1) == pytest.approx(2.0, rel=0.4)
    assert np.mean([f["Ms"] for f in found]) == pytest.approx(truth("adam0").margins(defaults())[0], rel=0.02)


def test_sensitivity_peak_is_the_peak_of_the_certificate():
    plant = flown("adam0").response
    figures = certify(defaults(), plant, *MODELS).figures
    assert sensitivity_peak(defaults(), plant) == (figures["Ms"], figures["Ms_error"])


def test_a_peak_above_the_band_counts_with_its_error():
    """A loop of -0.4 measured at 150 rad/s only: sensitivity 1 / 0.6, and more with the error."""
    omega, gains = grid(60.0), plain(kp=0.1, outer=1.0)
    low = integrating(omega)
    assert certify(gains, low, *MODELS).figures["Ms"] < 1.2
    for error in (0.0, 0.05):
        island = integrating(np.array([150.0, 151.0]), error / 0.4)
        wanted = -0.4 / np.array([0.1])
        G_i = np.tile(wanted * np.eye(2), (2, 1, 1)).astype(complex)
        island = dataclasses.replace(island, G_i=G_i, G_o=0 * island.G_o)
        island.root[:] = 0
        island.root[:, 2, 2] = island.root[:, 3, 3] = error / 0.1
        joined = PlantResponse(
            Ts=TS, **{k: np.concatenate([v, vars(island)[k]]) for k, v in vars(low).items() if k != "Ts"}
        )
        # Two deviations of an element: the RMS of the error's largest singular value, here 2 * error.
        assert certify(gains, joined, *MODELS).figures["Ms"] == pytest.approx(1 / (0.6 - 2 * error), rel=1e-6)


# Outside the band


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


@pytest.mark.parametrize(("sensitivity", "verdict"), [(0.45, Verdict.CERTIFIED), (0.55, Verdict.NOT_CERTIFIED)])
def test_the_sensitivity_must_be_small_where_the_excitation_begins(sensitivity, verdict):
    """S = s^2 / (s^2 + 15 s + 60)."""
    w = np.linspace(1.0, 30.0, 20000)
    start = w[np.searchsorted(np.abs(w**2 / (60 - w**2 + 15j * w)), sensitivity)]
    found = certify(plain(), integrating(grid(60.0, start)), *MODELS)
    assert found.verdict == verdict
    if verdict == Verdict.NOT_CERTIFIED:
        assert f"excitation begins at {start:.1f} rad/s, where the sensitivity is still 0.55" in found.reason


@pytest.mark.parametrize(("Ki", "verdict"), [(0.2, Verdict.CERTIFIED), (-0.01, Verdict.NOT_CERTIFIED)])
def test_an_integral_that_diverges_below_the_excitation_is_not_certified(Ki, verdict):
    found = certify(plain(ki=Ki), integrating(grid(60.0)), *MODELS)
    assert found.verdict == verdict
    assert ("Ki_i through the measured plant is not positive" in found.reason) == (Ki < 0)


def test_too_few_known_frequencies_are_not_certified():
    found = certify(plain(), integrating(np.arange(1.0, 8.0)), *MODELS)
    assert (found.verdict, found.band) == (Verdict.NOT_CERTIFIED, (0.0, 0.0))
    assert "fewer than 8 frequencies in a row" in found.reason
    apart = integrating(np.array([*np.arange(1.0, 6.0), *np.arange(20.0, 25.0), *np.arange(50.0, 55.0)]))
    found = certify(plain(), apart, *MODELS)
    assert found.verdict == Verdict.NOT_CERTIFIED
    assert "the excitation reaches fewer than 8 frequencies in a row" in found.reason


# Structural modes


def with_peak(at, size, error=0.0, coherence=(0.0, 0.0)):
    """15 / s in the band, and loop gain `size` at one frequency above it, with an `error` of each element."""
    band = integrating(grid(100.0))
    one = integrating(np.array([at]), 0.0)
    one = dataclasses.replace(one, G_i=np.full((1, 2, 2), size / 0.15) * np.eye(2), coherence=np.array([coherence]))
    one.root[:, 2, 2] = one.root[:, 3, 3] = error / 0.15
    return PlantResponse(Ts=TS, **{k: np.concatenate([v, vars(one)[k]]) for k, v in vars(band).items() if k != "Ts"})


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
    # 2 * 0.14 is less than half of 0.6, but more than the 30 % below which a response is known.
    assert find_structural_mode(plain(), with_peak(150.0, 0.6, 0.14)) == pytest.approx((150.0, 0.88))
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


# The verdict


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
    assert sensitivity_peak(gains, plant)[1] == pytest.approx(2 * np.std(peaks), rel=0.3)


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


# Sealed with the gains


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
    with pytest.raises(TuningError, match=r"u = 1 stands for 2\.546, 2\.546 N m .* in the gains for 25, 25"):
        certify_from_log(log, other_unit)


def test_gains_that_the_log_makes_unstable_are_not_written():
    """Logs with strong gusts: a set may be refused or not certified, but no unstable one is certified."""
    for seed in range(4):
        log = experiment("adam0", seed, seconds=10.0, gusts=0.05, late=4)
        try:
            tuned = tune(log)
        except TuningError:
            continue
        radius = Truth.of(airframe("adam0"), late=4).spectral_radius(tuned)
        assert radius < 1 or tuned.verdict()[0] not in PASSED
