"""Figures of the certificate and their errors against the exact loop."""

import dataclasses
import itertools

import control
import numpy as np
import pytest

from mimopilot.tuning.analysis.certify import certify
from mimopilot.tuning.plant.frequency_response import PlantResponse
from mimopilot.tuning.plant.plant_estimates import PlantEstimates
from mimopilot.tuning.plant.rigid_body_fit import LOWEST
from mimopilot.tuning.statespace import StateSpace
from tests.tuning.analysis.loops import (
    MODELS,
    RIGID,
    defaults,
    exact,
    flown,
    grid,
    integrating,
    plain,
    random_sets,
    truth,
)
from tests.tuning.truth import TS, Truth, delay, experiment, series


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
    # From where the certificate begins.
    omega = np.geomspace(LOWEST, 700, 1400)
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


def test_the_errors_are_two_deviations_of_repeated_flights():
    """24 flights with independent noise; their mean is the true figure."""
    found = [
        certify(defaults(), PlantEstimates(experiment("adam0", seed, 0.05, seconds=10.0)).response, *MODELS).figures
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
            Ts=TS,
            **{k: np.concatenate([v, vars(island)[k]]) for k, v in vars(low).items() if k not in ("Ts", "angle_noise")},
        )
        # Two deviations of an element: the RMS of the error's largest singular value, here 2 * error.
        assert certify(gains, joined, *MODELS).figures["Ms"] == pytest.approx(1 / (0.6 - 2 * error), rel=1e-6)
