"""The frame mode between the rotors and the sensors, against its transfer function."""

import numpy as np
import pytest

from mimopilot.sitl.autopilot.autopilot import Autopilot
from mimopilot.sitl.errors import SitlError
from mimopilot.sitl.flight.scenario import doublet, excitation_flight
from mimopilot.sitl.flight.simulator import Simulator, fly
from mimopilot.sitl.physics.airframe import Frame, load_airframe
from mimopilot.sitl.physics.state_estimate import MEASUREMENT_SIZE, Sensors, frame_mode, low_pass, measure
from mimopilot.tuning.plant.local_polynomial import local_response

TS = 0.004
NOISELESS = np.zeros(6)


def sensors(frequency_hz, damping, gain):
    frame = np.append(frame_mode(frequency_hz, damping, gain, TS), 1 / TS)
    return Sensors.healthy(0.0, 0.0, low_pass(0.0, TS), frame)


def measured(body_rates, at):
    """Measured rates (N, 3) of a body that rotates with `body_rates` (N, 3), rad/s."""
    state, measurement = np.zeros(13), np.zeros(MEASUREMENT_SIZE)
    state[6] = 1.0
    shown = []
    for rates in body_rates:
        state[10:] = rates
        measure(state, NOISELESS, at, measurement)
        shown.append(measurement[4:7].copy())
    return np.array(shown)


@pytest.mark.parametrize(("hz", "damping", "gain"), [(12.0, 0.02, 0.4), (25.0, 0.02, 0.8), (30.0, 0.3, -0.5)])
def test_the_measured_rates_follow_the_transfer_function_of_the_mode(hz, damping, gain):
    """1 + gain s^2 / (s^2 + 2 d w s + w^2), with the mean acceleration of each period held: near it up to the mode."""
    w, rng = 2 * np.pi * hz, np.random.default_rng(0)
    rates = np.zeros((20000, 3))
    rates[:, :2] = 0.3 * rng.standard_normal((20000, 2))
    shown = measured(rates, sensors(hz, damping, gain))[:, :2]
    found = local_response(rates[:, :2], shown, TS, [(0, 20000)])
    assert found.explained.min() > 0.98
    s = 1j * found.omega
    # The zero-order hold of the acceleration, exactly: (1 - 1/z) of its response to a step.
    z, poles = np.exp(s * TS), np.roots([1, 2 * damping * w, w**2])
    expected = np.ones(len(s), complex)
    for p, other in (poles, poles[::-1]):
        # b' / a = gain s / ((s - p)(s - q)) has the residue gain p / (p - q) at p.
        residue = gain * p / (p - other)
        expected += residue * (np.exp(p * TS) - 1) / p / (z - np.exp(p * TS)) * z * (1 - 1 / z) / TS
    away = np.abs(np.diagonal(found.response, axis1=1, axis2=2) - expected[:, None])
    assert np.median(away / np.abs(expected)[:, None]) < 0.01
    low = found.omega < 1.3 * w
    off = np.abs(found.omega - w) > 0.1 * w
    continuous = 1 + gain * s**2 / (s**2 + 2 * damping * w * s + w**2)
    # Half a period of delay between the acceleration and its mean.
    assert np.abs(expected - continuous)[low & off].max() < 0.3 * np.abs(continuous - 1)[low & off].max()
    assert np.abs(found.response[:, 0, 1]).max() < 0.05 * np.abs(expected).max()


def test_the_angle_is_consistent_with_the_rate_and_yaw_does_not_bend():
    at = sensors(25.0, 0.02, 0.8)
    rng = np.random.default_rng(1)
    rates = 0.2 * rng.standard_normal((500, 3))
    state, measurement = np.zeros(13), np.zeros(MEASUREMENT_SIZE)
    state[6] = 1.0
    A = frame_mode(25.0, 0.02, 0.8, TS)
    bend, before = np.zeros((2, 2)), np.zeros(2)
    for row in rates:
        state[10:] = row
        measure(state, NOISELESS, at, measurement)
        acceleration = (row[:2] - before) / TS
        bend = np.array([A[:4].reshape(2, 2) @ b + A[4:] * a for b, a in zip(bend, acceleration, strict=True)])
        before = row[:2]
        assert measurement[4:6] == pytest.approx(row[:2] + bend[:, 1], abs=1e-6)
        assert measurement[6] == np.float32(row[2])
        assert 2 * measurement[1:3] == pytest.approx(bend[:, 0], abs=1e-6)


def test_the_mode_oscillates_at_its_frequency_and_decays_with_its_damping():
    at = sensors(25.0, 0.02, 0.4)
    rates = np.zeros((250, 3))
    rates[:, 0] = 1.0  # a constant rate from the first sample on
    oscillation = measured(rates, at)[:, 0] - 1.0
    envelope = np.abs(oscillation[0]) * np.exp(-0.02 * 2 * np.pi * 25.0 * TS * np.arange(250))
    assert (np.abs(oscillation) <= 1.1 * envelope + 1e-6).all()
    crossings = np.flatnonzero(oscillation[1:] * oscillation[:-1] < 0)
    assert len(crossings) == pytest.approx(2 * 25.0 * 249 * TS, abs=1.5)


def test_a_rigid_frame_changes_no_bit():
    vehicle = load_airframe("adam0")
    scenario = doublet("roll", 0.3, 1.6, TS)
    body = vehicle.airframe
    # With the code of the mode, but zero modal gain.
    same = body.model_copy(update={"frame": Frame(frequency_hz=25.0, damping=0.02, gain=0.0)})
    flights = [fly(b, Autopilot(b, vehicle.default_gains()), scenario, 3).record for b in (body, same)]
    assert flights[0].tobytes() == flights[1].tobytes()
    bending = body.model_copy(update={"frame": Frame(frequency_hz=25.0, damping=0.02, gain=0.4)})
    other = fly(bending, Autopilot(bending, vehicle.default_gains()), scenario, 3).record
    assert np.abs(other["rates"][:, 0] - flights[0]["rates"][:, 0]).max() > 0.02


def test_a_restart_resets_the_bend():
    at = sensors(25.0, 0.02, 0.8)
    rng = np.random.default_rng(2)
    rates = 0.2 * rng.standard_normal((100, 3))
    first = measured(rates, at)
    again = measured(rates, at)
    assert np.abs(again - first).max() > 0.01  # it still oscillates
    at.restart(np.zeros(3))
    assert measured(rates, at).tobytes() == first.tobytes()
    at.restart(np.array([0.7, -0.4, 0.1]))
    steady = measured(np.tile([0.7, -0.4, 0.1], (20, 1)), at)
    assert steady == pytest.approx(np.tile([0.7, -0.4, 0.1], (20, 1)), abs=1e-6)


def test_two_simulators_with_the_same_seed_fly_the_same():
    vehicle = load_airframe("adam0_flexible")
    scenario = excitation_flight(2.0, 0.1, 50.0, TS, np.random.default_rng(0))
    gains = vehicle.default_gains()
    one, two = (fly(vehicle.airframe, Autopilot(vehicle.airframe, gains), scenario, 5) for _ in range(2))
    assert one.record.tobytes() == two.record.tobytes()
    assert not np.array_equal(one.record["rates"][:, 0], one.truth["rates"][:, 0].astype(np.float32))
    assert Simulator(vehicle.airframe, TS, 5).sensors.frame[6] == 1 / TS


def test_a_mode_at_half_of_the_sampling_rate_is_refused():
    with pytest.raises(SitlError, match=r"frame.frequency_hz: got 125 Hz, expected below 125 Hz"):
        frame_mode(125.0, 0.02, 0.4, TS)
