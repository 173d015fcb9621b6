"""What an autotune refuses, and that nothing is changed then."""

import pytest

from mimopilot.sitl.errors import SitlError
from mimopilot.sitl.field.decisions import load_decisions
from tests.sitl.mavlink.log_transfer.logging_vehicle import ScriptedLogs


def refused(field, *words, flights=0):
    """The autotune ends with these words, and the set is the old one."""
    old = dict(field.vehicle.set)
    message = field.run()
    for word in words:
        assert word in message, message
    assert field.vehicle.set == old
    assert not field.vehicle.armed
    assert len(field.vehicle.logs.files) == flights
    return message


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"charge": 10}, ("the battery is at 10 %", "charge it")),
        ({"free": 1.0}, ("the card has 1 MiB left", "delete old logs")),
        ({"type": 1}, ("plane", "multirotor")),
        ({"autopilot": 3}, ("ArduPilot", "ardupilot-stock")),
        ({"logs": ScriptedLogs({}, fault="neither")}, ("no logs from the vehicle", "LOG_REQUEST_LIST")),
        ({"silent": {30}}, ("the vehicle does not send ATTITUDE",)),
    ],
    ids=["battery low", "card full", "a plane", "ArduPilot", "no logs", "no attitude"],
)
def test_a_vehicle_that_cannot_be_tuned_is_refused_on_the_ground(scripted, changes, words):
    refused(scripted(**changes), *words)


def test_a_vehicle_that_does_not_hover_is_refused_without_take_off(scripted):
    refused(scripted(pilot=True), "the vehicle does not hover", "--take-off METRES")


def test_strong_wind_is_refused_before_the_excitation(scripted):
    field = scripted(gust=0.12)
    refused(field, "the wind is too strong for the excitation", "degrees")
    assert not any(map(any, field.vehicle.moments))


def test_a_log_without_the_experiment_is_refused_and_the_experiment_flown_again(scripted):
    field = scripted(lost_excitation=True)
    refused(field, "it does not contain the experiment", flights=1)
    field.vehicle.lost_excitation = False
    assert field.run() == ""


def test_a_log_that_is_empty_because_the_card_is_full_is_refused_and_the_flight_repeated(scripted):
    field = scripted(cut=0)
    refused(field, "has 0 bytes", "card full?", flights=1)
    field.vehicle.cut = None
    assert field.run() == ""


def test_a_vehicle_is_armed_only_after_its_own_question(scripted):
    field = scripted(answers={"Arm": False})
    refused(field, "may not be armed")
    assert field.user.asked[0].startswith("Arm vehicle 1 and take off to 2 m?")


@pytest.mark.parametrize(("simulated", "arm"), [(True, False), (False, True)])
def test_yes_arms_a_simulated_vehicle_and_arm_any(scripted, simulated, arm):
    field = scripted(yes=True, arm=arm, simulated=simulated)
    field.user.interactive = False
    assert field.run() == ""
    assert not field.user.asked


def test_yes_alone_does_not_arm_a_real_vehicle(scripted):
    field = scripted(yes=True, simulated=False)
    field.user.interactive = False
    refused(field, "--yes is no answer", "--arm")


def test_gains_that_somebody_else_changed_meanwhile_are_not_overwritten(scripted):
    field = scripted()
    field.user.obeys = {"upload": lambda: field.vehicle.values.update({"MIMO_RP_RR": 0.2})}
    message = field.run()
    assert "somebody changed them" in message
    assert "neither" in message
    assert field.vehicle.values["MIMO_RP_RR"] == 0.2


def test_a_folder_of_something_else_or_a_damaged_record_is_refused(tmp_path):
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(SitlError, match=r"holds files, but no decisions\.json"):
        load_decisions(tmp_path, "mimo")
    (tmp_path / "decisions.json").write_text('{"version": 1}')
    with pytest.raises(SitlError, match=r"decisions\.json: cannot be read"):
        load_decisions(tmp_path, "mimo")
    made = load_decisions(tmp_path / "new", "mimo")
    made.add("checks", {})
    with pytest.raises(SitlError, match="is for --profile mimo, not px4-stock"):
        load_decisions(tmp_path / "new", "px4-stock")
