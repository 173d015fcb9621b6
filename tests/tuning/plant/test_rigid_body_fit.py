"""Rigid-body fit of measured responses beside known inertias."""

import numpy as np
import pytest

from mimopilot.sitl.physics.airframe import load_airframe
from mimopilot.tuning.errors import TuningError
from mimopilot.tuning.logs.reader import read_log
from mimopilot.tuning.plant.frequency_response import PlantResponse, measured_plant
from mimopilot.tuning.plant.rigid_body_fit import RigidBody, rigid_body
from tests.paths import DATA
from tests.tuning.truth import TS, experiment, linear_plant

AIRFRAMES = ("adam0", "adam0_boom", "adam0_flexible", "adam0_nominal", "adam0_perturbed", "antr", "px4_sih")


def inertia(airframe):
    """Torque scale times the inverse of the inertia, rad/s^2 for u = 1."""
    return airframe.plant().inertia_inverse[:2, :2] @ np.diag(airframe.moment_scale()[:2])


OMEGA = np.arange(1.3, 90.0, 1.3)


def exact(airframe, omega=OMEGA):
    """The noise-free response of an airframe."""
    G, K = linear_plant(airframe).frequency_response(omega), len(omega)
    nothing = np.zeros((K, 6, 6)), np.zeros((K, 2, 2))
    return PlantResponse(omega, G[:, :2], G[:, 2:], *nothing, np.ones((K, 2)), TS)


@pytest.mark.parametrize("name", AIRFRAMES)
def test_the_fit_finds_the_inertia_of_the_airframe(name):
    """ANT-R hovers at 14 % of its thrust: a larger torque than 5 % is no longer linear."""
    B = inertia(load_airframe(name).airframe)
    found = rigid_body(measured_plant(experiment(name, amplitude=0.05 if name == "antr" else 0.15)))
    assert pytest.approx(B, abs=0.03 * np.abs(B).max()) == found.B


def test_the_fit_of_a_px4_log_finds_the_inertia_of_its_simulator():
    found = rigid_body(measured_plant(read_log(DATA / "px4_sih_coupled.mat")))
    assert pytest.approx(np.array([[148.1, -39.3], [-39.3, 130.6]]), abs=0.04 * 148.1) == found.B


def test_a_wrong_sign_or_exchanged_axes_show_in_the_fit():
    plant = exact(load_airframe("adam0_boom").airframe)
    B = rigid_body(plant).B
    for turned, expected in (
        (np.diag([-1.0, 1.0]), B @ np.diag([-1.0, 1.0])),
        (np.array([[0.0, 1.0], [1.0, 0.0]]), B[:, ::-1]),
    ):
        changed = PlantResponse(**{**vars(plant), "G_i": plant.G_i @ turned})
        found = rigid_body(changed)
        assert pytest.approx(expected, rel=1e-9) == found.B
        assert found.determinant()[0] < 0


def test_the_deviation_is_that_of_repeated_noise():
    """Errors of 10 % at every frequency, much above the shape error; 40 repetitions."""
    plant = exact(load_airframe("adam0").airframe)
    size = np.linalg.norm(plant.G_i, axis=(1, 2))
    root = np.zeros((len(size), 6, 6))
    root[:, 2, 2] = root[:, 3, 3] = 0.2 * size
    noisy = PlantResponse(**{**vars(plant), "root": root, "reach": np.tile(np.eye(2), (len(size), 1, 1))})
    rng = np.random.default_rng(0)
    found = [rigid_body(noisy.draw(rng)) for _ in range(40)]
    claimed = np.mean([body.deviation for body in found], axis=0)
    # Nearly zero elements have no shape error: their spread is that of the noise alone.
    spread = np.std([body.B for body in found], axis=0)
    assert spread[[0, 1], [1, 0]] == pytest.approx(claimed[[0, 1], [1, 0]], rel=0.4)
    determinants = np.array([body.determinant() for body in found])
    B, deviation = found[0].B, found[0].deviation
    rng = np.random.default_rng(1)
    drawn = np.linalg.det(B + deviation * rng.standard_normal((4000, 2, 2)))
    assert determinants[0, 0] == pytest.approx(np.linalg.det(B))
    assert determinants[0, 1] == pytest.approx(np.std(drawn), rel=0.05)


def test_the_smallest_action_is_the_minimum_over_directions():
    body = RigidBody(np.array([[10.0, 4.0], [0.0, 5.0]]), np.ones((2, 2)))
    Ki = np.array([[1.0, -0.5], [0.8, 0.6]])
    turns = np.linspace(0, np.pi, 20001)
    direction = np.stack([np.cos(turns), np.sin(turns)])
    expected = np.min(np.sum(direction * (body.B @ Ki @ direction), axis=0))
    assert body.least(Ki) == pytest.approx(expected, rel=1e-6)
    assert body.least(np.stack([Ki, -Ki])) == pytest.approx(
        [expected, -np.max(np.sum(direction * (body.B @ Ki @ direction), axis=0))], rel=1e-6
    )


def test_a_response_that_is_known_nowhere_is_refused():
    plant = exact(load_airframe("adam0").airframe)
    unknown = PlantResponse(**{**vars(plant), "root": plant.root + 1e9 * np.eye(6), "reach": plant.reach + np.eye(2)})
    with pytest.raises(TuningError, match=r"not excited: .* known at 0 frequencies up to 60 rad/s, expected 4 or more"):
        rigid_body(unknown)
