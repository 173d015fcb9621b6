"""Hand-over between the emitted PX4 module and PX4's own controllers, silence, and the arming check, with stubs of PX4.

The host program fails as soon as two modules publish torque (see `drive`).
"""

import numpy as np
import pytest

from mimopilot.codegen.firmware_number import firmware_number
from mimopilot.codegen.native import NativeController, load_native
from tests.codegen.px4_host import drive
from tests.codegen.test_px4_module import AIRBORNE, HOLD_MODE, STEP, STOCK, level_inputs, quaternion, text
from tests.conftest import coupled_gains

#: Of the firmware: parameters with it may differ from the gains compiled in.
NUMBER = firmware_number(coupled_gains())
SECOND = [STEP] * 250
HOLD = 25  # samples that the controller holds an invalid value, and that a topic may be silent
STOPPED = [f"stock {name} stop" for name in reversed(STOCK)]
STARTED = [f"stock {name} start" for name in STOCK]


def lines(result, word):
    return [line for line in result.other if line.startswith(word)]


# Which one flies.


def test_it_stops_both_of_px4s_controllers_and_takes_over_within_two_samples(program):
    result = drive(program, [*AIRBORNE, STEP, STEP, STEP])
    assert result.ticks[1:] == [False, True, True]
    assert lines(result, "stock") == STOPPED


@pytest.mark.parametrize(
    ("interval", "flies"), [(4000, True), (4100, True), (3850, True), (4300, False), (3700, False), (1250, False)]
)
def test_it_flies_only_if_the_gyro_keeps_the_period_of_the_gains(program, interval, flies):
    result = drive(program, [f"gyro_interval {interval}", *AIRBORNE, STEP, STEP, "arming"])
    assert result.exits == [0] and result.ticks[-1] == flies
    assert lines(result, "arming") == [f"arming 3 {int(flies)} {int(not flies)}"]
    assert lines(result, "stock") == (STOPPED if flies else [])
    assert any("gyro rate is not 250 Hz" in line for line in result.log if "MAVLINK" in line) != flies


def test_a_gyro_rate_that_changes_in_the_air_is_told_and_flown(program):
    result = drive(program, [*AIRBORNE, STEP, *SECOND, *["gyro 4300 0 0 0"] * 500, "arming"])
    assert all(result.ticks[2:])
    assert sum("gyro rate is not 250 Hz" in line for line in result.log if "MAVLINK" in line) == 1
    assert lines(result, "arming") == ["arming 3 0 1"]


@pytest.mark.parametrize(
    ("event", "message"),
    [
        ("vehicle 1 1", "no VTOL"),
        ("vehicle 2 0", "multicopters only"),
        ("param MC_AT_EN 1", "MC_AT_EN"),
        ("param MIMO_RP_RR 99", "a gain or MIMO_SET_ID is wrong"),
        ("param MIMO_RP_RR 0.2", "a gain or MIMO_SET_ID is wrong"),
    ],
)
def test_what_it_cannot_fly_fails_the_arming_check(program, event, message):
    result = drive(program, [event, *AIRBORNE, STEP, "arming"])
    assert lines(result, "arming") == ["arming 3 0 1"]
    assert sum(message in line for line in result.log if "MAVLINK" in line) == 1
    assert not lines(result, "stock") and not any(result.ticks)


def test_the_number_of_another_firmware_is_forgotten(program):
    """PX4 does not store what equals a value compiled in, so back in that firmware its set would be a mixture."""
    for number, kept in ((NUMBER - 1, 0), (NUMBER, NUMBER)):
        events = [f"param MIMO_SET_ID {number}", *AIRBORNE, *SECOND, "value MIMO_SET_ID"]
        assert lines(drive(program, events), "value") == [f"value MIMO_SET_ID {kept}"]


@pytest.mark.parametrize("number", [7, 999_999])
def test_what_is_fixed_in_the_firmware_is_shown_whatever_a_parameter_file_has_stored(program, number):
    stored = [f"param MIMO_FW_ID {number}", "param MIMO_TS 0.001", "param MIMO_SCALE_Y 9", "param MIMO_EX_AMPY 0.11"]
    names = ("MIMO_FW_ID", "MIMO_TS", "MIMO_SCALE_Y", "MIMO_EX_AMPY")
    result = drive(program, [*stored, *AIRBORNE, *SECOND, *(f"value {name}" for name in names), "arming"])
    shown = {name: np.float32(value) for _, name, value in map(str.split, lines(result, "value"))}
    gains = coupled_gains()
    expected = (NUMBER, gains.filters.Ts, gains.moment_scale[2], 0.11)
    assert shown == dict(zip(names, map(np.float32, expected), strict=True))
    assert lines(result, "arming") == ["arming 3 1 0"]


def test_if_it_is_not_wanted_it_hinders_no_arming(program):
    result = drive(program, ["param MIMO_EN 0", "vehicle 1 1", *AIRBORNE, *SECOND, "arming"])
    assert lines(result, "arming") == ["arming 3 1 0"]
    assert not lines(result, "stock") and not any(result.ticks)


def test_mimo_en_changes_the_controllers_in_the_air_both_ways(program):
    off, on = ["param MIMO_EN 0", *SECOND], ["param MIMO_EN 1", *SECOND]
    result = drive(program, [*AIRBORNE, STEP, *SECOND, *off, *SECOND, *on, *SECOND])
    assert lines(result, "stock") == [*STOPPED, *STARTED, *STOPPED]
    change = np.flatnonzero(np.diff(np.array(result.ticks[1:], int)))
    assert len(change) == 3  # ours, stock, ours
    assert result.ticks[-1]


@pytest.mark.parametrize("channel", [1, 6])
def test_a_switch_changes_the_controllers(program, channel):
    def switch(value):
        return "sticks 1 0 0 0 0 " + " ".join(str(value) if i == channel else "0" for i in range(1, 7))

    on, off = [switch(1), *[STEP] * 5], [switch(-1), *[STEP] * 5]
    lost = ["sticks 0 0 0 0 0 0 0 0 0 0 0", *[STEP] * 5]
    result = drive(program, [f"param MIMO_EN {channel + 1}", *AIRBORNE, *off, *on, *off, *on, *lost])
    assert lines(result, "stock") == [*STOPPED, *STARTED, *STOPPED]
    # Each takes two samples after PX4's controllers have stopped; a lost switch changes nothing.
    assert "".join(".X"[tick] for tick in result.ticks[1:]) == "....." + "..XXX" + "....." + "..XXX" + "XXXXX"


@pytest.mark.parametrize("value", [-1, 8, 99])
def test_a_value_of_mimo_en_without_meaning_changes_nothing(program, value):
    result = drive(program, [*AIRBORNE, STEP, *SECOND, f"param MIMO_EN {value}", "sticks 1 0 0 0 0", *SECOND, *SECOND])
    assert lines(result, "stock") == (STOPPED if value > 0 else [*STOPPED, *STARTED])


def test_a_change_ends_the_excitation(program):
    excited = ["param MIMO_EX_DUR 10", "param MIMO_EX_AX 3", *SECOND, *SECOND]
    back = ["param MIMO_EN 0", *SECOND, *SECOND, "param MIMO_EN 1", *SECOND, *SECOND, "status"]
    result = drive(program, [*AIRBORNE, STEP, *SECOND, *excited, *back])
    x = result.out["excitation"][:, 0]
    change = int(np.flatnonzero(np.diff(np.array(result.ticks[1:], int)) < 0)[0])
    assert x[change - 1] != 0 and not x[change:].any()
    assert any("on the ground or disarmed" in line or "stop: mode" in line for line in result.log)
    assert lines(result, "excitation ended") == ["excitation ended 0 0 -1"]


def test_stop_in_the_air_hands_back(program):
    result = drive(program, [*AIRBORNE, STEP, STEP, "stop", STEP, STEP])
    assert lines(result, "stock") == [*STOPPED, *STARTED]
    assert result.ticks[-2:] == [False, False]


@pytest.mark.parametrize(("mode", "ahead"), [("mode 1 1 0 1 15", True), ("mode 1 1 0 0 10", False)])
def test_by_sticks_the_attitude_controller_starts_ahead_because_it_ramps_its_thrust(program, mode, ahead):
    flight = [*AIRBORNE, mode, "sticks 1 0 0 0 0", STEP, *SECOND]
    result = drive(program, [*flight, "param MIMO_EN 0", *SECOND, *[STEP] * 700])
    assert lines(result, "stock") == [*STOPPED, *(reversed(STARTED) if ahead else STARTED)]
    flown = len(result.out) - 250
    assert flown - (550 if ahead else 0) <= 250
    assert (flown >= 550) == ahead and not result.ticks[-1]


def test_a_change_of_mind_stops_the_attitude_controller_again(program):
    flight = [*AIRBORNE, "mode 1 1 0 1 15", "sticks 1 0 0 0 0", STEP, *SECOND]
    result = drive(
        program, [*flight, "param MIMO_EN 0", *SECOND, "param MIMO_EN 1", *SECOND, *SECOND, *SECOND, *SECOND]
    )
    assert lines(result, "stock") == [*STOPPED, STARTED[1], *STOPPED]
    assert all(result.ticks[2:])


def test_from_stock_the_torque_does_not_jump_and_what_is_missing_fades(program):
    gains = coupled_gains()
    elements = [f"param MIMO_{code} {text(value)}" for code, value in gains.elements().items() if code != "TS"]
    stock, integral = np.float32([0.05, -0.04, 0.02]), np.float32([0.03, -0.06, 0.01])
    tilted = f"attitude {text(*quaternion(0.03, -0.02, 0.1))} 0 1 0 0 0"
    turning = [f"gyro 4000 {text(0.1, 0.05, -0.05)}"] * 400
    start = [*elements, "param MC_YAW_TQ_CUTOFF 0", "param MIMO_EN 0", f"stock {text(*stock, *integral)}"]
    out = drive(program, [*start, *AIRBORNE, tilted, *turning, "param MIMO_EN 1", *turning]).out
    inputs = level_inputs(400, armed=0, attitude=out["attitude"][0], rates=[0.1, 0.05, -0.05])
    own = NativeController(load_native(gains), gains).run(inputs)["moment"][-1]
    missing = stock - integral - own
    assert np.abs(missing).max() > 0.05
    # One period of Ki e is added already.
    np.testing.assert_allclose(out["torque"][0], stock, atol=1e-3)
    np.testing.assert_allclose(out["integral"][0], integral, atol=1e-3)
    faded = out["torque"] - out["integral"] - own
    k = np.arange(100)
    np.testing.assert_allclose(faded[:100], missing * (1 - 0.004 / 0.1) ** k[:, None], atol=2e-6)


def test_an_integrator_without_gain_starts_at_zero(program):
    none = [f"param MIMO_SET_ID {NUMBER}", *(f"param MIMO_RI_{element} 0" for element in ("RR", "RP", "PR", "PP"))]
    out = drive(program, [*none, f"stock {text(0.05, 0.05, 0.05, 0.2, 0.2, 0.2)}", *AIRBORNE, STEP, STEP]).out
    assert (out["integral"][0, :2] == 0).all() and out["integral"][0, 2] == np.float32(0.2)
    np.testing.assert_allclose(out["torque"][0, :2], 0.05, atol=1e-6)


# Silence.


@pytest.mark.parametrize("source", ["attitude", "setpoint"])
def test_a_silent_source_counts_as_invalid_and_then_as_a_fault(program, source):
    tilted = f"setpoint {text(*quaternion(0.2, 0, 0), 0, 0, 0, -0.5)}"
    result = drive(program, [*AIRBORNE, tilted, STEP, STEP, STEP, f"mute {source} 1", *[STEP] * 400])
    rates = result.out["rates"][:, 0]
    flown = int(np.argmax(rates == 0)) - 2  # since the source has stopped
    assert (rates[: flown + 2] > 1).all() and (rates[flown + 2 :] == 0).all()
    assert flown == HOLD
    # After half a second of that it hands back, and says so.
    assert abs(len(result.out) - (flown + 2 + 125)) <= 1
    assert lines(result, "stock") == [*STOPPED, *STARTED]
    assert any("invalid inputs, handed back" in line for line in result.log if "MAVLINK" in line)


def test_a_frozen_attitude_does_not_wind_up(program):
    tilted = f"setpoint {text(*quaternion(0.2, 0, 0), 0, 0, 0, -0.5)}"
    out = drive(program, [*AIRBORNE, tilted, STEP, STEP, "mute attitude 1", *[STEP] * 170]).out
    assert (np.diff(out["integral"][HOLD + 5 :, 0]) == 0).all()


def test_after_a_fault_it_flies_again_only_when_asked(program):
    fault = ["mute attitude 1", *[STEP] * 300, "mute attitude 0", *SECOND]
    asked = ["param MIMO_EN 0", *SECOND, *SECOND, "param MIMO_EN 1", *SECOND, *SECOND]
    result = drive(program, [*AIRBORNE, STEP, *SECOND, *fault, *asked])
    assert lines(result, "stock") == [*STOPPED, *STARTED, *STOPPED]
    assert result.ticks[-1]


def test_without_a_gyro_it_wakes_up_gives_no_torque_and_hands_back(program):
    turning = ["gyro 4000 0.3 0 0"] * 5
    result = drive(program, [*AIRBORNE, STEP, *turning, "wait 1000000"])
    assert 10 <= len(result.out) - 5 <= 18  # each 40 ms
    assert (result.out["torque"][-5:] == 0).all()
    assert lines(result, "stock") == [*STOPPED, *STARTED]


@pytest.mark.parametrize(
    ("mode", "seconds", "flown"), [("offboard", 0.9, True), ("offboard", 1.4, False), ("hold", 0.9, False)]
)
def test_a_slow_off_board_sender_is_legal_until_px4_declares_it_lost(program, mode, seconds, flown):
    tilted = f"setpoint {text(*quaternion(0.2, 0, 0), 0, 0, 0, -0.5)}"
    nav_state = f"mode 1 0 1 1 {14 if mode == 'offboard' else HOLD_MODE} {int(mode == 'offboard')}"
    commands = [*AIRBORNE, nav_state, tilted, STEP, STEP, "mute setpoint 1", *[STEP] * round(seconds * 250)]
    result = drive(program, commands)
    assert (result.ticks[-1] and result.out["rates"][-1, 0] > 1) == flown


def test_sticks_are_legal_until_px4_declares_them_lost(program):
    commands = [*AIRBORNE, "mode 1 1 0 1 15", "sticks 1 0.5 0 0 0", *SECOND, "mute sticks 1"]
    rates = drive(program, [*commands, *[STEP] * 220]).out["rates"][:, 0]
    silent = int(0.5 * 250) + HOLD
    assert (rates[-220 : -220 + silent] > 1).all()
    assert (rates[-220 + silent + 2 :] == 0).all()
