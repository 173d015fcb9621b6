"""Integral gains are replaced by the nearest ones that are positive through the plant."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
from scipy.optimize import minimize

from mimopilot.tuning.design.cascade_estimate import estimate
from mimopilot.tuning.design.positive_integral import MIN_INTEGRAL_RATIO, with_positive_integral
from mimopilot.tuning.errors import TuningError
from mimopilot.tuning.estimation.vrft import LoopEstimate
from mimopilot.tuning.plant.frequency_response import measured_plant
from mimopilot.tuning.plant.rigid_body_fit import RigidBody, rigid_body
from mimopilot.tuning.spec import TuningSpec
from tests.tuning.truth import experiment

BOTH = [(slice(0, 2), [(0, 1)])]


@dataclass(frozen=True)
class Known:
    """Given coefficients of a regression and their covariance."""

    B: np.ndarray
    covariance: np.ndarray


def loop(P, I, D, covariance):  # noqa: E741
    return LoopEstimate({"P": P, "I": I, "D": D}, 1000, 10, Known(np.hstack([P, I, D]), covariance))


def random_loop(seed):
    rng = np.random.default_rng(seed)
    factor = rng.standard_normal((2, 6, 6))
    covariance = factor @ factor.transpose(0, 2, 1) * 1e-3 + 1e-4 * np.eye(6)
    B = np.array([[90.0, 0], [0, 110.0]]) + 25 * rng.standard_normal((2, 2))
    P = 0.1 * np.eye(2) + 0.01 * rng.standard_normal((2, 2))
    I = np.diag([-0.3, 0.2]) + 0.15 * rng.standard_normal((2, 2))  # noqa: E741
    return loop(P, I, 0.003 * np.eye(2), covariance), RigidBody(B, np.ones((2, 2)))


def least(matrix):
    return np.linalg.eigvalsh((matrix + matrix.T) / 2)[0]


@pytest.mark.parametrize("seed", range(8))
def test_the_gains_are_the_most_likely_ones_that_do_not_diverge(seed):
    """All twelve coefficients against a general solver, without Cholesky factors or conditional means."""
    before, body = random_loop(seed)
    floor = MIN_INTEGRAL_RATIO * least(body.B @ before.gains["P"])
    ((after,), (warning,)) = with_positive_integral([before], BOTH, body)
    assert least(body.B @ after.gains["I"]) == pytest.approx(floor, rel=1e-4)
    roots = np.linalg.cholesky(before.solution.covariance)
    coefficients = np.hstack([after.gains[term] for term in "PID"])

    def whitened(matrix):
        away = matrix - before.solution.B
        return np.concatenate([np.linalg.solve(root, row) for root, row in zip(roots, away, strict=True)])

    def margin(values):
        # A symmetric matrix of two rows is above the floor where its trace and its determinant are.
        rows = [root @ row for root, row in zip(roots, values.reshape(2, 6), strict=True)]
        action = body.B @ (before.solution.B + rows)[:, 2:4] / floor
        rest = (action + action.T) / 2 - np.eye(2)
        return np.array([np.trace(rest), np.linalg.det(rest)])

    start = before.solution.B.copy()
    start[:, 2:4] = np.linalg.inv(body.B) * 30
    found = minimize(
        lambda values: float(values @ values),
        whitened(start),
        jac=lambda values: 2 * values,
        method="SLSQP",
        constraints={"type": "ineq", "fun": margin},
        options={"maxiter": 500, "ftol": 1e-10},
    )
    assert margin(found.x).min() > -1e-6
    # The problem is convex: a feasible point that is not farther is the solution; the general solver stops a bit short.
    ours = whitened(coefficients)
    assert margin(ours).min() > -1e-4
    assert ours @ ours <= found.fun * (1 + 1e-6)
    assert ours @ ours >= 0.7 * found.fun
    np.testing.assert_array_equal(after.solution.B, coefficients)
    for matrix in (before.gains["I"], after.gains["I"]):
        assert ", ".join(f"{v:.3g}" for v in matrix.ravel()) in warning


def test_a_single_axis_gets_the_smallest_integral_gain_allowed():
    """A diagonal design has one number: Ki = floor / B, and P follows by its covariance with Ki."""
    covariance = np.array([[[4.0, 1.0, 0.0], [1.0, 2.0, 0.0], [0.0, 0.0, 1.0]]])
    before = loop(np.array([[0.2]]), np.array([[-0.3]]), np.array([[0.0]]), covariance)
    body = RigidBody(np.diag([50.0, 80.0]), np.ones((2, 2)))
    ((after,), _) = with_positive_integral([before], [(slice(0, 1), [(0, 1)])], body)
    wanted = MIN_INTEGRAL_RATIO * 50 * 0.2 / 50
    assert after.gains["I"] == pytest.approx(wanted, rel=1e-6)
    assert after.gains["P"] == pytest.approx(0.2 + 1.0 / 2.0 * (wanted + 0.3), rel=1e-6)
    assert after.gains["D"] == pytest.approx(0.0)


def test_the_gains_of_a_good_log_keep_their_bits():
    log = experiment("adam0")
    body = rigid_body(measured_plant(log))
    spec = TuningSpec()
    free, kept = estimate(log, spec), estimate(log, spec, body=body)
    assert kept.gains.elements() == free.gains.elements()
    assert kept.warnings == free.warnings
    assert all(a.gains["I"].tobytes() == b.gains["I"].tobytes() for a, b in zip(free.inner, kept.inner, strict=True))


def test_a_noisy_log_gives_integral_gains_that_do_not_diverge():
    """Gusts of 10 % of the full torque: on some logs VRFT alone finds negative integral gains."""
    moved = 0
    for seed in range(6):
        log = experiment("adam0", seed, seconds=10.0, gusts=0.1, late=3)
        body, spec = rigid_body(measured_plant(log)), TuningSpec()
        free = estimate(log, spec).gains
        kept = estimate(log, spec, body=body)
        floor = MIN_INTEGRAL_RATIO * least(body.B @ free.Kp_i)
        assert body.least(kept.gains.Ki_i) >= 0.999 * floor
        warned = any("diverge" in text for text in kept.warnings)
        assert warned == (body.least(free.Ki_i) < floor)
        moved += warned
    assert moved >= 2


def test_proportional_gains_that_are_not_positive_are_refused():
    before, body = random_loop(0)
    wrong = loop(-before.gains["P"], before.gains["I"], before.gains["D"], before.solution.covariance)
    with pytest.raises(TuningError, match="proportional gains from VRFT are not positive"):
        with_positive_integral([wrong], BOTH, body)


def test_a_structure_without_integral_is_unchanged():
    before, body = random_loop(0)
    plain = replace(before, gains={"P": before.gains["P"]})
    assert with_positive_integral([plain], BOTH, body) == ([plain], [])
