import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mimopilot.tuning.errors import TuningError
from mimopilot.tuning.estimation.correlations import cross_correlation
from mimopilot.tuning.estimation.vrft import vrft
from mimopilot.tuning.reference_model import ReferenceModel, second_order
from tests.paths import TOP

#: theory: G = [[0.09516, 0.03807], [-0.02974, 0.04758]]/(z - 0.9048), Ts = 1 s, as the thesis prints it.
G = np.array([[0.09516, 0.03807], [-0.02974, 0.04758]])
POLE = 0.9048
B0_PRINTED = (("0.8406", "-0.6726"), ("0.5254", "1.681"))
B1_PRINTED = (("-0.7606", "0.6086"), ("-0.4754", "-1.521"))


def first_order(pole: float) -> ReferenceModel:
    return ReferenceModel((1 - pole,), (1.0, -pole), 0, 1.0, label=f"first order {pole}")


def plant(u, pole=POLE, noise=None):
    y = np.zeros_like(u)
    for k in range(1, len(u)):
        y[k] = pole * y[k - 1] + G @ u[k - 1]
    return y if noise is None else y + noise


def white(n=2000, seed=0):
    return np.random.default_rng(seed).standard_normal((n, 2))


def polynomial_form(estimate):
    """(B0 z + B1)/(z - 1) of a PI: Kp = -B1, Ki = B0 + B1 at Ts = 1."""
    P, integral = estimate.gain("P"), estimate.gain("I")
    return P + integral, -P


@pytest.mark.parametrize("weight", ["identity", "optimal"])
def test_the_numerical_example_has_the_printed_digits(weight):
    u = white()
    estimate = vrft(u, plant(u), u, [first_order(0.9)] * 2, "PI", window=20, weight=weight)
    for got, printed in zip(polynomial_form(estimate), (B0_PRINTED, B1_PRINTED), strict=True):
        for i in range(2):
            for j in range(2):
                digits = len(printed[i][j].split(".")[1])
                assert abs(got[i, j] - float(printed[i][j])) <= 0.51 * 10.0**-digits


def test_different_models_per_axis_give_the_ideal_controller():
    # C = G^-1 M (I - M)^-1 is a PI when the plant is G / (z - a): Kp and Ki in closed form.
    u = white()
    models = [first_order(0.9), first_order(0.8)]
    estimate = vrft(u, plant(u), u, models, "PI", window=20)
    inverse = np.linalg.inv(G)
    # M (I-M)^-1 = diag(0.1, 0.2)/(z - 1), times (z - a): numerator z - a = (z - 1) a + (1 - a) z
    assert estimate.gain("P") == pytest.approx(POLE * inverse * [0.1, 0.2], rel=1e-6)
    assert estimate.gain("I") == pytest.approx((1 - POLE) * inverse * [0.1, 0.2], rel=1e-6)


def test_a_constant_disturbance_does_not_reach_the_gains():
    u = white()
    clean = vrft(u, plant(u), u, [first_order(0.9)] * 2, "PI", window=20)
    disturbed = vrft(u - [0.3, -0.2], plant(u), u, [first_order(0.9)] * 2, "PI", window=20)
    for term in "PI":
        assert disturbed.gain(term) == pytest.approx(clean.gain(term), rel=1e-6)


def test_an_external_instrument_removes_the_bias_of_measurement_noise():
    errors = {"external": [], "least squares": []}
    truth = POLE * np.linalg.inv(G) * 0.1
    for seed in range(10):
        u = white(4000, seed)
        noise = 0.2 * np.random.default_rng(seed + 100).standard_normal(u.shape)
        y = plant(u, noise=noise)
        for name, w in (("external", u), ("least squares", y)):
            estimate = vrft(u, y, w, [first_order(0.9)] * 2, "PI", window=10, weight="identity")
            errors[name].append(estimate.gain("P") - truth)
    bias = {name: np.abs(np.mean(e, axis=0)).max() for name, e in errors.items()}
    assert bias["external"] < 0.25 * bias["least squares"]


def test_rows_are_independent_problems_and_channels_may_be_rectangular():
    u = white()
    y = plant(u)
    both = vrft(u, y, u, [first_order(0.9)] * 2, "PI", window=15)
    first = vrft(u[:, :1], y, u, [first_order(0.9)] * 2, "PI", window=15)
    assert first.gain("P").shape == (1, 2)
    assert first.gain("P") == pytest.approx(both.gain("P")[:1], rel=1e-9)


def test_the_standard_deviation_is_that_of_repeated_experiments():
    models = [first_order(0.9)] * 2
    u = white(3000, 5)
    estimates, predicted = [], []
    for seed in range(60):
        noise = 0.05 * np.random.default_rng(seed + 1000).standard_normal(u.shape)
        estimate = vrft(u, plant(u, noise=noise), u, models, "PI", window=10)
        estimates.append(estimate.gain("P"))
        predicted.append(estimate.deviations["P"])
    ratio = np.std(estimates, axis=0) / np.mean(predicted, axis=0)
    # 60 runs determine a standard deviation to about 9 %: three of those, and the two-step weight's own error.
    assert (ratio > 0.6).all()
    assert (ratio < 1.4).all()


@given(n=st.integers(5, 80), lags=st.integers(0, 20), seed=st.integers(0, 99))
@settings(max_examples=40, deadline=None)
def test_correlations_by_fft_are_the_sums_themselves(n, lags, seed):
    rng = np.random.default_rng(seed)
    w, x = rng.standard_normal((n, 2)), rng.standard_normal((n, 3))
    direct = np.zeros((2 * lags + 1, 2, 3))
    for row, tau in enumerate(range(-lags, lags + 1)):
        for k in range(max(0, -tau), min(n, n - tau)):
            direct[row] += np.outer(w[k + tau], x[k])
    assert cross_correlation(w, x, lags) == pytest.approx(direct, abs=1e-10)


def test_segments_are_not_joined_across_a_gap():
    u = white(3000)
    y = plant(u)
    # The second half restarts from another state: if joined, the jump would look like plant behaviour.
    u2, y2 = np.vstack([u[:1500], u[1700:]]), np.vstack([y[:1500], y[1700:]])
    models = [first_order(0.9)] * 2
    estimate = vrft(u2, y2, u2, models, "PI", window=10, segments=[(0, 1500), (1500, 2800)])
    assert estimate.gain("P") == pytest.approx(POLE * np.linalg.inv(G) * 0.1, rel=1e-2)


def test_a_flight_that_is_too_short_or_not_excited_is_refused():
    u = white(60)
    with pytest.raises(TuningError, match=r"too short: .* without a gap longer than"):
        vrft(u, plant(u), u, [second_order(0.1, 0.7, 0, 1.0)] * 2, "PI")
    still = np.column_stack([white(2000)[:, 0], np.zeros(2000)])
    with pytest.raises(TuningError, match="not excited"):
        vrft(still, np.column_stack([still[:, 0], np.zeros(2000)]), still, [first_order(0.9)] * 2, "PI", window=10)


def test_the_printed_figures_are_those_of_the_table():
    tables = json.loads((TOP / "sitl/studies/thesis_tables.json").read_text())
    printed = tables["numerical_example"]["table_5_3"]["MIMO"]
    assert printed["B0"] == [[float(v) for v in row] for row in B0_PRINTED]
    assert printed["B1"] == [[float(v) for v in row] for row in B1_PRINTED]
