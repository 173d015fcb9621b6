"""Non-minimum-phase zeros of plants with known zeros."""

import numpy as np
import pytest
from scipy.signal import cont2discrete, lfilter

from mimopilot.tuning.errors import TuningError
from mimopilot.tuning.estimation.zeros import flexible_model, slowest_zero
from mimopilot.tuning.excitation import prbs
from mimopilot.tuning.reference_model import second_order
from tests.tuning.analysis.test_certify import experiment

TS = 0.004
START = second_order(15, 0.7, 0, TS)


def closed_loop_data(zero, noise, seed=1, n=8000):
    """u, y and the injected torque of a rate plant 150 (1 - s/zero)/((s + 1.2)(0.05 s + 1)) under P = 0.02."""
    numerator = [150.0] if zero is None else [-150.0 / zero, 150.0]
    b, a, _ = cont2discrete((numerator, np.polymul([1.0, 1.2], [0.05, 1.0])), TS)
    rng = np.random.default_rng(seed)
    u_bar = prbs(n, 0.15, 16, 64, rng)
    closed = np.polyadd(a, 0.02 * b[0])
    y = lfilter(b[0], closed, u_bar) + lfilter(a, closed, noise * rng.standard_normal(n))
    return u_bar - 0.02 * y, y, u_bar[:, None]


@pytest.mark.parametrize("zero", [15.0, 30.0, 60.0])
def test_a_known_zero_is_found_in_closed_loop_with_and_without_noise(zero):
    for noise, accuracy in ((0.0, 0.02), (0.1, 0.08)):
        found = flexible_model(*closed_loop_data(zero, noise), START)
        assert found.nonminimum_phase_zeros() == [pytest.approx(zero, rel=accuracy)]
        assert np.sum(found.model.num) / np.sum(found.model.den) == pytest.approx(1.0, rel=1e-9)
        assert found.misfit < 1e-4


def test_no_zero_is_found_in_a_minimum_phase_plant_and_in_the_vehicle():
    assert flexible_model(*closed_loop_data(None, 0.02), START).nonminimum_phase_zeros() == []
    log = experiment("adam0")
    models = [flexible_model(log.u[:, i], log.y_i[:, i], log.u_bar, START) for i in range(2)]
    assert slowest_zero(models) is None


def test_short_or_unexcited_data_are_refused():
    u, y, w = closed_loop_data(30.0, 0.0)
    with pytest.raises(TuningError, match="too short"):
        flexible_model(u[:500], y[:500], w[:500], START)
    with pytest.raises(TuningError, match="output does not respond"):
        flexible_model(u, 0 * y, w, START)
