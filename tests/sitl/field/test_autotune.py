"""An autotune from beginning to end, and the ways in which it is decided."""

import json
import math

import pytest

import mimopilot.sitl.field.ground_steps as ground_steps
from mimopilot.sitl.field.workflow import SETS
from mimopilot.sitl.mavlink.wire.parameter_files import read_parameters
from tests.sitl.field.faults import check_set, mend
from tests.sitl.field.field_vehicle import HOLD, LANDING, TAKEOFF

OLD, NEW = SETS["old"], SETS["new"]


def test_an_autotune_from_the_ground_to_the_ground_keeps_the_new_gains(scripted):
    field = scripted(page=True)
    old = dict(field.vehicle.set)
    assert field.run() == ""
    check_set(field, "", old)
    assert field.vehicle.set != old
    assert field.vehicle.stored_values == field.vehicle.values
    assert not field.vehicle.armed
    folder = field.options.folder
    names = {"flight.ulg", "check.ulg", "new.gains.toml", "before.params", "decisions.json", "report.html"}
    assert {path.name for path in folder.iterdir()} == names
    numbers = {"MIMO_FW_ID": field.vehicle.values["MIMO_FW_ID"], "MIMO_SET_ID": 0.0}
    assert read_parameters(folder / "before.params") == old | numbers
    assert field.vehicle.values["MIMO_SET_ID"] == numbers["MIMO_FW_ID"]  # else the new gains would not fly
    found = json.loads((folder / "decisions.json").read_text())
    assert (found["result"], found["new_values_may_be_on_the_vehicle"]) == ("kept", False)
    assert [question.split()[0] for question in field.user.asked] == ["Arm", "Upload", "Arm", "Keep"]
    page = (folder / "report.html").read_text()
    assert all(f'id="{part}"' in page for part in ("check-flight", "setpoint-and-response", "stability-and-margins"))
    before = (folder / "decisions.json").read_bytes(), (folder / "report.html").read_bytes()
    assert field.run() == ""  # nothing is left to do
    assert ((folder / "decisions.json").read_bytes(), (folder / "report.html").read_bytes()) == before


def test_a_pilot_takes_off_and_lands_when_he_is_told(scripted):
    field = scripted(pilot=True)
    vehicle = field.vehicle

    def fly():
        vehicle.armed, vehicle.mode, vehicle.target, vehicle.content = True, TAKEOFF, 3.0, ""

    field.user.obeys = {
        "land and disarm": lambda: setattr(vehicle, "mode", LANDING),
        "check flight: take off": fly,
    }
    vehicle.armed, vehicle.mode, vehicle.landed, vehicle.height = True, HOLD, 2, 3.0
    assert field.run() == ""
    assert [question.split()[0] for question in field.user.asked] == ["Excite", "Upload", "Keep"]
    assert not vehicle.set.items() <= read_parameters(field.options.folder / "before.params").items()


@pytest.mark.parametrize(
    ("answers", "reason", "flights"),
    [
        ({"Upload": False}, "the new gains were not wanted", 1),
        ({"Keep": False}, "the answer was no", 2),
        ({"Keep": None}, "no answer in 120 s", 2),
    ],
)
def test_without_the_users_yes_the_old_gains_stay_or_go_back(scripted, answers, reason, flights):
    field = scripted(answers=answers)
    old = dict(field.vehicle.set)
    message = field.run()
    assert reason in message
    assert OLD in message
    assert field.vehicle.set == old
    assert field.vehicle.stored_values == field.vehicle.values
    assert len(field.vehicle.logs.files) == flights
    again = field.run()
    assert "ended with the old gains" in again
    assert reason in again


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"stuck": 0.7}, "it tilted by 40 degrees"),
        ({"rotation": 9.0}, "it turned at 9.0 rad/s"),
        ({"stuck": math.nan}, "it tilted by inf degrees"),
        ({"detuned": 0.0001}, "the check flight is worse than predicted"),
    ],
)
def test_a_check_flight_that_trips_or_is_worse_than_predicted_takes_the_old_gains_back(scripted, changes, reason):
    field = scripted()
    old = dict(field.vehicle.set)
    field.user.obeys = {"check flight: taking off": lambda: [setattr(field.vehicle, *item) for item in changes.items()]}
    message = field.run()
    assert reason in message
    assert OLD in message
    assert field.vehicle.set == old
    assert not field.vehicle.armed
    mend(field)
    assert "ended with the old gains" in field.run()
    assert field.vehicle.set == old


def test_a_trip_is_remembered_when_the_old_gains_cannot_be_written(scripted):
    field = scripted()
    old = dict(field.vehicle.set)
    field.user.obeys = {
        "check flight: taking off": lambda: setattr(field.vehicle, "stuck", 0.7),
        "it tilted": lambda: setattr(field.link, "up", False),
    }
    message = field.run()
    assert SETS["unknown"] in message
    assert "mimopilot restore" in message
    assert field.vehicle.set != old
    mend(field)
    field.user.obeys = {}
    message = field.run()
    assert "it tilted" in message
    assert OLD in message
    assert field.vehicle.set == old
    assert len(field.vehicle.logs.files) == 2  # it has not flown again


def test_our_module_on_px4_hands_over_to_the_stock_controllers_when_the_check_flight_trips(scripted):
    field = scripted(autopilot=12)
    vehicle = field.vehicle
    vehicle.values |= {"MIMO_EN": 1.0, "SDLOG_PROFILE": 49.0}
    old = dict(vehicle.set)
    field.user.obeys = {"check flight: taking off": lambda: setattr(vehicle, "stuck", 0.7)}
    message = field.run()
    assert "it tilted" in message
    assert any(vehicle.handed_over)
    assert vehicle.values["MIMO_EN"] == 1.0
    assert vehicle.set == old


def test_ctrl_c_while_tuning_goes_on_from_there(scripted, monkeypatch):
    field = scripted()
    old = dict(field.vehicle.set)
    tune = ground_steps.tune

    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(ground_steps, "tune", interrupted)
    message = field.run()
    assert message.startswith("interrupted; ")
    assert OLD in message
    assert field.vehicle.set == old
    monkeypatch.setattr(ground_steps, "tune", tune)
    assert field.run() == ""
    assert len(field.vehicle.logs.files) == 2


class Killed(BaseException):
    """The program ends at once, without any of its endings."""


@pytest.mark.parametrize("failure", [OSError("no space"), ValueError()])
def test_a_page_that_cannot_be_made_decides_nothing_about_the_gains(scripted, monkeypatch, failure):
    field = scripted()
    old = dict(field.vehicle.set)

    def fail(*_):
        raise failure

    monkeypatch.setattr(ground_steps, "write_autotune_report", fail)
    assert field.run() == ""
    assert field.vehicle.set != old
    assert json.loads((field.options.folder / "decisions.json").read_text())["result"] == "kept"
    assert f"no report: {failure or 'ValueError'}" in [text for text in field.user.told if isinstance(text, str)]


@pytest.mark.parametrize("writes", [1, 12])
def test_after_a_kill_in_the_middle_of_the_upload_the_next_run_restores_and_goes_on(scripted, writes):
    field = scripted()
    old = dict(field.vehicle.set)
    store, counted = field.vehicle.store, []

    def kill(name, value):
        if name in old:
            counted.append(name)
            if len(counted) > writes:
                raise Killed
        return store(name, value)

    field.vehicle.store = kill
    with pytest.raises(Killed):
        field.run()
    assert field.vehicle.set != old
    field.vehicle.store = store
    assert field.run() == ""
    check_set(field, "", old)
    assert ("writing the old gains back" in field.user.told) == (len(counted) > 1)
