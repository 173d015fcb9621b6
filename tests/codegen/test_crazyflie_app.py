"""The emitted Crazyflie app: its conversions one by one, its modes, and which set of parameters flies."""

import math
from dataclasses import asdict, replace
from operator import attrgetter
from pathlib import Path

import numpy as np
import pytest

from mimopilot.codegen.errors import CodegenError
from mimopilot.codegen.layout import INPUT
from mimopilot.codegen.native import NativeController, load_native
from mimopilot.codegen.render import render
from mimopilot.codegen.targets import TEMPLATES, find_target
from mimopilot.codegen.toolchain import CORTEX_M4_FLAGS, cross_tool, run_tool
from mimopilot.tuning.crazyflie_names import (
    GROUP,
    LOG_VARIABLES,
    NAME_LENGTH,
    STATE,
    ControllerState,
    crazyflie_name,
    crazyflie_parameters,
)
from mimopilot.tuning.parameter_row import Parameter
from mimopilot.tuning.parameters import PARAMETERS
from mimopilot.tuning.spec import load_spec
from tests.codegen.crazyflie_host import Host, compile_all, crazyflie_gains, emit
from tests.codegen.golden_files import check_golden
from tests.conftest import coupled_gains

GAINS = crazyflie_gains()
#: Bytes of code, constants and data of the app, the core included.
LARGEST = 12_000
#: Bytes of one function's stack. The firmware's stabilizer task has 1,800 for all.
LARGEST_STACK = 256
DEGREE = math.pi / 180
ANGLES, SETPOINTS = ("roll", "pitch", "yaw"), ("rollSp", "pitchSp", "yawSp")
RATES, RATE_SETPOINTS = ("p", "q", "r"), ("pSp", "qSp", "rSp")
TORQUES, EXCITATION = ("uR", "uP", "uY"), ("ubR", "ubP", "ubY")


@pytest.fixture(scope="session")
def built(tmp_path_factory):
    return Host(GAINS, tmp_path_factory.mktemp("crazyflie"))


@pytest.fixture
def host(built):
    built.take_off()
    return built


def logged(host, names):
    return [host.log(name) for name in names]


def turn(q, axis, degrees):
    """Set a quaternion of the firmware to a turn about one of its axes: x forward, y left, z up."""
    q.x = q.y = q.z = 0.0
    setattr(q, axis, math.sin(degrees * DEGREE / 2))
    q.w = math.cos(degrees * DEGREE / 2)


# The conversions, each against a case computed by hand.


@pytest.mark.parametrize(("axis", "expected"), [("x", (1, 0, 0)), ("y", (0, -1, 0)), ("z", (0, 0, -1))])
def test_a_gyro_rate_of_180_degrees_a_second_is_pi_with_left_and_up_turned_over(host, axis, expected):
    setattr(host.sensors.gyro, axis, 180.0)
    host.run()
    assert logged(host, RATES) == pytest.approx([math.pi * sign for sign in expected])


@pytest.mark.parametrize(("axis", "expected"), [("x", (30, 0, 0)), ("y", (0, -30, 0)), ("z", (0, 0, -30))])
def test_a_measured_turn_to_the_right_nose_down_or_left_is_roll_minus_pitch_or_minus_yaw(host, axis, expected):
    turn(host.state.attitudeQuaternion, axis, 30.0)
    host.run()
    assert logged(host, ANGLES) == pytest.approx([degrees * DEGREE for degrees in expected], abs=1e-6)


@pytest.mark.parametrize(("name", "expected"), [("roll", (10, 0, 0)), ("pitch", (0, 10, 0)), ("yaw", (0, 0, -10))])
def test_an_attitude_setpoint_in_the_firmwares_older_frame_has_the_nose_up_and_yaw_to_the_left(host, name, expected):
    host.setpoint.mode.yaw = 1
    setattr(host.setpoint.attitude, name, 10.0)
    host.run()
    assert logged(host, SETPOINTS) == pytest.approx([degrees * DEGREE for degrees in expected], abs=1e-6)


@pytest.mark.parametrize(("axis", "expected"), [("x", (10, 0, 0)), ("y", (0, -10, 0)), ("z", (0, 0, -10))])
def test_a_quaternion_setpoint_is_in_the_newer_frame_without_the_inverted_pitch(host, axis, expected):
    host.setpoint.mode.roll = host.setpoint.mode.pitch = host.setpoint.mode.yaw = 0
    host.setpoint.mode.quat = 1
    turn(host.setpoint.attitudeQuaternion, axis, 10.0)
    host.run()
    assert logged(host, SETPOINTS) == pytest.approx([degrees * DEGREE for degrees in expected], abs=1e-6)


def test_the_supervisors_level_out_after_a_full_state_setpoint_is_level(host):
    """The supervisor then sets the modes of roll, pitch and yaw, and leaves that of the quaternion as it was."""
    mode = host.setpoint.mode
    mode.x = mode.y = mode.z = mode.quat = 1
    mode.roll = mode.pitch = mode.yaw = 0
    turn(host.setpoint.attitudeQuaternion, "x", 25.0)
    host.run()
    mode.x = mode.y = 0
    mode.roll, mode.pitch, mode.yaw = 1, 1, 2
    host.run()
    assert logged(host, SETPOINTS[:2]) == [0, 0]


@pytest.mark.parametrize(("name", "expected"), [("roll", (1, 0, 0)), ("pitch", (0, 1, 0)), ("yaw", (0, 0, -1))])
def test_rate_setpoints_are_in_the_older_frame_and_flown_without_the_attitude(host, name, expected):
    host.setpoint.mode.roll = host.setpoint.mode.pitch = 2
    setattr(host.setpoint.attitudeRate, name, 90.0)
    turn(host.state.attitudeQuaternion, "x", 40.0)
    host.run()
    assert logged(host, RATE_SETPOINTS) == pytest.approx([math.pi / 2 * sign for sign in expected])


def test_while_rates_are_flown_the_log_has_no_attitude_setpoint(host):
    host.setpoint.attitude.roll = 20.0
    host.run()
    assert host.log("rollSp") == pytest.approx(20 * DEGREE, rel=1e-5)
    host.setpoint.mode.roll = host.setpoint.mode.pitch = 2
    host.run()
    assert all(math.isnan(one) for one in logged(host, SETPOINTS)) and host.log("rSp") == 0


def test_thrust_of_a_quarter_is_a_quarter_of_what_the_motors_can_in_newton(host):
    host.setpoint.thrust = 65535 / 4
    assert host.run().thrustSi == pytest.approx(0.125)  # 4 motors of 0.125 N
    host.setpoint.thrust = 1e9
    assert host.run().thrustSi == pytest.approx(0.5)
    host.setpoint.thrust = math.nan
    assert host.run().thrustSi == 0


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_torque_is_in_newton_metres_x_forward_y_left_z_up_and_damps(host, axis):
    setattr(host.sensors.gyro, "xyz"[axis], 20.0)
    host.run()
    u = logged(host, TORQUES)
    signs = (1, -1, -1)
    assert host.torque == pytest.approx([u[i] * GAINS.moment_scale[i] * signs[i] for i in range(3)])
    assert host.control.controlMode == 1  # force and torque
    assert host.torque[axis] < 0  # against the rate, in the firmware's own axes


def test_the_measured_attitude_and_the_same_one_as_setpoint_in_the_older_frame_give_no_torque(host):
    turn(host.state.attitudeQuaternion, "y", -20.0)  # the nose is up
    host.setpoint.attitude.pitch = 20.0
    host.run()
    assert host.torque == pytest.approx([0, 0, 0], abs=1e-7)


# What flies.


def test_a_random_flight_gives_the_same_bits_as_the_native_library(host):
    host.setpoint.mode.roll = host.setpoint.mode.pitch = host.setpoint.mode.yaw = 2
    rng = np.random.default_rng(3)
    inputs, got = np.zeros(300, INPUT), []
    inputs["armed"] = inputs["rate_mode"] = 1
    host.start(EN=1.0)
    host.setpoint.mode.roll = host.setpoint.mode.pitch = host.setpoint.mode.yaw = 2
    host.setpoint.thrust = 32767.5
    for row in inputs:
        gyro, wanted = rng.normal(size=(2, 3)).astype(np.float32) * np.float32(2)
        for name, value in zip("xyz", gyro, strict=True):
            setattr(host.sensors.gyro, name, value)
        for name, value in zip(ANGLES, wanted, strict=True):
            setattr(host.setpoint.attitudeRate, name, value)
        row["rates"] = np.float32(0.017453293) * gyro * np.float32([1, -1, -1])
        row["rates_setpoint"] = np.float32(0.017453293) * wanted * np.float32([1, 1, -1])
        row["attitude"][0] = 1
        host.run()
        assert host.log("saturated") == 0
        got.append(logged(host, TORQUES))
    expected = NativeController(load_native(coupled_gains()), GAINS).run(inputs)["moment"]
    assert np.asarray(got, np.float32).tobytes() == expected.tobytes()
    assert np.abs(expected).max(axis=0).min() > 0.01


def test_it_runs_at_500_hz_and_holds_torque_and_thrust_between(host):
    host.sensors.gyro.x = 20.0
    first = host.run(1).torqueX
    host.sensors.gyro.x = 40.0
    assert host.run(1).torqueX == first
    assert host.run(1).torqueX != first


def test_position_modes_fly_the_stock_position_controllers_attitude_and_thrust(host):
    mode, firmware = host.setpoint.mode, host.firmware
    mode.roll = mode.pitch = 0
    mode.x = mode.y = mode.z = 1
    firmware.thrust, firmware.desired.roll, firmware.desired.pitch = 13107.0, -5.0, 8.0
    resets, calls = firmware.position_resets, firmware.position_calls
    host.run(50)
    assert firmware.position_calls - calls == 5 and firmware.position_resets == resets + 1
    assert logged(host, SETPOINTS[:2]) == pytest.approx([-5 * DEGREE, 8 * DEGREE])
    assert host.control.thrustSi == pytest.approx(0.1)
    mode.z = 0  # the height by hand
    host.run()
    assert host.control.thrustSi == pytest.approx(0.25)


def test_a_yaw_rate_turns_the_heading_to_hold_from_the_measured_one_on(host):
    host.setpoint.thrust = 0.0
    turn(host.state.attitudeQuaternion, "z", 170.0)
    host.run(2)
    host.setpoint.thrust = 32767.5
    host.setpoint.attitudeRate.yaw = 50.0
    host.run(400)
    assert host.log("yawSp") == pytest.approx(-(170 + 20 - 360) * DEGREE, abs=1e-4)


@pytest.mark.parametrize("mode", [1, 2])
def test_a_single_yaw_setpoint_that_is_no_number_does_not_stay_in_the_heading(host, mode):
    host.setpoint.mode.yaw = mode
    host.setpoint.attitude.yaw = host.setpoint.attitudeRate.yaw = math.nan
    host.run(2)
    host.setpoint.mode.yaw = 2
    host.setpoint.attitudeRate.yaw = 0.0
    host.run(200)
    assert host.log("yawSp") == 0 and host.log("fault") == 0


def test_thrust_0_gives_no_torque_and_empties_the_integrators(host):
    host.sensors.gyro.x = 5.0
    host.run(400)
    wound = host.log("uR")
    host.setpoint.thrust = 0.0
    resets = host.firmware.position_resets
    control = host.run(2)
    assert (control.thrustSi, *host.torque) == (0, 0, 0, 0) and host.firmware.position_resets == resets + 1
    host.setpoint.thrust = 32767.5
    host.run(2)
    first = host.log("uR")
    assert first != wound
    host.take_off()
    host.sensors.gyro.x = 5.0
    host.run(60)
    host.setpoint.thrust = 0.0
    host.run(60)
    host.setpoint.thrust = 32767.5
    host.run(2)
    assert host.log("uR") == first


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_torque_that_the_motors_cannot_give_is_noticed_and_does_not_wind_up(host, axis):
    name = TORQUES[axis]
    host.setpoint.thrust = 655.35  # 5 mN
    setattr(host.sensors.gyro, "xyz"[axis], 60.0)
    host.run(100)
    held = host.log(name)
    host.run(200)
    assert int(host.log("saturated")) & 1 << axis and host.log(name) == pytest.approx(held, abs=1e-6)
    host.setpoint.thrust = 32767.5
    host.run(2)
    assert not int(host.log("saturated")) & 1 << axis
    host.run(20)
    assert abs(host.log(name)) > abs(held) + 0.001


@pytest.mark.parametrize("turned", [1, -1])
def test_torque_that_idling_motors_cannot_give_is_noticed_in_both_directions(host, turned):
    # Each motor gives 12.5 mN. Of a roll torque t it gives t / 4 / (0.05 m sin 45 degrees) less or more.
    lever = 4 * 0.05 * math.sqrt(0.5)
    idle, hover = 0.05 * 0.125, 0.0125
    for least in (0, 3277):  # 0.05 of 65535
        host.take_off()
        host.firmware.idle_thrust = least
        host.setpoint.thrust = 6553.5
        host.sensors.gyro.x = turned * 45.0
        host.run(60)
        first = host.torque[0]
        host.run(100)
        assert first * turned < 0 and lever * (hover - idle) < abs(first) < lever * hover
        assert int(host.log("saturated")) & 1 == (least > 0)
        # The integrator goes on unless the torque is not given.
        assert (host.torque[0] == pytest.approx(first, rel=1e-3)) == (least > 0)


# Which set of parameters flies.


def state(host):
    assert host.parameters[STATE.split(".")[1]][1][0] == host.log("state")
    return ControllerState(int(host.log("state")))


def torque_against_a_roll_rate(host):
    """Normalised torque 60 ms after the rate has set in: the derivative has gone, the integral is small."""
    host.sensors.gyro.x = 10.0
    host.run(60)
    return host.log("uR")


def test_the_firmwares_pid_flies_while_the_controller_is_off(host):
    host.start()
    host.setpoint.thrust = 32767.5
    control = host.run(20)
    assert state(host) is ControllerState.STOCK and host.firmware.pid_calls == 20 and control.controlMode == 0


def test_a_set_written_while_it_flies_is_taken_as_a_whole_only_by_switching_it_off_and_on_on_the_ground(host):
    before = torque_against_a_roll_rate(host)
    host.write(RP_RR=0.3, SET_ID=host.defaults["FW_ID"])
    assert (host.run(), state(host))[1] is ControllerState.CHANGED
    host.write(EN=0.0)
    assert (host.run(), state(host))[1] is ControllerState.WAITING and host.firmware.pid_calls == 0
    host.write(EN=1.0)
    assert (host.run(), state(host))[1] is ControllerState.WAITING
    assert torque_against_a_roll_rate(host) == pytest.approx(before, rel=0.2)
    host.setpoint.thrust = 0.0
    host.firmware.flying = False
    assert (host.run(), state(host))[1] is ControllerState.FLIES
    host.setpoint.thrust = 32767.5
    host.firmware.flying = True
    assert torque_against_a_roll_rate(host) == pytest.approx(2 * before, rel=0.2)


@pytest.mark.parametrize(("bad", "place"), [({"UMAX_Y": 1.5}, "MIMO_UMAX_Y"), ({"AP_RR": math.nan}, "MIMO_AP_RR")])
def test_a_refused_set_keeps_the_old_gains_and_tells_which_parameter(host, bad, place):
    before = torque_against_a_roll_rate(host)
    host.take_off(**bad, RP_RR=0.3)
    assert torque_against_a_roll_rate(host) == before and state(host) is ControllerState.REFUSED
    assert [one.name for one in PARAMETERS][int(host.log("refused")) - 1] == place


def test_a_stored_set_flies_from_the_start(host):
    before = torque_against_a_roll_rate(host)
    host.take_off(RP_RR=0.3)
    assert (
        torque_against_a_roll_rate(host) == pytest.approx(2 * before, rel=0.2) and state(host) is ControllerState.FLIES
    )


def test_parameters_stored_for_another_firmware_do_not_fly_and_the_console_says_why(host):
    number = host.defaults["FW_ID"]
    for stored in (0.0, number + 1):
        host.take_off(RP_RR=0.3, SET_ID=stored)
        assert state(host) is ControllerState.OTHER_FIRMWARE and host.firmware.pid_calls == 4
        assert host.console == f"mimo.SET_ID is not {number:.0f}: stored for another firmware, stock PID flies\n"
    host.write(SET_ID=number)  # does not count in the air
    assert (host.run(), state(host))[1] is ControllerState.OTHER_FIRMWARE
    host.firmware.flying = False
    host.write(EN=0.0)
    assert (host.run(), state(host))[1] is ControllerState.STOCK
    host.write(EN=1.0)
    assert (host.run(), state(host))[1] is ControllerState.FLIES and not host.console


def test_the_gains_of_the_firmware_fly_whatever_was_stored_with_others(host):
    host.take_off(SET_ID=1.0)
    assert state(host) is ControllerState.FLIES


def test_a_set_that_flew_is_followed_by_the_stock_pid_if_the_next_is_for_another_firmware(host):
    host.firmware.flying = False
    host.write(EN=0.0)
    host.run()
    host.write(EN=1.0, RP_RR=0.3)
    assert (host.run(), state(host))[1] is ControllerState.OTHER_FIRMWARE and host.control.controlMode == 0


def test_gains_for_another_period_are_refused_without_any_torque(built, tmp_path):
    host = Host(GAINS, tmp_path, attitude_rate=250, like=built)
    assert not host.lib.controllerOutOfTreeTest()
    host.take_off()
    assert state(host) is ControllerState.WRONG_PERIOD and host.firmware.pid_calls == 0
    assert (host.control.thrustSi, *host.torque) == (0, 0, 0, 0)


def test_the_controllers_test_passes_with_that_of_the_stock_pid_which_may_fly(host):
    assert host.lib.controllerOutOfTreeTest() and host.firmware.pid_inits == 1
    host.firmware.pid_passes = False
    assert not host.lib.controllerOutOfTreeTest()


def test_gains_for_another_rate_are_emitted_with_a_warning_and_those_without_a_unit_of_torque_refused():
    target = find_target("crazyflie")
    assert target.rate_warning(GAINS) == "" and "--rate 500" in target.rate_warning(crazyflie_gains(0.004))
    assert render(crazyflie_gains(0.004), "crazyflie")
    with pytest.raises(CodegenError, match="moment_scale: the gains have none"):
        render(replace(GAINS, moment_scale=None), "crazyflie")


# The excitation.

SHORT = {"EX_HMIN": 3.0, "EX_HMAX": 9.0, "EX_DUR": 0.2, "EX_AMP": 0.05, "EX_AMPY": 0.04}


def flown(host, samples):
    """Excitation and phase of each period, (N, 4)."""
    rows = []
    for _ in range(samples):
        host.run(2)
        rows.append(logged(host, (*EXCITATION, "phase")))
    return np.array(rows)


def test_the_excitation_goes_through_the_axes_and_adds_to_the_torque(host):
    host.take_off(**SHORT)
    host.write(EX_AX=5.0)
    host.run(2)
    assert host.log("uR") == host.log("ubR") and host.torque[0] == pytest.approx(
        host.log("ubR") * GAINS.moment_scale[0]
    )
    rows = np.vstack([[*logged(host, EXCITATION), 0], flown(host, 1300)])
    phases = [0] * 100 + [2] * 500 + [1] * 100 + [2] * 500 + [3] * 100 + [-1]
    assert rows[:, 3].tolist() == phases
    for axis, (start, amplitude, longer) in enumerate([(0, 0.05, 1), (600, 0.05, 1), (1200, 0.04, 2)]):
        column = rows[start : start + 100, axis]
        assert np.abs(column) == pytest.approx(amplitude) and np.count_nonzero(rows[:, axis]) == 100
        pulses = np.diff(np.flatnonzero(np.diff(column)))
        assert 3 * longer <= pulses.min() < pulses.max() <= 9 * longer
    assert host.log("end") == 1  # finished


def move(name, value):
    def act(host):
        path, _, last = name.rpartition(".")
        setattr(attrgetter(path)(host), last, value)

    return act


STOPS = {
    "a setpoint that moves": (move("setpoint.attitude.pitch", 4.0), 5),
    "thrust that changes": (move("setpoint.thrust", 45000.0), 5),
    "another mode": (move("setpoint.mode.z", 2), 3),
    "the ground": (move("firmware.flying", False), 3),
    "thrust 0": (move("setpoint.thrust", 0.0), 3),
    "a tilt": (lambda host: turn(host.state.attitudeQuaternion, "x", 31.0), 4),
    "the parameter": (lambda host: host.write(EX_AX=0.0), 2),
}


@pytest.mark.parametrize("case", STOPS)
def test_the_excitation_stops_at(host, case):
    act, end = STOPS[case]
    host.write(EX_AX=1.0)
    assert flown(host, 3)[-1, 3] == 0
    act(host)
    assert flown(host, 1)[-1].tolist() == [0, 0, 0, -1] and host.log("end") == end


@pytest.mark.parametrize("case", ["on the ground", "with a setting out of range", "stored from an earlier flight"])
def test_no_excitation_when_asked(host, case):
    if case == "stored from an earlier flight":
        host.take_off(EX_AX=1.0)
    elif case == "on the ground":
        host.setpoint.thrust = 0.0
        host.run(2)
        host.write(EX_AX=1.0)
        host.run(2)
        host.setpoint.thrust = 32767.5
    else:
        host.write(EX_AMP=0.9, EX_AX=1.0)
    assert (flown(host, 5)[:, 3] == -1).all()


# The files.


def test_parameters_and_log_variables_are_those_of_the_table(built):
    built.start()
    names = [*(crazyflie_name(one.name) for one in crazyflie_parameters()), STATE]
    assert [f"{GROUP}.{name}" for name in built.parameters] == names
    assert (
        built.ffi.string(built.lib.param_group()).decode() == GROUP == built.ffi.string(built.lib.log_group()).decode()
    )
    assert list(built.logged) == [one.name for one in LOG_VARIABLES]
    assert max(len(f"{GROUP}.{name}") for name in (*built.parameters, *built.logged)) <= NAME_LENGTH
    read_only, persistent = 1 << 6, 1 << 8
    fixed = {
        crazyflie_name(one.name) for one in crazyflie_parameters() if isinstance(one, Parameter) and not one.writable
    }
    for name, (kind, _) in built.parameters.items():
        expected = read_only if f"{GROUP}.{name}" in {*fixed, STATE} else persistent
        assert kind & (read_only | persistent) == expected, name
    values = GAINS.elements()
    assert [built.defaults[one.code] for one in PARAMETERS] == [np.float32(values[one.code]) for one in PARAMETERS]
    assert [built.defaults[f"SCALE_{axis}"] for axis in "RPY"] == [np.float32(one) for one in GAINS.moment_scale]


def test_the_app_compiles_for_the_crazyflies_processor_and_is_small(tmp_path, record_property):
    sources, includes = emit(GAINS, tmp_path)
    flags = [*CORTEX_M4_FLAGS, "-Os", "-fno-math-errno", "-ffunction-sections", "-fstack-usage", *includes]
    objects = compile_all((cross_tool("gcc"), cross_tool("g++")), sources, flags, tmp_path)
    lines = run_tool([cross_tool("size"), *objects]).splitlines()[1:]
    sizes = {Path(line.split()[-1]).stem: sum(map(int, line.split()[:2])) for line in lines}
    record_property("bytes", sizes)
    assert sum(sizes.values()) <= LARGEST, sizes
    stacks = {
        line.split("\t")[0]: int(line.split("\t")[1])
        for o in objects
        for line in o.with_suffix(".su").read_text().splitlines()
    }
    assert max(stacks.values()) <= LARGEST_STACK, stacks


def test_the_emitted_specification_holds_what_a_log_of_the_built_in_gains_lacks(tmp_path):
    (tmp_path / "flown.spec.toml").write_text(render(GAINS, "crazyflie")["crazyflie/flown.spec.toml"])
    spec = load_spec(tmp_path / "flown.spec.toml")
    assert spec.yaw is not None and spec.limits is not None
    assert (spec.moment_scale, spec.derivative_cutoff_hz) == (GAINS.moment_scale, GAINS.filters.derivative_cutoff_hz)
    assert spec.yaw.model_dump() == asdict(GAINS.yaw) and spec.limits.model_dump() == asdict(GAINS.limits)


def test_the_rendered_files_match_the_golden_files(request):
    files = {name: text for name, text in render(GAINS, "crazyflie").items() if (TEMPLATES / f"{name}.jinja").is_file()}
    files = {name: text for name, text in files.items() if name.startswith("crazyflie/")}
    check_golden("crazyflie", files, request.config.getoption("--update-golden"))
