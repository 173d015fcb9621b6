"""upload and restore with our custom controller in ArduCopter."""

import numpy as np
import pytest
from pymavlink.mavparm import MAVParmDict

from mimopilot.sitl.mavlink.ground_station.profiles import make_plan, make_restore_plan
from mimopilot.sitl.mavlink.wire.parameter_files import read_parameters
from mimopilot.tuning.logs.dataflash_custom import our_name
from mimopilot.tuning.logs.flown_gains import flown_gains
from mimopilot.tuning.parameters import ardupilot_name
from tests.conftest import assert_one_clear_line, stock_gains
from tests.sitl.mavlink.scripted_vehicle import ScriptedVehicle, UdpVehicle

PROFILE = "ardupilot-custom"


class CustomVehicle(ScriptedVehicle):
    """An ArduCopter with our controller: CC_TYPE is a whole number."""

    def __init__(self, old, **others):
        super().__init__({ardupilot_name(name): value for name, value in old.items()} | {"CC_TYPE": 3} | others)
        self.autopilot = 3

    def value(self, name):
        answer = super().value(name)
        return answer._replace(kind=2) if name == "CC_TYPE" else answer


@pytest.fixture
def mimopilot(quick_mimopilot):
    return quick_mimopilot


def upload(mimopilot, certified, vehicle, *extra):
    with UdpVehicle(vehicle) as link:
        return mimopilot("upload", certified, "--connect", link.url, "--yes", "--profile", PROFILE, *extra)


def test_the_parameters_are_those_of_our_module_under_ardupilots_names(gains):
    ours, theirs = make_plan(gains), make_plan(gains, PROFILE)
    assert {our_name(name): value for name, value in theirs.values.items()} == ours.values
    assert theirs.fixed == {"CC3_TS": ours.fixed["MIMO_TS"]}
    assert theirs.scale == ("CC3_SCALE_R", "CC3_SCALE_P", "CC3_SCALE_Y")
    found = flown_gains({our_name(name): value for name, value in theirs.values.items()}, gains.Ts)
    assert found.elements() == pytest.approx(gains.elements(), rel=1e-6)


def test_every_value_is_written_read_back_and_restored(mimopilot, certified, old, new, tmp_path):
    vehicle = CustomVehicle(old)
    done = upload(mimopilot, certified, vehicle)
    assert done.returncode == 0, done.stderr
    assert {our_name(name): v for name, v in vehicle.values.items() if our_name(name) in new} == new
    (snapshot,) = tmp_path.glob("*.before-1.params")
    with UdpVehicle(vehicle) as link:
        back = mimopilot("restore", snapshot, "--connect", link.url, "--yes")
    assert back.returncode == 0, back.stderr
    assert {our_name(name): v for name, v in vehicle.values.items() if name.startswith("CC3_")} == old


@pytest.mark.parametrize(
    ("others", "parts", "code"),
    [
        ({"CC_TYPE": 2}, ("CC_TYPE: the vehicle has 2, expected 3", "reboot"), 2),
        ({"CC3_TS": 0.005}, ("CC3_TS: the vehicle has 0.005, the gains are for 0.004",), 2),
        ({"CC3_SCALE_R": 9.0}, ("9",), 2),
        ({"CC3_RP_RR": 77.0}, ("CC3_RP_RR: the vehicle holds 77, expected 0.0001 to 5",), 2),
    ],
)
def test_another_controller_period_or_unit_of_torque_is_refused(mimopilot, certified, old, others, parts, code):
    vehicle = CustomVehicle(old, **others)
    refused = upload(mimopilot, certified, vehicle)
    assert_one_clear_line(refused, *parts, code=code)
    assert vehicle.writes == 0


def test_an_armed_vehicle_and_firmware_without_custom_controllers_are_refused(mimopilot, certified, old):
    armed = CustomVehicle(old)
    armed.armed = True
    assert_one_clear_line(upload(mimopilot, certified, armed), "armed: nothing was written", code=1)
    plain = CustomVehicle(old)
    plain.values = {"ATC_RAT_RLL_P": 0.135}
    refused = upload(mimopilot, certified, plain, "--timeout", "1")
    assert_one_clear_line(refused, "CC_TYPE", "nothing was written", "mimopilot generate --target ardupilot", code=1)
    assert armed.writes == plain.writes == 0


def test_firmware_that_does_not_say_its_unit_of_torque_needs_it_from_the_user(mimopilot, certified, old):
    """It was generated from gains without a moment scale."""
    vehicle = CustomVehicle({name: value for name, value in old.items() if "SCALE" not in name})
    refused = upload(mimopilot, certified, vehicle, "--timeout", "1")
    parts = ("CC3_SCALE_R: the vehicle does not have it", 'moment_scale "unknown"', "--moment-scale flown")
    assert_one_clear_line(refused, *parts, code=1)
    assert vehicle.writes == 0
    done = upload(mimopilot, certified, vehicle, "--moment-scale", "flown")
    assert done.returncode == 0, done.stderr


def test_a_parameter_file_holds_what_an_upload_writes(mimopilot, certified, gains, old, tmp_path):
    """Read by MAVProxy's own reader, which is pymavlink's; and compared with the vehicle that it was loaded into."""
    arguments = ("params", certified, "--profile", PROFILE)
    for form in ("mavproxy", "missionplanner"):
        assert mimopilot(*arguments, "--format", form, "--out", f"{form}.parm").returncode == 0
        read = MAVParmDict()
        read.load(str(tmp_path / f"{form}.parm"))
        assert {name: np.float32(value) for name, value in read.items()} == make_plan(gains, PROFILE).values
        assert read["CC3_RP_RR"] == pytest.approx(gains.Kp_i[0, 0], rel=1e-7)
        assert read["CC3_AP_PR"] == pytest.approx(gains.Kp_o[1, 0], rel=1e-7)
    text = (tmp_path / "mavproxy.parm").read_text()
    scale = ", ".join(f"CC3_SCALE_{axis} {value:g}" for axis, value in zip("RPY", gains.moment_scale, strict=True))
    assert f"# load only into a vehicle that holds CC_TYPE 3.0, CC3_TS 0.004, {scale}\n" in text
    assert "# then set CC3_SET_ID to what the vehicle has as CC3_FW_ID\n" in text
    vehicle = CustomVehicle(old)
    with UdpVehicle(vehicle) as link:
        differ = mimopilot(*arguments, "--connect", link.url)
        assert differ.returncode == 1 and "CC3_RP_RR" in differ.stdout
        vehicle.values.update(read)
        unbound = mimopilot(*arguments, "--connect", link.url)
        assert_one_clear_line(unbound, "1 of 49 parameters differ", code=1)
        assert "CC3_SET_ID" in unbound.stdout
        vehicle.values["CC3_SET_ID"] = vehicle.values["CC3_FW_ID"]  # as the file's comment says
        assert mimopilot(*arguments, "--connect", link.url).returncode == 0
        again = mimopilot("params", "--profile", PROFILE, "--connect", link.url, "--format", "mavproxy")
    *held, number, stored = again.stdout.splitlines()[1:]
    assert held == [line for line in text.splitlines()[1:] if line[0] != "#"]
    assert [number.split()[0], stored.split()[0]] == ["CC3_FW_ID", "CC3_SET_ID"]
    assert vehicle.writes == 0


@pytest.mark.parametrize("controller", ["px4-stock", "ardupilot-stock"])
def test_a_parameter_file_of_stock_gains_is_for_their_controller(mimopilot, tmp_path, controller):
    stock = stock_gains(controller)
    stock.save(tmp_path / "stock.gains.toml")
    done = mimopilot("params", "stock.gains.toml", "--format", "mavproxy", "--out", "stock.parm", "--uncertified")
    assert done.returncode == 0, done.stderr
    assert read_parameters(tmp_path / "stock.parm") == make_plan(stock, controller).values
    refused = mimopilot("params", "stock.gains.toml", "--profile", "mimo", "--uncertified")
    assert_one_clear_line(refused, f"the gains are for {controller}")
    refused = mimopilot("params", "--connect", "udpin:127.0.0.1:1", "--profile", controller)
    assert_one_clear_line(refused, f"--profile {controller}: expected mimo or ardupilot-custom", "import-params")
    refused = mimopilot("params", "stock.gains.toml", "--format", "px4-yaml", "--profile", controller, "--uncertified")
    assert_one_clear_line(refused, "--format px4-yaml", "leave out --profile")


def test_its_experiment_is_started_by_hand(mimopilot):
    refused = mimopilot("experiment", "--connect", "tcp:127.0.0.1:1", "--yes", "--profile", PROFILE)
    assert_one_clear_line(refused, "ardupilot-custom: our custom controller's experiment", "set CC3_EX_AX to 5")


def test_half_a_set_is_not_restored(gains):
    from mimopilot.sitl.errors import SitlError

    values = make_plan(gains, PROFILE).values
    plan = make_restore_plan(values | {"CC3_TS": 0.004}, "old.params")
    assert (plan.profile, plan.requires, plan.fixed) == (PROFILE, {"CC_TYPE": 3.0}, {"CC3_TS": 0.004})
    with pytest.raises(SitlError, match="lacks CC3_RP_RP: restore a complete set"):
        make_restore_plan({name: v for name, v in values.items() if name != "CC3_RP_RP"}, "old.params")
