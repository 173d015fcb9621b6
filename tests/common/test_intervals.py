"""Confidence intervals: the score test's bounds, and coverage of quantiles."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.special import ndtri
from scipy.stats import binom

from mimopilot.common.intervals import quantile, wilson


@given(st.integers(1, 5000), st.data())
def test_wilsons_bounds_are_the_limits_of_the_score_test(n, data):
    k = data.draw(st.integers(0, n))
    z = ndtri(0.975)
    for bound, end in zip(wilson(k, n), (0, n), strict=True):
        if k == end:
            assert bound == end / n
        else:
            assert abs(k / n - bound) == pytest.approx(z * np.sqrt(bound * (1 - bound) / n), rel=1e-6)


@given(st.integers(1, 400), st.sampled_from([0.05, 0.5, 0.95]))
def test_intervals_of_quantiles_have_at_least_their_nominal_coverage(n, p):
    _, low, high = quantile(np.arange(n, dtype=float), p)
    # The quantile lies between the sorted samples i and i + 1 with the probability of i successes in n.
    first = 0 if np.isnan(low) else int(low) + 1
    last = n if np.isnan(high) else int(high)
    assert binom.pmf(np.arange(first, last + 1), n, p).sum() >= 0.95
    inside = binom.pmf(np.arange(first + 1, last), n, p).sum()
    assert inside < 0.95
