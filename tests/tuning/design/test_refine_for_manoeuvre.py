"""All gains refined for a doublet: the prediction, the constraints, and the flown result."""

import dataclasses

import numpy as np
import pytest

from mimopilot.sitl.autopilot.autopilot import Autopilot
from mimopilot.sitl.flight.metrics import performance
from mimopilot.sitl.flight.scenario import doublet
from mimopilot.sitl.flight.simulator import fly
from mimopilot.sitl.physics.airframe import load_airframe
from mimopilot.tuning.analysis.closed_loop import model_spectral_radius
from mimopilot.tuning.analysis.doublet_prediction import DoubletModel, doublet_effort, doublet_model
from mimopilot.tuning.controller import Controller
from mimopilot.tuning.design.cascade import tune
from mimopilot.tuning.design.constrained_least_squares import constrained_least_squares
from mimopilot.tuning.errors import TuningError
from mimopilot.tuning.gain_stack import GainStack
from mimopilot.tuning.gains import Limits
from mimopilot.tuning.plant.plant_estimates import PlantEstimates
from mimopilot.tuning.reference_model import second_order
from mimopilot.tuning.spec import Manoeuvre, parse_doublet
from mimopilot.tuning.statespace import StateSpace
from tests.conftest import assert_one_clear_line
from tests.tuning.analysis.test_certify import experiment
from tests.tuning.truth import thesis

TS = 0.004
DOUBLET = {"amplitude_deg": 22.5, "period_s": 0.42}


@pytest.fixture(scope="module")
def log():
    return experiment("adam0")


@pytest.fixture(scope="module")
def sets(log):
    siso = tune(log, thesis(method="siso"))
    model = doublet_model(PlantEstimates(log), Manoeuvre(**DOUBLET))
    allowed = tuple(1.06 * spent for spent in doublet_effort(siso, model))
    task = {**DOUBLET, "effort": allowed}
    return {
        "siso": siso,
        "mimo": tune(log, thesis()),
        "refined": tune(log, thesis(manoeuvre=task)),
        "refined siso": tune(log, thesis(method="siso", manoeuvre=task)),
    }


@pytest.mark.parametrize("axis", ["roll", "pitch"])
def test_refined_gains_follow_three_times_better_within_the_effort(sets, axis):
    airframe = load_airframe("adam0").airframe
    inner, outer = second_order(20, 0.4, 0, TS), second_order(10, 0.7, 0, TS)
    task = doublet(axis, np.radians(DOUBLET["amplitude_deg"]), DOUBLET["period_s"], TS)
    flown = {
        name: performance(fly(airframe, Autopilot(airframe, g), task, 3), inner, outer) for name, g in sets.items()
    }
    assert flown["refined"].J_M_o < flown["mimo"].J_M_o / 3
    assert flown["refined"].J_M_o < flown["siso"].J_M_o / 3
    assert flown["refined"].offaxis_peak_deg < flown["siso"].offaxis_peak_deg / 3
    assert flown["refined"].effort_rms < 1.1 * flown["siso"].effort_rms
    # Without off-diagonal gains the axes cannot be decoupled.
    assert flown["refined siso"].offaxis_peak_deg > 2 * flown["refined"].offaxis_peak_deg


def test_refined_gains_keep_their_margins_and_record_the_manoeuvre(sets):
    refined = sets["refined"]
    figures = refined.certificate.figures
    assert refined.verdict()[0] in ("certified", "stable, thin margin")
    assert figures["Ms"] + figures["Ms_error"] <= 2.5
    assert refined.provenance.details["manoeuvre"]["amplitude_deg"] == DOUBLET["amplitude_deg"]
    # VRFT's standard deviations do not apply to the refined gains.
    assert refined.provenance.standard_deviation == {}
    assert np.linalg.eigvalsh(refined.Ki_i + refined.Ki_i.T)[0] > 0


def test_refined_siso_gains_stay_diagonal(sets):
    for name in ("Kp_o", "Kp_i", "Ki_i", "Kd_i"):
        matrix = getattr(sets["refined siso"], name)
        assert matrix[0, 1] == matrix[1, 0] == 0


def test_the_predicted_effort_is_within_the_allowed_one(log, sets):
    allowed = sets["refined"].provenance.details["manoeuvre"]["effort"]
    needed = doublet_effort(sets["refined"], doublet_model(PlantEstimates(log), Manoeuvre(**DOUBLET)))
    assert np.all(np.array(needed) <= np.array(allowed) * 1.001)


def test_the_same_log_gives_the_same_gains(log, sets):
    again = tune(log, thesis(manoeuvre=sets["refined"].provenance.details["manoeuvre"]))
    assert again.elements() == sets["refined"].elements()


def test_the_prediction_runs_the_flown_difference_equation(gains):
    """Against the reference controller, with saturation of rates, torque and integral."""
    gains = dataclasses.replace(gains, limits=Limits((1.5, 1.2, 3.0), (0.12, 0.1, 1.0), (0.02, 0.015, 0.2)))
    A = np.array([[0.9, 0.02], [-0.01, 0.92]])
    plant = StateSpace(A, np.array([[0.5, 0.05], [0.04, 0.6]]), np.eye(2), np.zeros((2, 2)), TS)
    setpoint = np.repeat([0.4, -0.4, 0.0], 60)
    angles, moments = DoubletModel(plant, np.zeros(2), setpoint).simulate(GainStack.of(gains))
    for axis in range(2):
        controller, state, rate, angle = Controller(gains, np.float64), np.zeros(2), np.zeros(2), np.zeros(2)
        asked = np.zeros(3)
        for k, height in enumerate(setpoint):
            angle, rate = angle + TS / 2 * (state + rate), state
            asked[axis] = height
            step = controller.step(asked, np.append(angle, 0.0), np.append(rate, 0.0))
            assert angles[axis, 0, k] == pytest.approx(angle, abs=1e-12)
            assert moments[axis, 0, k] == pytest.approx(np.array(step.moment[:2]), abs=1e-12)
            state = A @ state + plant.B @ np.array(step.moment[:2])
    assert np.abs(moments[0, 0, :, 0]).max() == 0.12  # it did saturate


def test_the_spectral_radius_is_the_growth_of_a_simulated_flight(gains):
    wide = Limits((1e99,) * 3, (1e99,) * 3, (1e99,) * 3)
    A = np.array([[0.9, 0.02], [-0.01, 0.92]])
    plant = StateSpace(A, np.array([[0.5, 0.05], [0.04, 0.6]]), np.eye(2), np.zeros((2, 2)), TS)
    model = DoubletModel(plant, np.zeros(2), np.concatenate([np.ones(5), np.zeros(195)]))
    stable = dataclasses.replace(gains, limits=wide)
    growing = dataclasses.replace(gains, limits=wide, Kp_i=30 * gains.Kp_i)
    size = np.abs(model.simulate(GainStack.of(growing))[0][:, 0]).max(axis=(0, 2))
    assert model_spectral_radius(growing, plant) == pytest.approx((size[150] / size[100]) ** (1 / 50), rel=1e-3)
    # For a stable set it is the slowest mode, which may be that of the rate loop alone.
    size = np.abs(model.simulate(GainStack.of(stable))[0][:, 0]).max(axis=(0, 2))
    assert (size[150:200].max() / size[100:150].max()) ** (1 / 50) < model_spectral_radius(stable, plant) < 1


def test_refined_gains_are_stable_on_the_model_in_both_loops(log, sets):
    model = doublet_model(PlantEstimates(log), Manoeuvre(**DOUBLET))
    for name in ("refined", "refined siso"):
        assert model_spectral_radius(sets[name], model.plant) < 1


def test_a_start_that_violates_the_constraints_reaches_the_feasible_minimum():
    def examine(points):
        return 10.0 * points + 1e-3 * points**3, np.column_stack([points[:, 0] - 1.0, 2.0 - points[:, 1] ** 2])

    point, cost = constrained_least_squares(examine, np.array([0.0, 3.0]), 1e-6)
    assert point == pytest.approx([1.0, 0.0], abs=1e-3)
    assert cost == pytest.approx(100.02, rel=1e-3)


def test_no_point_within_the_constraints_costs_infinity():
    def examine(points):
        return points, np.full((len(points), 1), -1.0)

    assert constrained_least_squares(examine, np.ones(2), 1e-6)[1] == np.inf


def test_the_minimum_on_a_constraint_is_found():
    def examine(points):
        return points - np.array([3.0, 1.0]), 2.0 - np.sum(points, axis=1, keepdims=True)

    point, cost = constrained_least_squares(examine, np.zeros(2), 1e-6)
    assert point == pytest.approx([2.0, 0.0], abs=1e-3)
    assert cost == pytest.approx(2.0, rel=1e-3)


def test_the_doublet_option_takes_two_numbers(mimopilot, tmp_path):
    assert parse_doublet("22.5,0.42") == DOUBLET
    with pytest.raises(TuningError, match="expected DEGREES,SECONDS"):
        parse_doublet("22.5")
    result = mimopilot("tune", "none.ulg", "--out", "x.gains.toml", "--doublet", "200,0.4")
    assert_one_clear_line(result, "amplitude_deg")
