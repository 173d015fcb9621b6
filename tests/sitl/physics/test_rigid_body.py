"""The plant against closed forms and conservation laws."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.special import ellipj

from mimopilot.sitl.errors import SitlError
from mimopilot.sitl.physics.airframe import PointMass, combine_masses, load_airframe
from mimopilot.sitl.physics.rigid_body import GRAVITY, PlantParameters, advance, hover_state, integrate_moments


def rotate(q, v):
    """Body vectors in earth axes, by quaternions (N, 4), w first."""
    w, r = q[:, :1], q[:, 1:]
    return v + 2 * w * np.cross(r, v) + 2 * np.cross(r, np.cross(r, v))


def random_tensor(rng):
    """Inertia of ten random points: always that of a real body."""
    points, masses = rng.standard_normal((10, 3)) * 0.1, rng.uniform(0.05, 0.3, 10)
    points -= masses @ points / masses.sum()
    return sum(m * (r @ r * np.eye(3) - np.outer(r, r)) for m, r in zip(masses, points, strict=True))


def test_a_torque_free_asymmetric_top_follows_the_elliptic_functions():
    # Landau and Lifshitz, Mechanics, section 37: I1 < I2 < I3, M^2 > 2 E I2.
    J = np.array([0.0147, 0.0172, 0.0295])
    omega0 = np.array([0.6, 0.0, 1.5])
    E2 = float(J @ omega0**2)
    M2 = float((J * omega0) @ (J * omega0))
    assert E2 * J[1] < M2
    speed = np.sqrt((J[2] - J[1]) * (M2 - E2 * J[0]) / J.prod())
    k2 = (J[1] - J[0]) * (E2 * J[2] - M2) / ((J[2] - J[1]) * (M2 - E2 * J[0]))
    dt, n = 1e-3, 5000
    rates, _ = integrate_moments(np.diag(J), np.zeros((n, 3)), dt, omega0)
    sn, cn, dn, _ = ellipj(speed * dt * np.arange(n + 1), k2)
    exact = np.column_stack(
        [
            np.sqrt((E2 * J[2] - M2) / (J[0] * (J[2] - J[0]))) * cn,
            np.sqrt((E2 * J[2] - M2) / (J[1] * (J[2] - J[1]))) * sn,
            np.sqrt((M2 - E2 * J[0]) / (J[2] * (J[2] - J[0]))) * dn,
        ]
    )
    # The sign of the rotation about axis 2 is that of Euler's equations.
    assert rates == pytest.approx(exact, abs=1e-9)


def test_a_symmetric_top_precesses_at_its_closed_form_rate():
    I1, I3, p0, r0 = 0.01, 0.018, 0.8, 3.0
    rates, _ = integrate_moments(np.diag([I1, I1, I3]), np.zeros((4000, 3)), 1e-3, (p0, 0.0, r0))
    angle = (I3 - I1) / I1 * r0 * 1e-3 * np.arange(4001)
    assert rates[:, 0] == pytest.approx(p0 * np.cos(angle), abs=1e-10)
    assert rates[:, 1] == pytest.approx(p0 * np.sin(angle), abs=1e-10)
    assert rates[:, 2] == pytest.approx(r0, abs=1e-12)


@given(seed=st.integers(0, 10_000))
@settings(max_examples=25, deadline=None)
def test_energy_and_angular_momentum_are_conserved_for_any_tensor(seed):
    rng = np.random.default_rng(seed)
    J = random_tensor(rng)
    omega0 = rng.standard_normal(3)
    rates, q = integrate_moments(J, np.zeros((1000, 3)), 1e-3, omega0, substeps=4, quaternion0=rng.standard_normal(4))
    energy = np.einsum("ni,ij,nj->n", rates, J, rates)
    momentum = rotate(q, rates @ J)
    assert energy == pytest.approx(energy[0], rel=1e-12)
    assert np.abs(momentum - momentum[0]).max() < 1e-12 * np.linalg.norm(momentum[0])
    assert np.linalg.norm(q, axis=1) == pytest.approx(1.0, abs=1e-14)


@pytest.mark.parametrize("xy", [+0.0016, -0.0016, +0.005])
def test_products_of_inertia_couple_roll_into_pitch_with_the_sign_of_the_inverse(xy):
    J = np.array([[0.0172, xy, 0.0], [xy, 0.0147, 0.0], [0.0, 0.0, 0.0295]])
    moments = np.tile([0.01, 0.0, 0.0], (10, 1))
    rates, _ = integrate_moments(J, moments, 1e-3, (0.0, 0.0, 0.0))
    # From rest the gyroscopic terms are of second order: the rates grow by J^-1 M t.
    expected = np.linalg.inv(J) @ [0.01, 0, 0] * 0.01
    assert rates[-1] == pytest.approx(expected, rel=1e-4, abs=1e-7)
    assert np.sign(rates[-1, 1]) == -np.sign(xy)


def test_a_constant_moment_on_a_principal_axis_gives_a_parabola():
    rates, q = integrate_moments(np.diag([0.01, 0.02, 0.025]), np.tile([0.004, 0, 0], (1000, 1)), 1e-3, (0, 0, 0))
    assert rates[-1, 0] == pytest.approx(0.4, rel=1e-12)
    assert 2 * np.arctan2(q[-1, 1], q[-1, 0]) == pytest.approx(0.2, rel=1e-9)


def test_the_attitude_is_body_to_earth_with_w_first():
    _, q = integrate_moments(np.eye(3), np.zeros((1000, 3)), 1e-3, (0, 0, np.pi / 2))
    assert q[-1] == pytest.approx([np.sqrt(0.5), 0, 0, np.sqrt(0.5)], abs=1e-9)
    assert rotate(q[-1:], np.array([[1.0, 0, 0]]))[0] == pytest.approx([0, 1, 0], abs=1e-9)


def test_substeps_converge_at_fourth_order():
    J = np.array([[0.0172, 0.0016, 0.0], [0.0016, 0.0147, 0.0], [0.0, 0.0, 0.0295]])
    results = [integrate_moments(J, np.zeros((20, 3)), 0.05, (3, 2, 1), substeps=s)[0][-1] for s in (1, 2, 4, 64)]
    errors = [np.abs(r - results[-1]).max() for r in results[:3]]
    assert 10 < errors[0] / errors[1] < 24
    assert 10 < errors[1] / errors[2] < 24


@pytest.mark.parametrize(
    ("J", "message"),
    [
        ([[1, 0.1, 0], [0.2, 1, 0], [0, 0, 1]], "symmetric"),
        ([[-1, 0, 0], [0, 1, 0], [0, 0, 1]], "no real body"),
        ([[1, 0, 0], [0, 1, 0], [0, 0, 3]], "no real body"),
        ([[np.nan, 0, 0], [0, 1, 0], [0, 0, 1]], "symmetric"),
    ],
)
def test_a_tensor_of_no_real_body_is_refused(J, message):
    with pytest.raises(SitlError, match=message):
        integrate_moments(J, np.zeros((1, 3)), 1e-3, (0, 0, 0))


def test_160_g_at_motor_3_moves_the_centre_and_adds_to_three_entries_of_the_tensor():
    inertia = np.diag([0.0172, 0.0147, 0.0295])
    mass, centre, total = combine_masses(1.45, inertia, (PointMass(mass=0.16, position=(0.1414, -0.1414, 0.0)),))
    assert mass == pytest.approx(1.61)
    assert np.linalg.norm(centre) == pytest.approx(0.020, abs=2e-4)
    # Reduced mass times the squared distances.
    reduced = 1.45 * 0.16 / 1.61
    assert (total - inertia)[0, 0] == pytest.approx(reduced * 0.1414**2, rel=1e-12)
    assert (total - inertia)[1, 1] == pytest.approx(0.0029, abs=5e-5)
    # Front left: x > 0, y < 0, so the tensor's element xy = -sum m x y is positive.
    assert (total - inertia)[0, 1] == pytest.approx(+reduced * 0.1414**2, rel=1e-12)
    assert (total - inertia)[2, 2] == pytest.approx(2 * reduced * 0.1414**2, rel=1e-12)


def test_added_masses_combine_linearly_and_in_any_order():
    rng = np.random.default_rng(4)
    parts = [
        PointMass(mass=float(m), position=tuple(map(float, r)))
        for m, r in zip(rng.uniform(0.1, 1, 5), rng.standard_normal((5, 3)), strict=True)
    ]
    mass, centre, total = combine_masses(2.0, random_tensor(rng), tuple(parts))
    at_once = combine_masses(2.0, np.zeros((3, 3)), tuple(parts))[2]
    # Linearity in the body's own inertia, and independence of the order of the parts.
    again = combine_masses(2.0, np.zeros((3, 3)), tuple(reversed(parts)))
    assert at_once == pytest.approx(again[2], rel=1e-12)
    assert mass == pytest.approx(2.0 + sum(p.mass for p in parts))
    assert centre == pytest.approx(sum(p.mass * np.array(p.position) for p in parts) / mass)
    assert np.linalg.eigvalsh(total)[0] > 0


def fly_open_loop(plant: PlantParameters, commands, seconds, step=1e-3):
    state = hover_state(plant, altitude=100.0)
    steps = round(seconds / step)
    advance(state, np.asarray(commands, np.float32), plant, steps, step)
    return state


def test_hover_commands_keep_the_vehicle_at_rest():
    plant = load_airframe("adam0").airframe.plant()
    share = plant.mass * GRAVITY / 4 / plant.thrust_max
    state = fly_open_loop(plant, [share] * 4, 2.0)
    # The command is single precision: 3e-8 of the thrust.
    assert state[:3] == pytest.approx([0, 0, -100], abs=1e-5)
    assert state[10:13] == pytest.approx(0, abs=1e-9)


def test_without_thrust_the_vehicle_falls_to_its_terminal_velocity():
    plant = load_airframe("adam0").airframe.plant()._replace(motor_time_constant=1e-2)
    state = fly_open_loop(plant, [0] * 4, 3.0)
    tau = plant.mass / plant.drag
    # The rotors stop within a few hundredths of a second.
    assert state[5] == pytest.approx(GRAVITY * tau * (1 - np.exp(-3.0 / tau)), abs=0.15)
    assert fly_open_loop(plant, [0] * 4, 60.0)[5] == pytest.approx(GRAVITY * tau, rel=1e-4)


def test_the_motors_lag_is_first_order_in_rotor_speed():
    plant = load_airframe("adam0").airframe.plant()
    before = hover_state(plant)[13]
    state = fly_open_loop(plant, [1.0] * 4, 0.05)
    target = np.sqrt(plant.thrust_max / plant.thrust_coefficient)
    assert state[13:] == pytest.approx(target + (before - target) * np.exp(-1.0), rel=1e-6)


@pytest.mark.parametrize(
    ("motors", "axis", "sign"),
    [((1, 2), 0, 1), ((0, 3), 0, -1), ((0, 2), 1, 1), ((1, 3), 1, -1), ((0, 1), 2, 1), ((2, 3), 2, -1)],
)
def test_each_pair_of_motors_gives_a_torque_of_the_right_sign(motors, axis, sign):
    # 1 front right, 2 rear left, 3 front left, 4 rear right; x forward, y right, z down.
    plant = load_airframe("adam0_nominal").airframe.plant()
    share = plant.mass * GRAVITY / 4 / plant.thrust_max
    commands = np.full(4, share)
    commands[list(motors)] += 0.05
    rates = fly_open_loop(plant, commands, 0.05)[10:13]
    assert np.sign(rates[axis]) == sign
    assert np.abs(np.delete(rates, axis)).max() < 1e-6


def test_runge_kutta_at_1_khz_agrees_with_a_finer_one():
    plant = load_airframe("adam0").airframe.plant()
    commands = [0.5, 0.45, 0.55, 0.5]
    coarse, fine = (fly_open_loop(plant, commands, 0.5, step) for step in (1e-3, 1e-4))
    assert coarse == pytest.approx(fine, abs=1e-6)


def test_the_wind_carries_the_vehicle():
    plant = load_airframe("adam0").airframe.plant()._replace(wind=np.array([3.0, -2.0, 0.0]))
    share = plant.mass * GRAVITY / 4 / plant.thrust_max
    state = fly_open_loop(plant, [share] * 4, 60.0)
    assert state[3:5] == pytest.approx([3.0, -2.0], abs=1e-4)
