"""The attitude controller of the compiled C++ against the published law, written again in double precision.

The law is that of D. Brescianini, M. Hehn and R. D'Andrea, "Nonlinear Quadrocopter Attitude Control", ETH Zurich, 2013:
first the tilt, by the shortest rotation of body z, then the turn about it, which PX4 gives a weight.
"""

import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from mimopilot.codegen.native import NativeController, load_native
from mimopilot.tuning.gains import Limits
from tests.codegen.input_rows import as_wxyz, input_rows, rotation_of, tilted
from tests.conftest import coupled_gains, following_gains

TS = 0.004
DOWN = np.array([0.0, 0.0, 1.0])
#: Cosine of half the tilt below which the error has no turn, as in PX4.
INVERTED = 0.0045


@pytest.fixture(scope="module")
def library():
    return load_native(coupled_gains())


def unit_gains(weight):
    """Rate setpoints are errors: e of roll and pitch, and that of yaw over its weight."""
    gains = coupled_gains()
    limits = Limits((50, 50, 50), (1, 1, 1), (0.3, 0.3, 0.3))
    yaw = dataclasses.replace(gains.yaw, Kp_o=1.0)
    filters = dataclasses.replace(gains.filters, yaw_weight=weight)
    return dataclasses.replace(gains, Kp_o=np.eye(2), yaw=yaw, limits=limits, filters=filters)


def flown(library, gains, attitude, setpoint, **values):
    """Rate setpoints (N, 3) of the compiled controller for rows of attitudes and setpoints."""
    inputs = input_rows(len(setpoint), attitude=attitude, attitude_setpoint=setpoint, **values)
    outputs = NativeController(library, gains).run(inputs)
    assert not outputs["fault"].any()
    return outputs["rates_setpoint"].astype(float)


def flown_errors(library, weight, attitude, setpoint):
    """Attitude errors (N, 3) of the compiled controller: 2 imag of a quaternion whose turn is weighted."""
    return flown(library, unit_gains(weight), attitude, setpoint) * [1.0, 1.0, weight]


def published_errors(attitude, setpoint, weight):
    """The same of the published law."""
    now, wanted = rotation_of(attitude), rotation_of(setpoint)
    z, z_wanted = now.apply(DOWN), wanted.apply(DOWN)
    across = np.cross(z, z_wanted)
    sine = np.linalg.norm(across, axis=-1, keepdims=True)
    tilt = np.arctan2(sine, np.sum(z * z_wanted, axis=-1, keepdims=True))
    shortest = Rotation.from_rotvec(across * np.divide(tilt, sine, out=np.ones_like(tilt), where=sine > 0))
    reduced = shortest * now
    mix = as_wxyz(reduced.inv() * wanted)
    turn = np.zeros((len(z), 3))
    turn[:, 2] = 2 * weight * np.copysign(np.arccos(np.minimum(mix[:, 0], 1)), np.arcsin(np.clip(mix[:, 3], -1, 1)))
    return 2 * as_wxyz(now.inv() * (reduced * Rotation.from_rotvec(turn)))[:, 1:]


def random_pairs(count, seed, turn=np.pi):
    """Attitudes and setpoints (count, 4) with any tilt between them and any turn up to `turn`, in single precision."""
    rng = np.random.default_rng(seed)
    now = Rotation.random(count, random_state=seed)
    direction, angle = rng.uniform(0, 2 * np.pi, count), np.arccos(rng.uniform(-0.999, 1, count))
    tilt = Rotation.from_rotvec(angle[:, None] * np.stack([np.cos(direction), np.sin(direction), 0 * angle], axis=1))
    turned = Rotation.from_rotvec(rng.uniform(-turn, turn, (count, 1)) * DOWN)
    pair = (now, now * tilt * turned)
    return [np.float32(as_wxyz(q) * rng.choice([-1, 1], (count, 1))) for q in pair]


def test_with_weight_one_the_error_is_the_published_one(library):
    attitude, setpoint = random_pairs(10_000, 1)
    found = flown_errors(library, 1.0, attitude, setpoint)
    np.testing.assert_allclose(found, published_errors(attitude, setpoint, 1.0), atol=1e-5)
    whole = 2 * as_wxyz(rotation_of(attitude).inv() * rotation_of(setpoint))[:, 1:]
    np.testing.assert_allclose(found, whole, atol=1e-5)


@pytest.mark.parametrize("weight", [0.05, 0.4, 0.8])
def test_without_a_turn_the_error_is_the_published_one_whatever_the_weight(library, weight):
    attitude, setpoint = random_pairs(10_000, 2, turn=0.0)
    found = flown_errors(library, weight, attitude, setpoint)
    np.testing.assert_allclose(found, published_errors(attitude, setpoint, weight), atol=1e-5)
    np.testing.assert_allclose(found[:, 2], 0, atol=1e-5)


def weighted_turn(errors):
    """Turn about z in errors, rad: quaternions that are a tilt, then that turn."""
    half = errors / 2
    return 2 * np.arctan2(half[:, 2], np.sqrt(np.maximum(1 - np.sum(half**2, axis=1), 0)))


@pytest.mark.parametrize(
    ("weight", "up_to", "turn", "error"),
    [(0.4, 45, 0.06, 1.1e-3), (0.4, 90, 0.49, 8.5e-3), (0.4, 180, 4.7, 0.082), (0.75, 180, 8.2, 0.144)],
)
def test_a_weighted_turn_is_interpolated_and_differs_little_from_the_published_angle(
    library, weight, up_to, turn, error
):
    """The core interpolates between no turn and the whole one, and normalises. Degrees; 0.75 is the worst weight."""
    attitude, setpoint = random_pairs(10_000, 3, turn=np.radians(up_to))
    found = flown_errors(library, weight, attitude, setpoint)
    published = published_errors(attitude, setpoint, weight)
    difference = np.degrees(np.abs(weighted_turn(found) - weighted_turn(published)))
    assert 0.8 * turn < difference.max() < turn
    assert 0.8 * error < np.linalg.norm(found - published, axis=1).max() < error
    # The tilt is not affected: its part of the error has the same size, and its axis turns with half of the turn.
    sizes = [np.linalg.norm(e[:, :2], axis=1) for e in (found, published)]
    np.testing.assert_allclose(*sizes, atol=1e-5)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_one_axis_is_the_angle_within_one_percent_up_to_25_degrees(library, axis):
    gains = dataclasses.replace(coupled_gains(), Kp_o=np.diag([6.0, 5.5]))
    gains = dataclasses.replace(gains, filters=dataclasses.replace(gains.filters, yaw_weight=1.0))
    angle = np.radians(np.linspace(-25, 25, 101))[:, None] * np.eye(3)[axis]
    found = flown(library, gains, (1.0, 0.0, 0.0, 0.0), angle)
    linear = angle * [6.0, 5.5, 1.5]
    np.testing.assert_allclose(found, 2 * np.sin(angle / 2) * [6.0, 5.5, 1.5], rtol=1e-6, atol=1e-9)
    shares = 1 - np.delete(found[:, axis] / np.where(linear[:, axis] == 0, 1, linear[:, axis]), 50)
    assert 0.0078 < shares.max() < 0.008
    assert shares.min() > -1e-6


def test_full_gains_and_the_yaw_rate_make_the_rate_setpoint(library):
    gains = coupled_gains()
    wide = dataclasses.replace(gains, limits=dataclasses.replace(gains.limits, rate_max=(50.0, 50.0, 50.0)))
    gains = dataclasses.replace(wide, filters=dataclasses.replace(wide.filters, yaw_weight=1.0))
    attitude, setpoint = random_pairs(2000, 4)
    yaw_rate = np.random.default_rng(5).uniform(-3, 3, 2000).astype(np.float32)
    error = published_errors(attitude, setpoint, 1.0)
    gain = np.zeros((3, 3))
    gain[:2, :2], gain[2, 2] = gains.Kp_o, gains.yaw.Kp_o
    turning = rotation_of(attitude).inv().apply(DOWN) * yaw_rate[:, None]
    found = flown(library, gains, attitude, setpoint, yaw_rate_setpoint=yaw_rate)
    np.testing.assert_allclose(found, error @ gain.T + turning, atol=5e-5)


@pytest.mark.parametrize("bank", [20, 35, 45])
@pytest.mark.parametrize("side", [-1, 1])
def test_in_a_perfect_coordinated_turn_the_rate_setpoint_is_that_of_the_turn(library, bank, side):
    """At 10 m/s: w = g tan(bank) / v. The rates are 0, w sin(bank), w cos(bank), on any heading."""
    phi = side * np.radians(bank)
    w = 9.81 * np.tan(phi) / 10.0
    angles = np.zeros((2000, 3))
    angles[:, 0], angles[:, 2] = phi, w * TS * np.arange(2000)
    assert np.abs(angles[-1, 2]) > 2.5
    found = flown(library, coupled_gains(), angles, angles, yaw_rate_setpoint=w)
    np.testing.assert_allclose(found, np.tile([0, w * np.sin(phi), w * np.cos(phi)], (2000, 1)), atol=5e-6)
    none = flown(library, coupled_gains(), angles, angles, yaw_rate_setpoint=np.nan)
    np.testing.assert_allclose(none, 0, atol=5e-6)


def near_half_turns(count, seed, spread):
    """Setpoints (count, 4), float32, half a turn from level but for up to `spread` of the scalar part."""
    rng = np.random.default_rng(seed)
    q = np.hstack([spread * rng.uniform(-1, 1, (count, 1)), rng.normal(size=(count, 3))])
    upside_down = rng.random(count) < 0.5
    q[upside_down, 3] *= 10.0 ** rng.uniform(-12, -1, upside_down.sum())
    q[:, 1:] *= (np.sqrt(1 - q[:, 0] ** 2) / np.linalg.norm(q[:, 1:], axis=1))[:, None]
    return np.float32(q)


@pytest.mark.parametrize("weight", [0.01, 0.4, 1.0])
@pytest.mark.parametrize("spread", [0.0, 1e-30, 1e-6, 1e-3, 0.02])
def test_half_turns_give_a_finite_error_of_almost_full_size(library, weight, spread):
    exact = np.float32([[0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1], [0, 0.6, 0.8, 0], [0, 0, 0.6, 0.8], [-0.0, 1, 0, 0]])
    setpoint = np.vstack([near_half_turns(5000, 6, spread), exact, -exact])
    error = flown_errors(library, weight, (1.0, 0.0, 0.0, 0.0), setpoint)
    assert np.isfinite(error).all()
    assert np.linalg.norm(error, axis=1).max() < 2 * (1 + 1e-6)
    # The tilt's part is as large as the tilt, whatever the turn.
    tilt = 2 * np.hypot(*setpoint[:, 1:3].T.astype(float))
    np.testing.assert_allclose(np.hypot(*error[:, :2].T), tilt, atol=2e-5)


def test_on_either_side_of_half_a_turn_the_shorter_way_is_taken(library):
    axes = np.eye(3).repeat(200, axis=0)
    short = np.radians(180) - np.tile(np.geomspace(1e-5, 0.5, 200), 3)
    for angle, sign in ((short, 1), (2 * np.pi - short, -1)):
        setpoint = np.hstack([np.cos(angle / 2)[:, None], np.sin(angle / 2)[:, None] * axes])
        error = flown_errors(library, 1.0, (1.0, 0.0, 0.0, 0.0), setpoint)
        np.testing.assert_allclose(error, sign * 2 * np.sin(short / 2)[:, None] * axes, atol=1e-5)


@given(seed=st.integers(0, 10_000))
def test_while_the_shorter_way_stays_the_same_a_small_change_of_the_setpoint_changes_the_error_as_little(library, seed):
    """Also where the error loses its turn, upside down; there with weight 1."""
    rng = np.random.default_rng(seed)
    start, end = rng.normal(size=(2, 4)) * [
        0.02 if rng.random() < 0.5 else 1.0,
        1,
        1,
        0.005 if rng.random() < 0.5 else 1,
    ]
    start[0], end[0] = abs(start[0]) + 1e-6, abs(end[0]) + 1e-6
    path = start + np.linspace(0, 1, 500)[:, None] * (end - start)
    path /= np.linalg.norm(path, axis=1, keepdims=True)
    error = flown_errors(library, 1.0, (1.0, 0.0, 0.0, 0.0), path)
    moved = np.linalg.norm(np.diff(path, axis=0), axis=1)
    # 2 imag moves at most twice as far as the quaternion; upside down, at either end of a step, up to 2 INVERTED of yaw
    # is left out.
    tilt = np.hypot(path[:, 0], path[:, 3])
    left_out = np.minimum(tilt[1:], tilt[:-1]) < 1.5 * INVERTED
    assert (np.linalg.norm(np.diff(error, axis=0), axis=1) <= 2 * moved + 2e-5 + 2 * INVERTED * left_out).all()


@given(seed=st.integers(0, 10_000), base=st.sampled_from([coupled_gains, following_gains]))
def test_the_sign_of_a_quaternion_means_nothing(library, seed, base):
    rng = np.random.default_rng(seed)
    gains = base().with_elements({"SP_SLEW": float(rng.choice([0.0, 3.0])), "YAW_W": float(rng.uniform(0.05, 1))})
    attitude, setpoint = random_pairs(60, seed)
    inputs = input_rows(60, attitude=attitude, attitude_setpoint=setpoint, yaw_rate_setpoint=0.7)
    other = inputs.copy()
    for name in ("attitude", "attitude_setpoint"):
        other[name] *= rng.choice([-1, 1], (60, 1))
    one, two = (NativeController(library, gains).run(rows) for rows in (inputs, other))
    assert (one == two).all()


@given(
    seed=st.integers(0, 10_000),
    heading=st.floats(-np.pi, np.pi),
    base=st.sampled_from([coupled_gains, following_gains]),
)
def test_the_heading_on_which_a_flight_begins_means_nothing(library, seed, heading, base):
    """Attitude and setpoint, turned by the same heading, differ by rounding only. Tilts up to 60 degrees."""
    rng = np.random.default_rng(seed)
    gains = base().with_elements({"SP_SLEW": float(rng.choice([0.0, 3.0])), "YAW_W": float(rng.uniform(0.05, 1))})
    tilts, headings = rng.uniform(-0.7, 0.7, (2, 60, 2)), rng.uniform(-1, 1, (2, 60)).cumsum(axis=1)
    first, turned = ([tilted(tilt, at + by) for tilt, at in zip(tilts, headings, strict=True)] for by in (0.0, heading))
    outputs = [flown(library, gains, q, q_d, yaw_rate_setpoint=0.7) for q, q_d in (first, turned)]
    np.testing.assert_allclose(*outputs, atol=1e-4)
