"""Turns, flips, recovery and heading steps: the flown law beside one on Euler angles."""

import numpy as np
import pytest

from mimopilot.sitl.physics.airframe import load_airframe
from mimopilot.sitl.studies.manoeuvres import (
    BANKS_DEG,
    FLIP_RATE,
    RECOVERY_DEG,
    YAW_RATE,
    attitude_errors,
    euler_rates,
    fly_manoeuvre,
    manoeuvres,
    reproduce_manoeuvres,
)

SUITE = {one.name: one for one in manoeuvres(0.004)}


def flown(name, law=None, airframe="adam0"):
    manoeuvre = SUITE[name]
    truth = fly_manoeuvre(airframe, load_airframe(airframe).default_gains(), manoeuvre, law)
    return manoeuvre.judge(manoeuvre.scenario, truth)


@pytest.mark.parametrize("bank", BANKS_DEG)
def test_in_a_coordinated_turn_the_thrust_points_where_it_is_asked_to(bank):
    name = f"turn at {bank:g} deg of bank"
    assert flown(name)["tilt error, deg"] < 0.4
    # The Euler law gives no pitch rate: its error is of the order of yaw rate times sin(bank) / Kp_o.
    expected = np.degrees(YAW_RATE * np.sin(np.radians(bank)) / load_airframe("adam0").default_gains().Kp_o[1, 1])
    assert flown(name, euler_rates)["tilt error, deg"] > 0.25 * expected > 0.5


@pytest.mark.parametrize("axis", ["roll", "pitch"])
def test_a_flip_in_rate_mode_turns_through_and_ends_level(axis):
    figures = flown(f"flip in {axis}")
    assert 270 < figures["turned at the end of the rate setpoint, deg"] <= 370
    assert figures["level again, s"] < 0.3
    assert figures["heading error, deg"] < 3
    assert load_airframe("adam0").default_gains().limits.rate_max[0] / 2 < FLIP_RATE


def test_both_recoveries_end_level_and_the_oblique_one_sooner_than_under_the_euler_law():
    for kind in ("of roll", ", oblique"):
        name = f"recovery from {RECOVERY_DEG:g} deg {kind}".replace("deg ,", "deg,")
        assert flown(name)["level again, s"] < 0.6
    assert flown(name)["level again, s"] < flown(name, euler_rates)["level again, s"]


@pytest.mark.parametrize("angle", [90, 170])
def test_a_heading_step_is_flown_level(angle):
    figures = flown(f"heading step of {angle} deg")
    assert figures["largest tilt, deg"] < 0.5
    assert np.isfinite(figures["heading reached, s"])


def test_from_level_one_axis_differs_from_the_angle_by_less_than_one_percent_up_to_25_degrees():
    largest = 0.0
    for name, flown, euler in attitude_errors():
        if name.startswith("level"):
            axis = np.argmax(np.abs(euler))
            assert flown[axis] == pytest.approx(np.degrees(2 * np.sin(np.radians(euler[axis] / 2))), rel=1e-9)
            assert np.abs(np.delete(flown, axis)).max() < 1e-9
            largest = max(largest, abs(flown[axis] / euler[axis] - 1))
    assert 0.0078 < largest < 0.01


def test_banked_the_errors_of_the_two_laws_differ():
    errors = {name: (flown, euler) for name, flown, euler in attitude_errors()}
    # 10 degrees of heading at 45 degrees of bank: the thrust's direction turns, mostly by pitch.
    flown, euler = errors["roll 45 deg, to heading of 10 deg"]
    assert euler.tolist() == [0, 0, 10]
    assert flown[1] == pytest.approx(10 * np.sin(np.radians(45)), rel=0.02)
    reversing = errors["roll from -25 to 25 deg"][0]
    assert reversing[0] == pytest.approx(np.degrees(2 * np.sin(np.radians(25))), rel=1e-9)


def test_the_report_shows_each_manoeuvre_of_each_airframe(tmp_path):
    found = reproduce_manoeuvres(tmp_path)
    assert found.report.is_file()
    for name, table in zip(("adam0", "adam0_boom", "antr"), found.tables[:3], strict=True):
        assert {row[0] for row in table.rows} == set(SUITE) == set(found.figures[name])
    turn = found.figures["antr"]["turn at 45 deg of bank"]
    assert turn["quaternion"]["tilt error, deg"] < 0.1 < 1 < turn["euler"]["tilt error, deg"]
