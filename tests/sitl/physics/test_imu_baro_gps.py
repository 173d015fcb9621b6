"""The raw sensors: true motion, noise densities, and the same readings for the same seed."""

import numpy as np
import pytest

from mimopilot.sitl.flight.simulator import Simulator
from mimopilot.sitl.physics.airframe import load_airframe
from mimopilot.sitl.physics.ground_contact import ground_state
from mimopilot.sitl.physics.imu_baro_gps import (
    ACCELEROMETER_DENSITY,
    GPS_HORIZONTAL,
    GPS_SPEED,
    GYRO_DENSITY,
    MAGNETOMETER_NOISE,
    METRES_PER_DEGREE,
    ImuBaroGps,
)
from mimopilot.sitl.physics.rigid_body import GRAVITY, MAX_ROTORS, hover_state

TS = 0.004
AIRFRAME = load_airframe("adam0").airframe
PLANT = AIRFRAME.plant()


def exact(state):
    """Sensors without noise and bias."""
    sensors = ImuBaroGps(state, TS, 0)
    sensors.biases[:], sensors.deviations[:] = 0.0, 0.0
    return sensors


def with_yaw(state, yaw):
    state[6:10] = np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)
    return state


def test_on_the_ground_the_accelerometer_measures_minus_gravity():
    state = ground_state(PLANT)
    readings = exact(state).read(state)
    assert readings[:6] == [0, 0, -GRAVITY, 0, 0, 0]
    assert readings[12:] == [0, 0, 0]


@pytest.mark.parametrize("yaw_deg", [0, 90, -135])
def test_the_magnetometer_measures_declination_and_inclination(yaw_deg):
    state = with_yaw(ground_state(PLANT), np.radians(yaw_deg))
    x, y, z = exact(state).read(state)[6:9]
    heading = np.degrees(-np.arctan2(y, x)) + 3.4
    assert (heading - yaw_deg + 180) % 360 - 180 == pytest.approx(0.0, abs=1e-9)
    assert np.degrees(np.arctan2(z, np.hypot(x, y))) == pytest.approx(63.2)
    assert np.linalg.norm([x, y, z]) == pytest.approx(0.482)


def test_the_barometer_follows_the_standard_atmosphere():
    readings = []
    for altitude in (0.0, 100.0):
        state = hover_state(PLANT, altitude)
        readings.append(np.mean([exact(state).read(state)[9:12] for _ in range(1)], axis=0))
    assert readings[0][0] - readings[1][0] == pytest.approx(11.94, abs=0.1)  # hPa in the first 100 m
    assert readings[1][1] - readings[0][1] == pytest.approx(100.0, abs=0.5)
    assert readings[0][2] - readings[1][2] == pytest.approx(0.65)


def test_integrated_accelerations_give_the_velocity_of_an_aggressive_flight():
    simulator = Simulator(AIRFRAME, TS, 0)
    sensors = exact(simulator.state)
    velocity, previous = simulator.state[3:6].copy(), simulator.state.copy()
    random = np.random.default_rng(1)
    for k in range(500):
        if k % 25 == 0:
            commands = np.zeros(MAX_ROTORS, np.float32)
            commands[:4] = random.uniform(0.3, 0.7, 4)
        simulator.advance(commands)
        readings = sensors.read(simulator.state)
        q = simulator.state[6:10] + previous[6:10]
        w, x, y, z = q / np.linalg.norm(q)
        R = np.array(
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
                [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
                [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
            ]
        )
        velocity += (R @ readings[:3] + [0, 0, GRAVITY]) * TS
        assert readings[3:6] == simulator.state[10:13].tolist()
        previous = simulator.state.copy()
    assert np.linalg.norm(simulator.state[3:6]) > 1.0
    assert np.abs(velocity - simulator.state[3:6]).max() < 1e-9


def test_the_noise_has_the_stated_densities():
    state, samples = ground_state(PLANT), 20_000
    readings = np.array([r for r in readings_of(state, 3, samples)])
    root = np.sqrt(0.5 / TS)
    expected = np.repeat([ACCELEROMETER_DENSITY * root, GYRO_DENSITY * root, MAGNETOMETER_NOISE], 3)
    # Five standard deviations of an estimated deviation.
    assert readings[:, :9].std(axis=0) == pytest.approx(expected, rel=5 / np.sqrt(2 * samples))
    assert np.abs(np.corrcoef(readings[:, :10].T) - np.eye(10)).max() < 5 / np.sqrt(samples)
    # GPS noise around a position a metre to the north, at 2 m/s to the east.
    state[0], state[4] = 1.0, 2.0
    sensors = ImuBaroGps(state, TS, 3)
    fixes = [sensors.fix(state) for _ in range(2000)]
    north = (np.array([f.position.latitude for f in fixes]) - 473977420) * 1e-7 * METRES_PER_DEGREE
    assert north.mean() == pytest.approx(1.0, abs=5 * GPS_HORIZONTAL / np.sqrt(2000))
    assert north.std() == pytest.approx(GPS_HORIZONTAL, rel=0.08)
    assert np.mean([f.east for f in fixes]) == pytest.approx(200, abs=500 * GPS_SPEED / np.sqrt(2000))
    assert np.mean([f.course for f in fixes]) == pytest.approx(9000, abs=20)


def readings_of(state, seed, samples):
    sensors = ImuBaroGps(state, TS, seed)
    return [sensors.read(state) for _ in range(samples)]


def test_equal_seeds_give_equal_readings_and_others_do_not():
    state = hover_state(PLANT)
    assert readings_of(state, 5, 50) == readings_of(state, 5, 50)
    assert readings_of(state, 5, 2) != readings_of(state, 6, 2)
    assert ImuBaroGps(state, TS, 5).fix(state) == ImuBaroGps(state, TS, 5).fix(state)


def test_an_impact_saturates_the_accelerometer():
    state = hover_state(PLANT)
    sensors = exact(state)
    state[5] = -5.0  # m/s within one sample
    assert sensors.read(state)[2] == pytest.approx(-15.9 * GRAVITY)
