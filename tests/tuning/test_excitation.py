import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mimopilot.tuning.errors import TuningError
from mimopilot.tuning.excitation import hold_from_bandwidth, prbs


def test_fifty_rad_per_s_at_250_hz_holds_16_to_64_samples():
    assert hold_from_bandwidth(50.0, 1 / 250) == (16, 64)


@given(seed=st.integers(0, 1000), hold_min=st.integers(1, 20), spread=st.integers(0, 40))
def test_a_prbs_alternates_and_keeps_its_hold_times(seed, hold_min, spread):
    signal = prbs(3000, 0.15, hold_min, hold_min + spread, np.random.default_rng(seed))
    assert set(np.unique(np.abs(signal))) == {0.15}
    runs = np.diff(np.flatnonzero(np.diff(signal)))
    assert ((runs >= hold_min) & (runs <= hold_min + spread)).all()


def test_equal_seeds_give_equal_signals_and_others_do_not():
    one, same, other = (prbs(2000, 1.0, 16, 64, np.random.default_rng(s)) for s in (1, 1, 2))
    assert (one == same).all()
    assert (one != other).any()


def test_a_prbs_draws_only_a_sign_and_the_pulses_it_needs():
    generator, again = np.random.default_rng(5), np.random.default_rng(5)
    signal = prbs(500, 1.0, 16, 64, generator)
    again.integers(2)
    for _ in range(np.count_nonzero(np.diff(signal)) + 1):
        again.integers(16, 64, endpoint=True)
    assert generator.random() == again.random()


@pytest.mark.parametrize("bandwidth", [0.0, -1.0, 1e6, float("nan")])
def test_a_bandwidth_beyond_nyquist_or_not_positive_is_refused(bandwidth):
    with pytest.raises(TuningError, match="bandwidth"):
        hold_from_bandwidth(bandwidth, 0.004)
