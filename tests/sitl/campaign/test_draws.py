"""What a campaign draws: the moments, the flight that uses them, faults, and refused specifications."""

import re
from dataclasses import replace

import numpy as np
import pytest

from mimopilot.common.errors import InputFileError
from mimopilot.sitl.autopilot.autopilot import Autopilot
from mimopilot.sitl.campaign.flights import FlightRunner
from mimopilot.sitl.errors import SitlError
from mimopilot.sitl.flight.simulator import fly
from mimopilot.sitl.physics.rigid_body import GRAVITY, checked_inertia
from tests.paths import DOCS
from tests.sitl.campaign.plans import VARY, drawn, plan_of, variation


def test_draws_have_the_moments_of_their_distributions(vehicle):
    n = 2000
    values = [draw.values for draw in drawn(vehicle, VARY, n)]
    columns = {name: np.array([value[name] for value in values]) for name in values[0]}
    own = vehicle.airframe
    low, high = np.log(0.03), np.log(0.08)
    expected = {  # mean, standard deviation
        "mass": (own.mass, 0.05 * own.mass),
        "inertia.xx": (1.1 * own.inertia[0][0], 0.4 * own.inertia[0][0] / np.sqrt(12)),
        "motors.effectiveness.3": (0.9, 0.2 / np.sqrt(12)),
        "noise.rate": (1.25 * own.noise.rate, 1.5 * own.noise.rate / np.sqrt(12)),
        "attitude_deg.roll": (0.0, 5.0),
        "rates_deg_s.pitch": (0.0, 20.0),
        "wind.north": (1.0, 2.0),
    }
    for name, (mean, deviation) in expected.items():
        assert columns[name].mean() == pytest.approx(mean, abs=4 * deviation / np.sqrt(n)), name
        assert columns[name].std() == pytest.approx(deviation, rel=4 / np.sqrt(n)), name
    logarithm = np.log(columns["motors.time_constant"])
    assert logarithm.mean() == pytest.approx((low + high) / 2, abs=4 * (high - low) / np.sqrt(12 * n))
    assert np.unique(columns["delay"], return_counts=True)[1] == pytest.approx([n / 3] * 3, abs=4 * np.sqrt(n * 2 / 9))
    motors = np.corrcoef([columns[f"motors.effectiveness.{i}"] for i in (1, 2, 3, 4)])
    assert np.abs(motors - np.eye(4)).max() < 4 / np.sqrt(n)


def test_the_flight_uses_the_drawn_values(vehicle):
    own = vehicle.airframe.plant()
    share = own.inertia[0, 1] / np.sqrt(own.inertia[0, 0] * own.inertia[1, 1])
    for draw in drawn(vehicle, VARY, 20):
        inertia = draw.plant.inertia
        assert (draw.plant.mass, draw.delay) == (draw.values["mass"], draw.values["delay"])
        assert inertia[0, 0] == pytest.approx(draw.values["inertia.xx"], rel=1e-12)
        assert inertia[0, 1] / np.sqrt(inertia[0, 0] * inertia[1, 1]) == pytest.approx(share, rel=1e-12)
        assert draw.plant.inertia_inverse @ inertia == pytest.approx(np.eye(3), abs=1e-12)
        assert draw.state[11] == np.radians(draw.values["rates_deg_s.pitch"])
        assert 2 * np.degrees(np.arcsin(draw.state[7])) == pytest.approx(draw.values["attitude_deg.roll"], abs=1e-5)
        thrust = 4 * draw.state[13] ** 2 * draw.plant.thrust_coefficient
        assert thrust == pytest.approx(draw.plant.mass * GRAVITY, rel=1e-12)


def test_impossible_draws_are_repeated_and_counted_and_an_impossible_specification_is_refused(vehicle):
    wide = "[inertia]\nzz = { uniform = [0.5, 1.5], relative = true }"
    draws = drawn(vehicle, wide, 300)
    for draw in draws:
        checked_inertia(draw.plant.inertia)
    # J_zz above J_xx + J_yy, 0.0319 of at most 0.04425: about 42 % of the draws.
    possible = 300 / (300 + sum(draw.rejected for draw in draws))
    assert possible == pytest.approx(0.58, abs=0.06)
    with pytest.raises(SitlError, match=r"run 0: 1000 draws in a row .* cannot hover"):
        drawn(vehicle, "mass = { uniform = [3.0, 4.0] }", 1)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("mass = { uniform = [1, 2], normal = [1, 2] }", "mass: expected exactly one"),
        ("mass = { uniform = [2, 1] }", "mass: uniform: expected [low, high]"),
        ("mass = { loguniform = [0, 1] }", "mass: loguniform: expected bounds above 0"),
        ("wind = { north = { normal = [1, 1], relative = true } }", "wind: the airframe has no value of its own"),
        ("weight = { normal = [1, 1] }", "weight: unknown entry"),
        ("mass = ", "not a TOML file"),
    ],
)
def test_a_wrong_specification_is_refused_with_the_name_of_its_entry(text, words):
    with pytest.raises(InputFileError) as error:
        variation(text)
    assert words in str(error.value)


def test_faults_are_those_of_the_scenario_and_the_drawn_ones_and_do_not_affect_the_next_run(vehicle):
    vary = """
[[fault]]
kind = "motor"
motor = { uniform = [0.5, 4.5] }
size = { uniform = [0.7, 0.9] }
at = { uniform = [1.0, 1.4] }
[[fault]]
kind = "gain"
matrix = "Kp_i"
size = 0.9
at = 1.2
"""
    plan = plan_of(vehicle, vary=vary, faults=["gyro-stuck:roll@1.1+0.02", "loss=0.2@0.5"], axes=["roll"])
    runner = FlightRunner(plan)
    motors = set()
    for run in (5, *range(30)):
        draw = runner.draw(run)
        assert [fault.kind for fault in draw.faults] == ["gyro-stuck", "loss", "motor", "gain"]
        assert draw.faults[2].size == draw.values["fault.1.size"]
        motors.add(draw.faults[2].motor)
        flight = runner.fly(draw, "default", 0)
        scenario = replace(plan.scenarios[0], faults=draw.faults)
        alone = fly(vehicle.airframe, Autopilot(vehicle.airframe, vehicle.default_gains()), scenario, [3, run, 1])
        assert flight.record.tobytes() == alone.record.tobytes()
        assert (flight.runs == alone.runs).all()
    assert motors == {1, 2, 3, 4}


def test_the_specification_in_the_manual_can_be_drawn_from(vehicle):
    section = (DOCS / "campaigns.md").read_text()
    example = "\n".join(re.findall(r"```toml\n(.*?)```", section, re.DOTALL))
    names = drawn(vehicle, example, 1)[0].values
    assert {"mass", "delay", "inertia.xx", "motors.effectiveness.4", "fault.1.motor", "amplitude_deg"} <= set(names)
