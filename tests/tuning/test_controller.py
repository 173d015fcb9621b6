"""The reference controller against the law of tuning: VRFT's regressor and the inverse."""

import dataclasses

import numpy as np
import pytest

from mimopilot.tuning.controller import Controller
from mimopilot.tuning.errors import TuningError
from mimopilot.tuning.gains import Limits
from mimopilot.tuning.law import rate_matrices, regressors
from mimopilot.tuning.law_filters import Filters
from mimopilot.tuning.law_inverse import inverse_law, rebuild_rate_setpoint
from tests.codegen.input_rows import quaternion

N = 400


def unlimited(gains):
    wide = (1e3, 1e3, 1e3)
    return dataclasses.replace(gains, limits=Limits(wide, wide, wide))


def fly(gains, seed=0):
    """Run the float64 controller on random setpoints and measurements; returns u, r_i and y_i."""
    rng = np.random.default_rng(seed)
    controller = Controller(gains, np.float64)
    y_o, y_i, r_o = (rng.standard_normal((N, 3)) * s for s in (0.2, 1.0, 0.2))
    for signal in (y_o, y_i, r_o):
        signal[:, 2] = 0
    steps = [controller.step(*pair, rate) for *pair, rate in zip(quaternion(r_o), quaternion(y_o), y_i, strict=True)]
    u, r_i = (np.array([getattr(s, name) for s in steps])[:, :2] for name in ("moment", "rates_setpoint"))
    return u, r_i, y_i[:, :2]


@pytest.mark.parametrize("cutoff", [0.0, 30.0])
def test_the_regressor_is_the_flown_difference_equation(gains, cutoff):
    gains = dataclasses.replace(unlimited(gains), filters=Filters(0.004, cutoff))
    u, r_i, y_i = fly(gains)
    x = regressors("PIDF", r_i - y_i, y_i, r_i, gains.filters)
    B = np.hstack([gains.Kp_i, gains.Ki_i, gains.Kd_i, gains.Kff_i])
    assert x @ B.T == pytest.approx(u, abs=1e-10)


def test_the_inverse_rate_controller_returns_the_rate_setpoint(gains):
    gains = unlimited(gains)
    u, r_i, y_i = fly(gains)
    rebuilt, settling = rebuild_rate_setpoint(gains, u, y_i)
    assert rebuilt == pytest.approx(r_i, abs=1e-9)
    assert settling > 0


def test_the_transient_of_the_unknown_integrator_decays_within_the_settling_time(gains):
    gains = unlimited(gains)
    u, r_i, y_i = fly(gains)
    rebuilt, settling = rebuild_rate_setpoint(gains, u + 0.1, y_i)  # as with an initial I of 0.1
    longer, _ = rebuild_rate_setpoint(
        gains, np.vstack([u + 0.1, np.full((settling, 2), 0.1)]), np.vstack([y_i, np.zeros((settling, 2))])
    )
    plain, _ = rebuild_rate_setpoint(
        gains, np.vstack([u, np.zeros((settling, 2))]), np.vstack([y_i, np.zeros((settling, 2))])
    )
    start = np.abs(longer - plain)[0].max()
    assert np.abs(longer - plain)[settling:].max() < 0.02 * start
    assert np.abs(rebuilt - r_i)[0].max() == pytest.approx(start, rel=1e-6)


def test_a_controller_that_is_not_minimum_phase_is_refused_with_its_eigenvalues(gains):
    negative = dataclasses.replace(gains, Ki_i=np.array([[0.25, 0.0], [0.0, -0.2]]))
    with pytest.raises(TuningError, match=r"not minimum phase.*1\.00"):
        rebuild_rate_setpoint(negative, np.zeros((N, 2)), np.zeros((N, 2)))


def test_the_poles_of_the_inverse_are_those_of_the_closed_form(gains):
    diagonal = dataclasses.replace(gains, Ki_i=np.diag([0.25, 0.2]), Kp_i=np.diag([0.15, 0.13]), Kff_i=np.zeros((2, 2)))
    expected = [0.15 / (0.15 + 0.004 * 0.25), 0.13 / (0.13 + 0.004 * 0.2)]
    got = inverse_law(rate_matrices(diagonal), diagonal.filters).eigenvalues
    assert sorted(got.real) == pytest.approx(sorted(expected), rel=1e-12)


def test_a_proportional_controller_can_be_inverted_too(gains):
    proportional = unlimited(dataclasses.replace(gains, Ki_i=np.zeros((2, 2))))
    u, r_i, y_i = fly(proportional)
    assert rebuild_rate_setpoint(proportional, u, y_i)[0] == pytest.approx(r_i, abs=1e-9)


def test_a_singular_controller_is_refused(gains):
    zero = np.zeros((2, 2))
    with pytest.raises(TuningError, match="singular"):
        rebuild_rate_setpoint(
            dataclasses.replace(gains, Kp_i=zero, Ki_i=zero, Kff_i=zero), np.zeros((N, 2)), np.zeros((N, 2))
        )


def test_the_derivative_of_a_ramp_settles_on_its_slope():
    ramp = 3.0 * 0.004 * np.arange(500)[:, None]
    filtered, plain = (-regressors("D", ramp, ramp, ramp, Filters(0.004, cutoff)) for cutoff in (30.0, 0.0))
    assert filtered[-1] == pytest.approx(3.0, rel=1e-9)
    assert plain[1:] == pytest.approx(3.0, rel=1e-9)
    assert filtered[0] == 0
