"""Stock gains read from a vehicle."""

import json

import numpy as np
import pytest

from mimopilot.tuning.gains_file import load_gains
from tests.conftest import assert_one_clear_line
from tests.sitl.mavlink.scripted_vehicle import ScriptedVehicle, UdpVehicle
from tests.tuning.logs.test_imported_gains import ARDUPILOT_VALUES, PX4_VALUES


def test_a_vehicle_is_read_and_others_are_refused(tmp_path, quick_mimopilot):
    vehicle = ScriptedVehicle(PX4_VALUES)
    with UdpVehicle(vehicle) as link:
        done = quick_mimopilot("import-params", "--connect", link.url, "--timeout", "2", "--json")
    assert done.returncode == 0, done.stderr
    gains = load_gains(tmp_path / "vehicle.gains.toml")
    assert gains.Kp_i == pytest.approx(np.diag([0.225, 0.32]))
    assert "not on the vehicle, or not answered: MC_YAW_TQ_CUTOFF" in done.stderr
    assert (vehicle.writes, json.loads(done.stdout)["source"]) == (0, f"PX4, vehicle {link.url}")
    copter = ScriptedVehicle(ARDUPILOT_VALUES | {"ATC_RAT_RLL_NTF": 0.0})
    copter.autopilot, copter.type, copter.fault, copter.faulty = 3, 2, "integer", "ATC_RAT_RLL_NTF"
    with UdpVehicle(copter) as link:
        done = quick_mimopilot("import-params", "--connect", link.url, "--timeout", "2", "--out", "copter.gains.toml")
    assert done.returncode == 0, done.stderr
    lacking = ScriptedVehicle({name: value for name, value in PX4_VALUES.items() if name != "MC_YAW_P"})
    plane = ScriptedVehicle(ARDUPILOT_VALUES)
    plane.autopilot, plane.type = 3, 1
    for one, words in ((lacking, "lacks MC_YAW_P"), (plane, "a plane with ArduPilot")):
        with UdpVehicle(one) as link:
            refused = quick_mimopilot("import-params", "--connect", link.url, "--timeout", "2", "--out", "x.gains.toml")
        assert_one_clear_line(refused, words)
    silent = quick_mimopilot("import-params", "--connect", link.url, "--timeout", "0.5", "--out", "x.gains.toml")
    assert_one_clear_line(silent, "no HEARTBEAT", code=1)
    assert not (tmp_path / "x.gains.toml").exists()
