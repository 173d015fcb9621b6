"""SISO VRFT: the ideal controller, and the bias that each instrument removes."""

import numpy as np
import pytest

from mimopilot.tuning.errors import TuningError
from mimopilot.tuning.estimation.siso import siso_vrft, whitening_filter
from mimopilot.tuning.plant.pbsid import pbsid
from mimopilot.tuning.reference_model import ReferenceModel
from mimopilot.tuning.statespace import StateSpace

TS = 0.004
PLANT = StateSpace(np.array([[0.9]]), np.array([[1.0]]), np.array([[0.5]]), np.zeros((1, 1)), TS)
MODEL = ReferenceModel((0.2,), (1.0, -0.8), 0, TS)
#: C = G^-1 M/(1 - M) = 0.4 (z - 0.9)/(z - 1).
IDEAL = (0.36, (0.4 - 0.36) / TS)


def siso_data(seed, noise, coloured=False):
    rng = np.random.default_rng(seed)
    u = rng.choice([-1.0, 1.0], (5000, 1))
    if coloured:
        u = np.cumsum(0.2 * u, axis=0) * 0.5 + 0.5 * u
        u -= u.mean()
    clean = PLANT.simulate(u)
    return u, clean, clean + noise * rng.standard_normal(u.shape)


def gains(controller):
    return controller.gain("P").item(), controller.gain("I").item()


def tuned(u, y, **options):
    return siso_vrft(u, y, u, MODEL, "PI", weight="identity", **options)


def test_siso_vrft_without_noise_gives_the_ideal_controller_for_white_and_coloured_input():
    for coloured in (False, True):
        u, y, _ = siso_data(0, 0.0, coloured)
        assert gains(tuned(u, y, repeated=y)) == pytest.approx(IDEAL, rel=1e-3)


def test_every_instrument_removes_the_bias_of_least_squares():
    found = {name: [] for name in ("none", "second experiment", "model", "external")}
    for seed in range(8):
        u, clean, y = siso_data(seed, 0.3)
        again = clean + 0.3 * np.random.default_rng(seed + 50).standard_normal(u.shape)
        simulated = pbsid(u, y, TS, order=1).simulate(u)
        found["none"].append(gains(tuned(u, y, repeated=y)))
        for name, repeated in (("second experiment", again), ("model", simulated)):
            found[name].append(gains(tuned(u, y, repeated=repeated)))
        found["external"].append(gains(tuned(u, y)))
    bias = {name: np.abs(np.mean(values, axis=0) / IDEAL - 1)[0] for name, values in found.items()}
    for name in ("second experiment", "model", "external"):
        assert bias[name] < 0.25 * bias["none"], bias


def test_the_whitening_filter_of_an_autoregression_is_its_denominator():
    from scipy.signal import lfilter

    u = lfilter([1.0], [1.0, -1.2, 0.5], np.random.default_rng(0).standard_normal(200_000))
    taps = whitening_filter(u)
    assert taps[:3] == pytest.approx([1.0, -1.2, 0.5], abs=0.02)
    assert np.abs(taps[3:]).max() < 0.02


def test_a_zero_input_is_refused():
    u, _, y = siso_data(0, 0.1)
    with pytest.raises(TuningError, match="not excited"):
        tuned(0 * u, y)
