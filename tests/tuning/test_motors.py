"""The motors in a log: the allocator, the rotors' lag, and doublets that saturate them."""

import dataclasses

import numpy as np
import pytest
from hypothesis import strategies as st

from mimopilot.sitl.autopilot.autopilot import Autopilot
from mimopilot.sitl.flight.flight_log import save_flight
from mimopilot.sitl.flight.scenario import excitation_flight
from mimopilot.sitl.flight.simulator import fly
from mimopilot.sitl.physics.airframe import load_airframe
from mimopilot.tuning.design.cascade import tune
from mimopilot.tuning.design.tune_by_design import MOTORS_UNKNOWN
from mimopilot.tuning.logs.reader import read_log
from mimopilot.tuning.motors import fit_motors, saturation_warnings
from tests.tuning.logs.flights import make_flight, microseconds, px4_topics, write_ulog

TS = 0.004
UNIT = st.floats(-1, 1)


@pytest.fixture(scope="module")
def logs(tmp_path_factory):
    """Experiments read from ULog files, by airframe."""
    folder, found = tmp_path_factory.mktemp("motors"), {}
    for name, amplitude in (("adam0_nominal", 0.15), ("adam0_perturbed", 0.15), ("antr", 0.05)):
        vehicle = load_airframe(name)
        task = excitation_flight(20.0, amplitude, 50.0, TS, np.random.default_rng(4))
        gains = vehicle.default_gains()
        flight = fly(vehicle.airframe, Autopilot(vehicle.airframe, gains), task, 4)
        save_flight(folder / f"{name}.ulg", flight, vehicle.airframe, gains)
        found[name] = read_log(folder / f"{name}.ulg")
    return found


@pytest.mark.parametrize("name", ["adam0_nominal", "adam0_perturbed", "antr"])
def test_the_allocator_is_identified_from_a_log(logs, name):
    motors, airframe = logs[name].motors, load_airframe(name).airframe
    assert motors.mixer == pytest.approx(airframe.allocation().mixer[:, :2], abs=0.005)
    weight = airframe.plant().mass * 9.80665 / (4 * airframe.motors.thrust_max)
    assert motors.hover.mean() == pytest.approx(weight, rel=0.02)


def test_the_motor_that_carries_a_mass_hovers_higher(logs):
    hover = logs["adam0_perturbed"].motors.hover
    assert np.argmax(hover) == 2
    assert hover[2] - hover.mean() > 0.05


def test_the_mixer_of_linear_commands_is_found_exactly():
    rng = np.random.default_rng(1)
    mixer = rng.normal(size=(6, 2))
    u = 0.05 * rng.normal(size=(500, 2)) + [0.02, -0.01]
    commands = 0.5 + (u - np.median(u, axis=0)) @ mixer.T
    motors = fit_motors(u, commands)
    assert motors.mixer == pytest.approx(mixer, abs=1e-9)
    assert motors.hover == pytest.approx(np.full(6, 0.5), abs=1e-9)


def test_commands_that_the_torque_does_not_explain_give_no_motors():
    rng = np.random.default_rng(2)
    u, other = 0.1 * rng.normal(size=(500, 2)), 0.1 * rng.normal(size=(500, 2))
    commands = 0.5 + other @ np.array([[0.5, 0.5, -0.5, -0.5], [0.5, -0.5, 0.5, -0.5]])
    assert fit_motors(u, commands) is None
    assert fit_motors(u, np.full((500, 4), np.nan)) is None
    assert fit_motors(u[:20], commands[:20]) is None


def test_commands_are_read_at_any_rate_and_with_any_thrust_curve(tmp_path):
    """A PX4 log with four of twelve motors, logged at 10 Hz.

    With THR_MDL_FAC 0, PX4's default, the commands still say how far a motor is from its limits.
    """
    flight = make_flight()
    mixer = np.sqrt(0.5) * np.array([[-1.0, 1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, -1.0]])
    control = np.full((len(flight.t), 12), np.nan, np.float32)
    control[:, :4] = 0.45 + flight.u @ mixer.T
    motors = {
        "timestamp": microseconds(flight.t + 0.0005),
        "timestamp_sample": microseconds(flight.t),
        "control": control,
    }
    topics = px4_topics(flight, actuator_motors={name: values[::25] for name, values in motors.items()})
    read = read_log(write_ulog(tmp_path / "thrust.ulg", topics, {"THR_MDL_FAC": 0.3})).motors
    middle = np.median(flight.u[::25], axis=0)
    assert read.mixer == pytest.approx(mixer, abs=1e-5)
    assert read.hover == pytest.approx(0.45 + mixer @ middle, abs=1e-5)
    other = read_log(write_ulog(tmp_path / "speed.ulg", topics, {"THR_MDL_FAC": 0.0})).motors
    assert np.array_equal(other.hover, read.hover)


def test_a_design_warns_if_the_motors_are_not_logged(logs):
    log = logs["adam0_nominal"]
    assert MOTORS_UNKNOWN in tune(dataclasses.replace(log, motors=None)).provenance.warnings
    assert MOTORS_UNKNOWN not in tune(log).provenance.warnings


def test_saturated_motors_are_reported_with_an_amplitude_that_avoids_saturation():
    """Motors that change by half of the torque about 0.2: a total torque of 0.4 saturates them."""
    rng = np.random.default_rng(0)
    u = 0.1 * rng.choice([-1.0, 0.0, 1.0], (4000, 2))
    u[:200, 0] = 0.5 * rng.choice([-1.0, 1.0], 200)
    mixer, hover = np.array([[0.5, 0.5], [-0.5, 0.5], [0.5, -0.5], [-0.5, -0.5]]), 0.2
    commands = np.clip(hover + u @ mixer.T, 0.0, 1.0)
    motors = fit_motors(u, commands)
    (text,) = saturation_warnings(u, commands, motors, 0.5)
    assert text.startswith("a motor is saturated in 5% of the samples")
    # The largest change of a motor is (0.5 + 0.1) / 2, below a hover command of 0.2.
    assert text.endswith(f"inject a torque of {0.5 * 0.2 / 0.3:.2g} instead of 0.5")
    assert saturation_warnings(0.1 * u, np.clip(hover + 0.1 * u @ mixer.T, 0, 1), motors, 0.05) == []


def test_the_default_amplitude_does_not_saturate_the_motors_of_each_airframe():
    from mimopilot.sitl.flight.excitation_flight import default_amplitude

    found = {name: default_amplitude(load_airframe(name).airframe) for name in ("adam0", "antr", "px4_sih")}
    assert found == {"adam0": 0.15, "antr": pytest.approx(0.056), "px4_sih": 0.15}
