"""The closed loop of the design and its derivatives, against the law's own responses and finite differences."""

import dataclasses

import numpy as np
import pytest

from mimopilot.sitl.physics.airframe import load_airframe
from mimopilot.tuning.analysis.closed_loop import cascade_loop
from mimopilot.tuning.control_laws import control_law
from mimopilot.tuning.design.free_gains import free_gains
from mimopilot.tuning.design.loop_gradient import LoopGradient
from mimopilot.tuning.law import cascade_response
from mimopilot.tuning.plant.frequency_response import PlantResponse
from mimopilot.tuning.plant.plant_estimates import PlantEstimates
from mimopilot.tuning.plant.wide_response import wide_response
from tests.conftest import stock_gains
from tests.tuning.analysis.test_certify import experiment

RESPONSES = {"L_i": "dL_i", "L_u": "dL_u", "U": "dU", "T": "dT", "T_y": "dT_y", "D": "dD", "noise": "dnoise"}
STEP = 1e-5


@pytest.fixture(scope="module")
def plant():
    return wide_response(PlantEstimates(experiment("adam0_boom")))


@pytest.fixture(params=[0.0, 9.0, None], ids=["without a model", "model following", "stock"])
def gains(request):
    """Full matrices everywhere, so that no derivative vanishes; None: the stock law with the most filters."""
    if request.param is None:
        stock = stock_gains("ardupilot-stock")
        return dataclasses.replace(stock, filters=dataclasses.replace(stock.filters, Ts=0.004))
    generator = np.random.default_rng(3)
    base = load_airframe("adam0_boom").default_gains()
    moved = {
        name: getattr(base, name) + 0.2 * generator.standard_normal((2, 2)) * abs(base.Kp_i[0, 0])
        for name in ("Kp_i", "Ki_i", "Kff_i")
    }
    moved |= {
        "Kp_o": base.Kp_o + generator.standard_normal((2, 2)),
        "Kd_i": base.Kd_i + 1e-3 * generator.standard_normal((2, 2)),
        "Kff_o": np.eye(2) + 0.2 * generator.standard_normal((2, 2)),
        "Kaff_i": 0.01 * np.eye(2) + 2e-3 * generator.standard_normal((2, 2)),
    }
    return dataclasses.replace(base, filters=dataclasses.replace(base.filters, model_omega=request.param), **moved)


def free_of(gains, plant):
    return free_gains(gains, plant.body, full=control_law(gains.filters).coupled)


def test_the_responses_are_those_of_the_law(plant, gains):
    free = free_of(gains, plant)
    loop = LoopGradient(plant, free, free.vector(gains))
    response = PlantResponse(
        omega=plant.omega,
        G_i=plant.G_i,
        G_o=plant.G_o,
        root=np.zeros((len(plant.omega), 6, 6)),
        reach=plant.reach,
        coherence=np.ones((len(plant.omega), 2)),
        Ts=plant.Ts,
    )
    expected = cascade_loop(gains, response)
    for ours, theirs in (
        (loop.L_i, expected.L_i),
        (loop.L_u, expected.L_u),
        (loop.T, expected.T_o),
        (loop.U, expected.U_o),
    ):
        assert ours == pytest.approx(theirs, rel=1e-9, abs=1e-12)
    # An offset of the measured attitude passes the feedback alone, whatever the law adds for its setpoint.
    _, C_o, _ = cascade_response(gains, plant.omega)
    expected_return = plant.G_o @ np.linalg.solve(np.eye(2) + expected.L_u, C_o)
    assert loop.T_y == pytest.approx(expected_return, rel=1e-9, abs=1e-12)
    apart = np.abs(loop.T - loop.T_y).max()
    assert apart > 0.1 if gains.filters.model_omega or any(gains.filters.shaping) else apart == 0


def test_the_derivatives_are_those_of_finite_differences(plant, gains):
    free = free_of(gains, plant)
    vector = free.vector(gains)
    loop = LoopGradient(plant, free, vector)
    assert len(vector) == (28 if gains.filters.model_omega else 20 if control_law(gains.filters).coupled else 10)
    for place in range(len(vector)):
        step = STEP * np.eye(len(vector))[place]
        after, before = (LoopGradient(plant, free, vector + sign * step) for sign in (1, -1))
        for name, derivative in RESPONSES.items():
            expected = (getattr(after, name) - getattr(before, name)) / (2 * STEP)
            found = getattr(loop, derivative).whole()[place]
            assert found == pytest.approx(expected, rel=1e-4, abs=1e-6 * np.abs(getattr(loop, name)).max()), name


def test_the_noise_of_the_torque_is_the_integral_of_its_spectrum(plant, gains):
    """White noise of 0.01 rad/s on the rates alone, through a controller without feedback of the angles or plant."""
    silent = dataclasses.replace(
        plant,
        G_i=0 * plant.G_i,
        G_o=0 * plant.G_o,
        noise=np.diag([0.01, 0.01, 0, 0]) * np.ones((len(plant.omega), 1, 1)),
    )
    plain = dataclasses.replace(
        gains.for_our_law(), Kp_i=0.15 * np.eye(2), Ki_i=np.zeros((2, 2)), Kd_i=np.zeros((2, 2))
    )
    free = free_of(plain, plant)
    # The grid begins at 0.1 rad/s and ends just below the Nyquist frequency.
    assert LoopGradient(silent, free, free.vector(plain)).noise_rms() == pytest.approx(0.15 * 0.01, rel=1e-3)
