"""Ground contact: standing, landing, sliding, tipping over."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mimopilot.sitl.physics.airframe import known_airframes, load_airframe
from mimopilot.sitl.physics.ground_contact import FRICTION, apply_ground_contact, ground_state
from mimopilot.sitl.physics.rigid_body import GRAVITY, advance, hover_state
from mimopilot.sitl.physics.state_estimate import euler_angles

TS, STEPS = 0.004, 4
PLANT = load_airframe("adam0").airframe.plant()
STILL = 1e-7  # m, m/s, rad/s
HOVER = PLANT.mass * GRAVITY / (4 * PLANT.thrust_max)


def fly(state, commands, seconds, plant=PLANT):
    """Fly with ground contact; returns the states and the touchdown speeds."""
    states, speeds = [state.copy()], []
    for _ in range(round(seconds / TS)):
        advance(state, np.asarray(commands, np.float32), plant, STEPS, TS / STEPS)
        speeds.append(apply_ground_contact(state, plant, TS))
        states.append(state.copy())
    return np.array(states), np.array(speeds)


def angles(state):
    return np.degrees(euler_angles(*state[6:10]))


def kinetic_energy(state):
    J = PLANT.inertia
    return 0.5 * PLANT.mass * state[3:6] @ state[3:6] + 0.5 * state[10:13] @ J @ state[10:13]


@pytest.mark.parametrize(("name", "share"), [("adam0", 0.98), *((name, 0.5) for name in known_airframes())])
def test_the_vehicle_stands_still_until_its_rotors_carry_it(name, share):
    plant = load_airframe(name).airframe.plant()
    hover = plant.mass * GRAVITY / (len(plant.rotors) * plant.thrust_max)
    states, _ = fly(ground_state(plant), [share * hover] * len(plant.rotors), 10.0, plant)
    assert np.abs(states[:, 2:6]).max() < STILL
    assert np.abs(states[:, 7:9]).max() < STILL
    # rad/s; the small, coupled inertia of ANT-R's fit trembles at 1e-6 on its legs.
    assert np.abs(states[:, 10:13]).max() < (1e-5 if name == "antr_thesis" else STILL)
    assert np.abs(states[:, [0, 1, 9]]).max() < 1e-5  # m, and twice that in rad: no force returns it


def test_more_thrust_than_weight_takes_off():
    states, speeds = fly(ground_state(PLANT), [1.1 * HOVER] * 4, 2.0)
    assert states[-1, 2] < -1.0
    assert np.abs(states[-1, :2]).max() < STILL
    assert speeds[-1] == -1.0


def test_uneven_thrust_below_the_weight_moves_nothing():
    states, _ = fly(ground_state(PLANT), HOVER * np.array([0.9, 0.9, 0.5, 0.5]), 5.0)  # yaw torque to the right
    assert np.abs(np.array([angles(s) for s in states[::50]])).max() < 0.01
    assert np.abs(states[:, :3]).max() < 1e-4


def test_in_the_air_ground_contact_changes_nothing():
    state = hover_state(PLANT, 1.0)
    state[3:6], state[10:13] = (0.5, -0.3, 1.0), (1.0, 2.0, 3.0)
    before = state.copy()
    assert apply_ground_contact(state, PLANT, TS) == -1.0
    assert state.tobytes() == before.tobytes()


def test_a_fall_from_a_metre_ends_at_rest_and_reports_its_speed():
    state = hover_state(PLANT, 1.0)
    state[13:] = 0.0
    states, speeds = fly(state, [0.0] * 4, 2.0)
    expected = np.sqrt(2 * GRAVITY * 1.0)  # less the effect of drag
    assert 0.85 * expected < speeds.max() < expected + GRAVITY * TS
    assert np.abs(states[-1, 2:6]).max() < STILL
    assert np.abs(states[-1, 10:13]).max() < STILL


def test_a_tilted_landing_ends_level():
    state = hover_state(PLANT, 0.1)
    roll = np.radians(12.0)
    state[6:8] = np.cos(roll / 2), np.sin(roll / 2)
    state[5] = 0.5
    states, speeds = fly(state, [0.8 * HOVER] * 4, 3.0)
    assert np.abs(angles(states[-1])[:2]).max() < 0.01
    assert abs(states[-1, 2]) < 1e-4
    assert 0.5 < speeds.max() < 2.0


def test_a_sliding_vehicle_is_stopped_by_friction():
    state = ground_state(PLANT)
    state[3] = 0.5
    states, _ = fly(state, [0.0] * 4, 1.0)
    assert np.abs(states[-1, 3:6]).max() < STILL
    assert states[-1, 0] == pytest.approx(0.5**2 / (2 * FRICTION * GRAVITY), rel=0.2)


def test_thrust_on_one_side_only_tips_the_vehicle_over():
    states, _ = fly(ground_state(PLANT), [0.0, 0.9, 0.9, 0.0], 2.0)  # the left pair
    assert max(angles(s)[0] for s in states) > 60.0
    assert np.isfinite(states).all()


@settings(max_examples=200)
@given(st.integers(0, 2**32 - 1))
def test_ground_contact_never_adds_energy_and_no_foot_ends_below_the_ground(seed):
    random = np.random.default_rng(seed)
    state = hover_state(PLANT, 0.0)
    q = random.standard_normal(4) * [1, 0.3, 0.3, 1]
    state[6:10] = q / np.linalg.norm(q)
    state[2] = random.uniform(-0.3, 0.1)
    state[3:6], state[10:13] = random.standard_normal(3) * 2, random.standard_normal(3) * 3
    before = state.copy()
    speed = apply_ground_contact(state, PLANT, TS)
    assert np.isfinite(state).all()
    if speed < 0:
        assert state.tobytes() == before.tobytes()
        return
    assert kinetic_energy(state) <= kinetic_energy(before) * (1 + 1e-12) + 1e-12
    w, x, y, z = state[6:10]
    down = np.array([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)])
    feet = state[2] + PLANT.rotors[:, :2] @ down[:2]
    assert feet.max() < 1e-12
