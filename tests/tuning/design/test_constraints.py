"""The constraints of the design: their margins, and the convex approximations of the next step."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mimopilot.sitl.physics.airframe import load_airframe
from mimopilot.tuning.design.conic_problem import ConicProblem
from mimopilot.tuning.design.constraints import Cut, Definite, Distance, MotorLimit, NoiseLimit, ParameterRange
from mimopilot.tuning.design.disturbance_limit import NEARLY_KEPT, ROOM, DisturbanceLimit, after_step, no_softer_than
from mimopilot.tuning.design.free_gains import free_gains
from mimopilot.tuning.design.loop_gradient import LoopGradient
from mimopilot.tuning.design.rate_loop_gain import gain_above_band, structural_modes
from mimopilot.tuning.plant.plant_estimates import PlantEstimates
from mimopilot.tuning.plant.wide_response import wide_response
from mimopilot.tuning.small_matrices import singular_values
from tests.tuning.analysis.test_certify import experiment


@pytest.fixture(scope="module")
def plant():
    return wide_response(PlantEstimates(experiment("adam0")))


@pytest.fixture(scope="module")
def free(plant):
    return free_gains(load_airframe("adam0").default_gains(), plant.body, "PID")


class Recorded(ConicProblem):
    """Keeps the constraints that are added, and evaluates them for a step."""

    def least(self, step):
        """Least value of all linear constraints, and of a cone's first entry minus the norm of the others."""
        linear = [value + slope @ step for slope, value in self._linear]
        cones = []
        for slope, value in self._cones:
            v = value + slope @ step
            cones.append(v[:, 0] - np.linalg.norm(v[:, 1:], axis=1))
        return min((part.min() for part in (*linear, *cones) if part.size), default=np.inf)


def constraints(plant):
    return {
        "torque": Distance(Cut.TORQUE, slice(0, plant.band.stop), 1 / 1.6),
        "rate": Distance(Cut.RATE_LOOP, slice(0, plant.band.stop), 1 / 1.6),
        "attitude": Distance(Cut.ATTITUDE, slice(0, plant.band.stop), 1 / 1.6),
        "noise": NoiseLimit(np.array([0.008, 0.008])),
        "disturbance": DisturbanceLimit(np.full((len(plant.omega), 2), 1e-3), np.array([0.02, 0.02])),
        "above": gain_above_band(plant),
        "integral": Definite("Ki_i", plant.body.B, 1.0),
        "derivative": Definite("Kd_i", np.eye(2), 0.0),
        "parameter": ParameterRange("Kp_i", np.array([0.2, 0.3])),
        "motors": MotorLimit(
            np.full((2, len(plant.omega)), 1e-3 + 0j), np.array([[0.5, 0.5], [-0.5, 0.5]]), np.full((2, 2), 0.4)
        ),
    }


@pytest.mark.parametrize(
    "name",
    ["torque", "rate", "attitude", "noise", "disturbance", "above", "integral", "derivative", "parameter", "motors"],
)
def test_the_constraint_of_the_next_step_has_the_sign_of_the_margin(plant, free, name):
    """At a step of zero, for gains that keep the limit and for gains that do not."""
    constraint, flown = constraints(plant)[name], free.vector(free.base)
    signs = set()
    for factor in (-1.0, 0.2, 1.0, 3.0):
        loop = LoopGradient(plant, free, factor * flown)
        margin, problem = constraint.margin(loop), Recorded(len(flown))
        constraint.add(problem, loop)
        if abs(margin) > 1e-3 and np.isfinite(problem.least(0 * flown)):
            assert np.sign(problem.least(0 * flown)) == np.sign(margin)
            signs.add(np.sign(margin))
    assert signs


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 10_000), size=st.floats(0.01, 1.0))
def test_a_step_that_keeps_the_convex_constraint_keeps_the_distance(plant, free, seed, size):
    """P^H P >= P^H P_c + P_c^H P - P_c^H P_c: true for any step of the rate gains, in which L is linear."""
    generator = np.random.default_rng(seed)
    vector = free.vector(free.base)
    step = size * generator.standard_normal(len(vector))
    step[:4] = 0.0  # the attitude gain multiplies the rate gains: L is not linear in both
    constraint = Distance(Cut.TORQUE, plant.band, 1 / 2.0)
    exact = dataclasses.replace(plant, error_i=0 * plant.error_i, error_o=0 * plant.error_o)
    loop, moved = (LoopGradient(exact, free, v) for v in (vector, vector + step))
    problem = Recorded(len(vector))
    constraint.add(problem, loop)
    near = singular_values(np.eye(2) + loop.L_u[plant.band])[1] < 0.5 + 0.2
    if problem.least(step) >= 0:
        assert singular_values(np.eye(2) + moved.L_u[plant.band])[1][near].min() >= 0.5 - 1e-9


def test_the_disturbance_of_the_next_step_is_that_of_moved_gains(plant, free):
    constraint, vector = constraints(plant)["disturbance"], free.vector(free.base)
    problem = Recorded(len(vector))
    constraint.add(problem, LoopGradient(plant, free, vector))
    step = 1e-3 * np.random.default_rng(1).standard_normal(len(vector))
    moved = constraint.margin(LoopGradient(plant, free, vector + step))
    now = constraint.margin(LoopGradient(plant, free, vector))
    assert moved - now == pytest.approx(problem.least(step) - problem.least(0 * step), rel=0.01)
    assert problem.least(0 * step) == pytest.approx(now, abs=1e-9)


def test_flown_gains_that_nearly_keep_the_constraints_limit_a_design(plant, free):
    loop, step = LoopGradient(plant, free, free.vector(free.base)), np.full((len(plant.omega), 2), 1e-3)
    noise = loop.noise_rms().max()
    nearly, not_at_all = (NoiseLimit(np.full(2, noise / (1 - share * NEARLY_KEPT))) for share in (0.9, 1.1))
    (limit,) = no_softer_than(loop, step, [constraints(plant)["derivative"], nearly])
    assert limit.limit == pytest.approx(ROOM * after_step(loop, step))
    assert limit.margin(loop) == pytest.approx(1 - 1 / ROOM)
    assert no_softer_than(loop, step, [nearly, not_at_all]) == []


def test_margins_are_relative_distances_to_the_limits(plant, free):
    vector, limits = free.vector(free.base), constraints(plant)
    loop = LoopGradient(plant, free, vector)
    assert limits["noise"].margin(loop) == pytest.approx(1 - loop.noise_rms().max() / 0.008)
    ratio = limits["integral"].margin(loop) * np.abs(plant.body.B).max() * free.units["Ki_i"] + 1.0
    product = plant.body.B @ free.base.Ki_i
    assert limits["parameter"].margin(loop) == pytest.approx(1 - free.base.Kp_i[0, 0] / 0.2)
    assert ratio == pytest.approx(np.linalg.eigvalsh((product + product.T) / 2)[0])
    sensitivity = np.linalg.norm(np.linalg.inv(np.eye(2) + loop.L_u[: plant.band.stop]), ord=2, axis=(1, 2))
    error = loop.loop_error(whole=True)[: plant.band.stop]
    assert limits["torque"].margin(loop) == pytest.approx(np.min(1 / sensitivity - error) * 1.6 - 1)


def test_only_frequencies_where_the_vehicle_responds_more_than_a_rigid_body_are_a_mode(plant):
    assert not len(structural_modes(plant).omega)
    response = plant.response
    at = np.argmin(np.abs(response.omega - 120.0))
    G_i = response.G_i.copy()
    G_i[at - 1 : at + 2] *= 4
    bent = dataclasses.replace(plant, response=dataclasses.replace(response, G_i=G_i))
    found = structural_modes(bent)
    assert 90 < found.omega[0] < 120 < found.omega[-1] < 150
