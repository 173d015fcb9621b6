"""The linear model of an airframe against an independent one, and against the simulation."""

import numpy as np
import pytest

from mimopilot.sitl.autopilot.autopilot import Autopilot
from mimopilot.sitl.flight.scenario import hover
from mimopilot.sitl.flight.simulator import fly
from mimopilot.sitl.physics.airframe import Frame, known_airframes, load_airframe
from mimopilot.sitl.physics.linear_model import control_effectiveness, linear_model
from tests.tuning.truth import linear_plant

TS = 0.004
OMEGA = np.geomspace(0.1, 0.999 * np.pi / TS, 300)


@pytest.mark.parametrize("name", known_airframes())
def test_the_response_is_that_of_an_independent_model(name):
    airframe = load_airframe(name).airframe
    ours, theirs = (model(airframe, Ts=TS).frequency_response(OMEGA) for model in (linear_model, linear_plant))
    assert np.abs(ours - theirs).max(axis=(1, 2)) == pytest.approx(0, abs=1e-9 * np.abs(theirs).max())


@pytest.mark.parametrize("samples", [0, 1, 6])
def test_a_delay_is_a_power_of_z(samples):
    airframe = load_airframe("adam0_flexible").airframe.model_copy(update={"computing_delay": 0})
    late = airframe.model_copy(update={"computing_delay": samples})
    z = np.exp(1j * OMEGA * TS)[:, None, None]
    without, delayed = (linear_model(one, TS).frequency_response(OMEGA) for one in (airframe, late))
    assert np.allclose(delayed, without * z**-samples, rtol=1e-9, atol=0)


def test_at_low_frequency_the_rates_are_the_effectiveness_over_the_damping():
    airframe = load_airframe("adam0").airframe
    J, damping = np.array(airframe.inertia)[:2, :2], airframe.rate_damping
    B = control_effectiveness(airframe)
    assert np.allclose(B, np.linalg.inv(J) @ np.diag(airframe.moment_scale()[:2]), rtol=1e-12)
    slow = linear_model(airframe, TS).frequency_response(np.array([1e-4]))[0, :2]
    # J w' + damping diag(J) w = M, at rest w = M / (damping diag(J)).
    assert np.allclose(slow, np.diag(airframe.moment_scale()[:2] / np.diag(J) / damping), rtol=0, atol=0.05)


def test_a_small_simulated_motion_is_that_of_the_model():
    vehicle = load_airframe("adam0_flexible")
    airframe = vehicle.airframe.model_copy(update={"frame": Frame(frequency_hz=20.0, damping=0.05, gain=0.5)})
    scenario = hover("roll", 1.0, TS)
    scenario.excitation[10:20, 0], scenario.excitation[20:30, 1] = 1e-2, -1e-2
    record = fly(airframe, Autopilot(airframe, vehicle.default_gains()), scenario, 0, noise=False).record
    found = linear_model(airframe, TS).simulate(record["moment"][:, :2].astype(float))
    flown = np.hstack([record["rates"][:, :2], record["attitude"][:, :2]])
    assert np.abs(found[:, :2]).max() > 0.02
    # Thrust is quadratic in the rotors' speed: a torque of 1 % deviates by about that share.
    assert np.abs(found - flown).max() < 0.02 * np.abs(flown).max()
