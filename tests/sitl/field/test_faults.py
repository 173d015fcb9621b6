"""Faults at random moments: the vehicle never holds a mixed or an unverified set without being told."""

import numpy as np
import pytest

from tests.sitl.field.faults import FAULTS, WHOLE_S, run_with_fault


@pytest.mark.parametrize("seed", range(10))
def test_a_fault_at_a_random_moment_leaves_one_named_set(scripted, seed):
    generator = np.random.default_rng(seed)
    fault, at = FAULTS[seed % len(FAULTS)], generator.uniform(0.0, WHOLE_S)
    messages = run_with_fault(scripted(seed=seed), fault, at, generator)
    print(fault.__name__, round(at, 1), messages)
