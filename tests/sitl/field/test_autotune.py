"""An autotune from beginning to end, and every way that it may end early."""

import json

from mimopilot.sitl.mavlink.wire.parameter_files import read_parameters


def new_set(field):
    return read_gains(field.options.folder / "new.gains.toml")


def read_gains(path):
    from mimopilot.sitl.mavlink.ground_station.profiles import make_plan
    from mimopilot.tuning.gains_file import load_gains

    return make_plan(load_gains(path)).values


def test_an_autotune_from_the_ground_to_the_ground_keeps_the_new_gains(scripted):
    field = scripted()
    old = dict(field.vehicle.set)
    assert field.run() == ""
    assert field.vehicle.set == new_set(field) != old
    assert field.vehicle.stored_values == field.vehicle.values
    assert not field.vehicle.armed
    folder = field.options.folder
    names = {"flight.ulg", "check.ulg", "new.gains.toml", "before.params", "decisions.json", "report.html"}
    assert {path.name for path in folder.iterdir()} == names
    assert read_parameters(folder / "before.params") == old
    found = json.loads((folder / "decisions.json").read_text())
    assert (found["result"], found["new_values_may_be_on_the_vehicle"]) == ("kept", False)
    assert [question.split()[0] for question in field.user.asked] == ["Arm", "Upload", "Arm", "Keep"]
