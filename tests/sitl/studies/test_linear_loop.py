"""Exact linear figures against flights, another computation, and closed forms; the LQG servo."""

from dataclasses import replace

import numpy as np
import pytest

from mimopilot.sitl.autopilot.autopilot import Autopilot
from mimopilot.sitl.flight.scenario import AXES, doublet
from mimopilot.sitl.flight.simulator import fly
from mimopilot.sitl.physics.airframe import load_airframe
from mimopilot.sitl.studies.linear_loop import LinearController, LinearLoop
from mimopilot.sitl.studies.lqg import lqg, lqg_with_noise
from mimopilot.sitl.studies.true_plant import TruePlant, optimum_on_true_plant, true_response
from mimopilot.tuning.analysis.manoeuvres import manoeuvres
from mimopilot.tuning.design.prediction import predict
from mimopilot.tuning.reference_model import SecondOrder, second_order
from mimopilot.tuning.statespace import StateSpace

TS = 0.004
MODEL = second_order(10.0, 0.7, 0, TS)


def following(gains):
    """Some gains with model following, coupled in every matrix."""
    some = np.array([[0.0, 0.1], [-0.05, 0.0]])
    return replace(
        gains,
        Kp_o=gains.Kp_o + some,
        Kp_i=gains.Kp_i @ (np.eye(2) + some),
        filters=replace(gains.filters, model_omega=9.0, model_damping=0.8),
        Kff_o=np.eye(2) + some,
        Kaff_i=np.diag([0.006, 0.005]) @ (np.eye(2) + some),
        Kff_i=0.1 * gains.Kp_i,
    )


@pytest.mark.parametrize("name", ["adam0", "antr", "px4_sih"])
@pytest.mark.parametrize("change", [lambda gains: gains, following], ids=["plain", "following"])
def test_small_doublets_are_those_of_a_flight(name, change):
    vehicle = load_airframe(name)
    gains = change(vehicle.default_gains())
    loop = TruePlant(vehicle.airframe, TS).loop(gains)
    size = 0.01
    for axis, axis_name in enumerate(AXES):
        task = doublet(axis_name, size, 0.8, TS, 1.0)
        flight = fly(vehicle.airframe, Autopilot(vehicle.airframe, gains), task, 0, noise=False)
        start = task.window[0]
        _, angles, torques = loop.doublet(axis, 0.8, 1.0)
        assert flight.truth["attitude"][start:, :2] == pytest.approx(size * angles, abs=2e-3 * size)
        assert flight.record["moment"][start:, :2] == pytest.approx(size * torques, abs=2e-3 * size)


@pytest.mark.parametrize("name", ["adam0", "antr", "px4_sih"])
def test_the_noise_is_that_of_the_spectra(name):
    vehicle = load_airframe(name)
    gains, plant = vehicle.default_gains(), true_response(vehicle.airframe, TS)
    found = TruePlant(vehicle.airframe, TS).loop(gains).noise
    assert found == pytest.approx(predict(gains, plant, manoeuvres(plant, MODEL, gains.filters)).noise, rel=2e-3)


def test_the_damping_is_that_of_the_least_damped_slow_poles():
    """Two double integrators under rate and angle feedback: poles of known frequency and damping."""
    Ts = 1e-4
    body = StateSpace(
        np.kron([[1.0, 0.0], [Ts, 1.0]], np.eye(2)),
        np.hstack([np.kron([[Ts], [Ts**2 / 2]], np.eye(2)), np.zeros((4, 4))]),
        np.eye(4),
        np.hstack([np.zeros((4, 2)), np.eye(4)]),
        Ts,
    )

    def loop(omega, zeta):
        gain = np.hstack([np.zeros((2, 2)), -np.diag(2 * np.array(zeta) * omega), -np.diag(np.array(omega) ** 2)])
        law = StateSpace(np.zeros((0, 0)), np.zeros((0, 6)), np.zeros((2, 0)), gain, Ts)
        return LinearLoop(body, LinearController(law, law))

    assert loop([5.0, 8.0], [0.6, 0.3]).damping == pytest.approx(0.3, rel=2e-3)
    # A fast pair does not count, however little it is damped.
    assert loop([5.0, 80.0], [0.6, 0.1]).damping == pytest.approx(0.6, rel=2e-3)
    assert np.isnan(loop([50.0, 80.0], [0.6, 0.1]).damping)
    assert np.isinf(loop([5.0, 8.0], [0.6, -0.1]).noise).all()


@pytest.fixture(scope="module", params=["adam0", "px4_sih"])
def servo(request):
    """True plant, flown loop, and the servo with 1.5 times the flown noise."""
    airframe = load_airframe(request.param).airframe
    truth, flown = TruePlant(airframe, TS), load_airframe(request.param).default_gains()
    before = truth.loop(flown)
    return truth, before, LinearLoop(truth.model, lqg_with_noise(airframe, MODEL, 1.5 * before.noise))


def test_the_servo_uses_its_noise_and_follows_better_than_any_gains(servo):
    truth, before, loop = servo
    assert loop.spectral_radius < 1
    assert (loop.noise / before.noise).max() == pytest.approx(1.5, rel=1e-3)
    flown = load_airframe(truth.airframe.name).default_gains()
    best = optimum_on_true_plant(truth.airframe, flown, bandwidth=10.0, follow_model=True)
    assert best.model == SecondOrder(10.0, 0.7)
    for period in (0.42, 0.8, 1.6):
        assert np.mean(loop.J_M(MODEL, period, 1.0)) < 0.7 * np.mean(truth.loop(best.gains).J_M(MODEL, period, 1.0))


def test_the_servo_holds_a_setpoint_and_rejects_a_constant_torque(servo):
    truth, _, loop = servo
    steps = np.zeros((1500, 6))
    steps[:, 0] = 1.0
    angles = loop.whole.simulate(steps)[-1, :2]
    assert angles == pytest.approx([1.0, 0.0], abs=1e-4)
    low = np.array([1e-3])
    G, K = (system.frequency_response(low) for system in (truth.model, loop.controller.loop))
    assert np.abs(np.linalg.inv(np.eye(2) - K[0][:, 2:] @ G[0][:, :2])).max() < 1e-3


def test_the_poles_of_the_servo_are_those_of_its_two_halves():
    """Separation: the state feedback of a value iteration gives poles of the loop, whatever the filter."""
    plant = TruePlant(load_airframe("adam0").airframe, TS).model
    A, B, C, weight = plant.A, plant.B[:, :2], plant.C[2:], 1e-2
    P = C.T @ C
    for _ in range(3000):
        K = np.linalg.solve(weight * np.eye(2) + B.T @ P @ B, B.T @ P @ A)
        P = C.T @ C + A.T @ P @ (A - B @ K)
    loop = LinearLoop(plant, lqg(plant, MODEL, np.full(2, 1e-4), weight))
    poles = np.linalg.eigvals(loop.feedback.A)
    for pole in np.linalg.eigvals(A - B @ K):
        if abs(pole) > 1e-3:  # the delays' poles at 0 are defective
            assert np.abs(poles - pole).min() < 1e-6
    # The filter's do not depend on the weight.
    other = np.linalg.eigvals(LinearLoop(plant, lqg(plant, MODEL, np.full(2, 1e-4), 1.0)).feedback.A)
    shared = [pole for pole in poles if abs(pole) > 1e-3 and np.abs(other - pole).min() < 1e-6]
    assert len(shared) >= 6
