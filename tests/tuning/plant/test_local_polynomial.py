import numpy as np
import pytest
from scipy.signal import lfilter

from mimopilot.tuning.errors import TuningError
from mimopilot.tuning.plant.local_polynomial import local_response


def signals(n=4000, noise=0.0, seed=0):
    """Two independent inputs, two outputs through known second-order filters, white noise on the outputs."""
    rng = np.random.default_rng(seed)
    w = rng.standard_normal((n, 2))
    a, b = [1, -1.5, 0.7], [0.5]
    y0 = lfilter(b, a, w[:, 0]) + 0.3 * w[:, 1]
    y1 = lfilter([0, 0.2], [1, -0.8], w[:, 1])
    return w, np.column_stack([y0, y1]) + noise * rng.standard_normal((n, 2))


def truth(omega):
    z = np.exp(-1j * omega)
    G = np.zeros((len(omega), 2, 2), complex)
    G[:, 0, 0] = 0.5 / (1 - 1.5 * z + 0.7 * z**2)
    G[:, 0, 1] = 0.3
    G[:, 1, 1] = 0.2 * z / (1 - 0.8 * z)
    return G


def test_a_known_response_is_found_without_leakage():
    w, y = signals()
    found = local_response(w, y, 1.0, [(0, 4000)])
    error = np.abs(found.response - truth(found.omega)).max()
    assert error < 0.02 * np.abs(truth(found.omega)).max()
    assert (found.explained > 0.99).all()


def test_two_segments_share_one_response_but_not_their_transients():
    w, y = signals(6000)
    offset = y.copy()
    offset[3000:] += 5.0
    joined = local_response(w, offset, 1.0, [(0, 3000), (3000, 6000)])
    assert np.abs(joined.response - truth(joined.omega)).max() < 0.05


def test_the_noise_spectrum_is_that_of_the_noise():
    w, y = signals(8000, noise=0.5)
    found = local_response(w, y, 1.0, [(0, 8000)])
    power = np.real(np.diagonal(found.noise, axis1=1, axis2=2)).mean(axis=0)
    assert power == pytest.approx(0.25, rel=0.1)


def test_errors_of_the_response_are_those_of_repeated_experiments():
    estimates, predicted = [], []
    for seed in range(40):
        w, y = signals(2000, noise=0.3, seed=seed)
        found = local_response(w, y, 1.0, [(0, 2000)])
        estimates.append(found.response)
        variance = np.real(np.einsum("kvv,kww->kvw", found.noise, found.error))
        predicted.append(variance)
    spread = np.var(estimates, axis=0).mean(axis=0)
    assert spread == pytest.approx(np.mean(predicted, axis=(0, 1)), rel=0.25)


def test_data_too_short_for_any_frequency_are_refused():
    w, y = signals(12)
    with pytest.raises(TuningError, match="too short"):
        local_response(w, y, 1.0, [(0, 12)])


def resonant(w, damping, Ts, n=12000, noise=0.0):
    """A gain of 1 with a narrow mode on top, driven by white noise."""
    rng = np.random.default_rng(1)
    x = rng.standard_normal((n, 1))
    pole = np.exp(Ts * (-damping * w + 1j * w * np.sqrt(1 - damping**2)))
    a = np.poly([pole, pole.conjugate()]).real
    b = np.array([0.0, a.sum() * 0.02 * 10, 0.0])
    y = x + lfilter(b, a, x, axis=0) + noise * rng.standard_normal((n, 1))
    return x, y, lambda omega: 1 + b[1] * np.exp(-1j * omega * Ts) / np.polyval(a[::-1], np.exp(-1j * omega * Ts))


def test_windows_are_narrow_around_a_mode_and_wide_elsewhere():
    """A mode of 1 % damping at 157 rad/s in 48 s: windows of 8 % would show its mean."""
    Ts, w = 0.004, 157.0
    x, y, exact = resonant(w, 0.01, Ts, noise=0.05)
    found = local_response(x, y, Ts, [(0, len(x))], 400.0, growth=0.08)
    steps = np.diff(found.omega)
    about = np.abs(found.omega[1:] - w) < 5.0
    assert steps[about].max() < 1.5
    assert np.median(steps[found.omega[1:] > 250]) > 10
    away = np.abs(found.response[:, 0, 0] - exact(found.omega)) / np.abs(exact(found.omega))
    assert np.median(away[np.abs(found.omega - w) < 10]) < 0.05
    top = found.omega[np.argmax(np.abs(found.response[:, 0, 0]))]
    assert top == pytest.approx(w, rel=0.01)
    assert np.abs(found.response[:, 0, 0]).max() > 0.7 * np.abs(exact(np.linspace(140, 170, 4000))).max()


def test_a_smooth_response_keeps_its_wide_windows_whatever_the_noise():
    x = np.random.default_rng(2).standard_normal((12000, 1))
    y = lfilter([0.1], [1, -0.9], x, axis=0) + 0.5 * np.random.default_rng(3).standard_normal((12000, 1))
    found = local_response(x, y, 0.004, [(0, 12000)], 700.0, growth=0.08)
    wide = np.diff(found.omega)[found.omega[1:] > 100] / found.omega[1:][found.omega[1:] > 100]
    assert np.mean(wide > 0.07) > 0.9


def test_short_segments_of_one_response_are_resolved_better_together():
    w, y = signals(400)
    parts = [(k, k + 100) for k in (0, 100, 200, 300)]
    alone, together = local_response(w, y, 1.0, parts[:1]), local_response(w, y, 1.0, parts)
    # One segment needs 17 bins for its 17 unknowns and degrees of freedom; of four, each needs 7, 3 for its transient.
    assert alone.omega[0] == pytest.approx(17 / 2 * 2 * np.pi / 100)
    assert together.omega[0] == pytest.approx(7 / 2 * 2 * np.pi / 100)
    assert np.abs(together.response - truth(together.omega)).max() < np.abs(alone.response - truth(alone.omega)).max()


def test_a_segment_too_short_for_its_own_transient_changes_no_window():
    w, y = signals(520)
    assert local_response(w, y, 1.0, [(0, 500), (510, 520)]).omega[0] == local_response(w, y, 1.0, [(0, 500)]).omega[0]
