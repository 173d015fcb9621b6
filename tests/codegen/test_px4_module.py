"""Topics that the emitted PX4 module publishes, for both PX4 interfaces, with stubs of PX4."""

import dataclasses

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import ks_2samp

from mimopilot.codegen.firmware_number import firmware_number
from mimopilot.codegen.layout import INPUT
from mimopilot.codegen.native import NativeController, load_native
from mimopilot.tuning.excitation import prbs
from tests.codegen.px4_host import build, drive
from tests.conftest import coupled_gains, following_gains

HOLD_MODE = 4
LEVEL = "attitude 1 0 0 0 0 1 0 0 0"
START = ["param MC_YAW_TQ_CUTOFF 0", "gyro 0 0 0 0", "start"]
AIRBORNE = [*START, f"mode 1 0 1 1 {HOLD_MODE}", "land 0 0", LEVEL, "setpoint 1 0 0 0 0 0 0 -0.5"]
STEP = "gyro 4000 0 0 0"
STOCK = ("mc_rate_control", "mc_att_control")  # started in this order, stopped in the opposite one


def text(*values):
    """Numbers as text that the host program reads back with the same bits."""
    return " ".join("nan" if np.isnan(v) else float(np.float32(v)).hex() for v in values)


def quaternion(roll, pitch, yaw):
    x, y, z, w = Rotation.from_euler("ZYX", [yaw, pitch, roll]).as_quat()
    return w, x, y, z


def native_outputs(gains, inputs):
    """Outputs of a controller that has run at rest before, as the module does while PX4's own controllers fly."""
    return NativeController(load_native(gains), gains).run(np.concatenate([AT_REST, inputs]))[1:]


def level_inputs(count, **values):
    """Armed rows at the attitude and the setpoint of `AIRBORNE`."""
    inputs = np.zeros(count, INPUT)
    inputs["attitude"][:, 0] = inputs["attitude_setpoint"][:, 0] = inputs["armed"] = 1
    for name, value in values.items():
        inputs[name] = value
    return inputs


#: While PX4's own controllers fly.
AT_REST = level_inputs(1, armed=0)


def assert_same_bits(got, expected):
    assert len(got) == len(expected)
    assert got.tobytes() == np.ascontiguousarray(expected).tobytes()


@pytest.mark.parametrize("flown", [coupled_gains, following_gains])
def test_a_random_flight_gives_the_same_bits_as_the_native_library(program, flown):
    rng, gains = np.random.default_rng(7), flown()
    programmed, elements = coupled_gains().elements(), gains.elements()
    changed = [f"param MIMO_{code} {text(value)}" for code, value in elements.items() if value != programmed[code]]
    changed.append(f"param MIMO_SET_ID {firmware_number(coupled_gains())}")
    commands, rows = [*changed, *AIRBORNE, STEP], []
    row = np.zeros(1, INPUT)[0]
    row["armed"] = 1
    move = wanted_q = None
    for k in range(1500):
        attitude = quaternion(*(rng.normal(size=3) * [0.2, 0.2, 1.0]))
        commands.append(f"attitude {text(*attitude)} 0 1 0 0 0")
        if k % 2 == 0:
            move = rng.choice([np.nan, 0.0, 0.7, -9.0])
            wanted_q = quaternion(*(rng.normal(size=3) * [0.3, 0.3, 2.0])) if rng.random() > 0.05 else (np.nan,) * 4
            commands.append(f"setpoint {text(*wanted_q, move, np.nan, np.nan, -0.4)}")
        if k % 5 == 0:
            missing = rng.choice([-0.1, 0.0, 1e-9, 0.1], 3)
            achieved = rng.random() < 0.3
            commands.append(f"alloc {int(achieved)} {text(*missing)}")
            row["saturation"] = np.where(np.abs(missing) > 1e-7, np.sign(missing), 0) * (not achieved)
        if k % 50 == 0:
            row["armed"] = rng.random() > 0.2
            commands.append(f"mode {row['armed']} 0 1 1 {HOLD_MODE}")
            landed, maybe = rng.choice([0, 0, 1], 2)
            commands.append(f"land {landed} {maybe}")
            row["landed"] = landed or maybe
        row["rates"] = rng.normal(size=3) * 1.5
        commands.append(f"gyro 4000 {text(*row['rates'])}")
        rows.append(row.copy())
    out = drive(program, commands).out
    assert len(out) == 1500
    inputs = np.array(rows, INPUT)
    inputs["attitude"], inputs["attitude_setpoint"] = out["attitude"], out["q_d"]
    inputs["yaw_rate_setpoint"] = out["yaw_rate"][:, 0]
    expected = native_outputs(gains, inputs)
    assert_same_bits(out["torque"], expected["moment"])
    assert_same_bits(out["rates"], expected["rates_setpoint"])
    # Saturation, invalid setpoints and unallocated torque occur.
    assert (np.abs(expected["moment"]) >= [1.0, 0.9, 0.8]).any(axis=1).sum() > 20
    assert np.isnan(out["q_d"]).any(axis=1).sum() > 20
    assert np.isfinite(out["torque"]).all()
    assert len(np.unique(inputs["saturation"], axis=0)) > 20


def test_fields_that_are_nan_leave_the_output_finite(program):
    unset = [
        "setpoint 1 0 0 0 nan nan nan nan",
        "sticks 1 nan nan nan nan",
        "alloc 0 nan nan nan",
    ]
    out = drive(program, [*AIRBORNE, STEP, STEP, *unset, *[STEP] * 50]).out
    assert np.isfinite(out["torque"]).all() and np.isfinite(out["thrust"]).all() and np.isfinite(out["rates"]).all()
    assert (out["thrust"][:, 2] == np.float32(-0.5)).all()


def test_an_invalid_setpoint_is_held_for_25_samples_and_then_only_the_rates_are_damped(program):
    tilted = f"setpoint {text(*quaternion(0.2, 0, 0), 0, 0, 0, -0.5)}"
    lost = "setpoint nan nan nan nan 0 0 0 -0.5"
    out = drive(program, [*AIRBORNE, tilted, STEP, STEP, lost, *[STEP] * 40]).out
    assert (out["rates"][:26, 0] > 1.0).all()
    assert (out["rates"][26:] == 0).all() and (out["torque"][26:] == 0).all()


def test_integrators_are_zero_when_disarmed_and_held_on_the_ground(program, gains):
    turning = ["gyro 4000 0.3 -0.2 0.1"] * 20
    disarmed, armed = f"mode 0 0 1 1 {HOLD_MODE}", f"mode 1 0 1 1 {HOLD_MODE}"
    commands = [*AIRBORNE, STEP]
    for before in ("", "land 1 0", "land 0 0", "land 0 1", "land 0 0", disarmed, armed):
        commands += [*filter(None, [before]), *turning]
    integral = drive(program, commands).out["integral"].reshape(7, 20, 3)
    flying, landed, again, maybe, more, off, on = integral
    for grown in (flying, again, more, on):
        assert (np.abs(np.diff(grown, axis=0)) > 0).all()
    assert (landed == flying[-1]).all()
    assert (maybe == again[-1]).all()
    assert (off == 0).all()
    assert (np.abs(on[-1]) > 0).all()


def test_an_axis_with_unallocated_torque_does_not_wind_up(program):
    turning = ["gyro 4000 -0.3 -0.3 -0.3"] * 10
    integral = drive(program, [*AIRBORNE, STEP, "alloc 0 0.1 0 -0.1", *turning]).out["integral"]
    assert (integral[:, 0] == 0).all()
    assert (np.diff(integral[:, 1:], axis=0) > 0).all()


def test_a_timestamp_that_repeats_or_goes_back_makes_no_step(program):
    odd = ["gyro 0 0.1 0 0", "gyro -4000 0.1 0 0", "gyro 8000 0.1 0 0", "gyro 7000 0.1 0 0", "gyro 1000 0.1 0 0"]
    result = drive(program, [*AIRBORNE, STEP, STEP, *odd, STEP, "status"])
    assert result.ticks[1:] == [False, True, False, False, True, True, True, True]
    # Repeated, back, too long, too short; 8000 us after going back is 4000 us after the last valid one.
    assert any("4 bad sample times" in line for line in result.log)


def test_it_can_be_stopped_and_started_again(program):
    result = drive(program, [*AIRBORNE, STEP, STEP, "stop", STEP, STEP, "status", "start", STEP, STEP])
    assert result.exits == [0, 0, -1, 0]
    assert result.ticks[1:] == [False, True, False, False, False, True]
    assert [line for line in result.other if line.endswith("start")] == [f"stock {name} start" for name in STOCK]


def test_new_gains_take_effect_within_a_second_without_a_jump(program, gains):
    changed = gains.with_elements({"RP_RR": 0.25, "AP_PP": 3.0})
    rates, rng = [], np.random.default_rng(2)
    commands = [*AIRBORNE, STEP]
    for k in range(400):
        if k == 100:
            number = f"param MIMO_SET_ID {firmware_number(gains)}"
            commands += [number, "param MIMO_RP_RR 0.25", "param MIMO_AP_PP 3.0"]
        rates.append(rng.normal(size=3) * 0.05)
        commands.append(f"gyro 4000 {text(*rates[-1])}")
    out = drive(program, commands).out
    inputs = level_inputs(400, rates=rates)
    unchanged = native_outputs(gains, inputs)["moment"]
    change = int(np.flatnonzero((unchanged != out["torque"]).any(axis=1))[0])
    assert 100 <= change <= 350
    controller = NativeController(load_native(gains), gains)
    controller.run(AT_REST)
    before = controller.run(inputs[:change])
    controller.set_gains(changed)
    assert_same_bits(out["torque"], np.concatenate([before, controller.run(inputs[change:])])["moment"])


def test_gains_out_of_range_are_refused_by_name_and_the_old_ones_stay(program, gains):
    wrong = ["param MIMO_RP_RR 99", "param MIMO_RP_PP 0.2"]
    result = drive(program, [*AIRBORNE, STEP, *wrong, *["gyro 4000 0.1 0.1 0.1"] * 300])
    inputs = level_inputs(300, rates=0.1)
    assert_same_bits(result.out["torque"], native_outputs(gains, inputs)["moment"])
    assert any("MIMO_RP_RR is wrong, gains kept" in line for line in result.log)


def test_a_heading_reset_rotates_the_setpoint(program):
    step = quaternion(0, 0, 0.5)
    wanted = f"setpoint {text(*quaternion(0.1, 0, 0), 0, 0, 0, -0.5)}"
    reset = f"attitude {text(*step)} 1 {text(*step)}"
    out = drive(program, [*AIRBORNE, wanted, STEP, STEP, "mute setpoint 1", reset, STEP, STEP]).out
    np.testing.assert_allclose(out["rates"][-1], out["rates"][0], atol=1e-5)
    assert out["rates"][0, 0] > 0.5


def test_a_heading_reset_commands_nothing_while_the_setpoint_slews(program):
    """The vehicle is at its setpoint, nose down; the estimator turns both by 90 degrees."""
    before, after = quaternion(0, -0.35, 0), quaternion(0, -0.35, np.pi / 2)
    step = quaternion(0, 0, np.pi / 2)
    flown = [f"attitude {text(*before)} 0 1 0 0 0", f"setpoint {text(*before, 0, 0, 0, -0.5)}"]
    reset = [f"attitude {text(*after)} 1 {text(*step)}", f"setpoint {text(*after, 0, 0, 0, -0.5)}"]
    slow = [*START, "param MIMO_SP_SLEW 0.5", *AIRBORNE[len(START) :]]
    out = drive(program, [*slow, *flown, *[STEP] * 400, *reset, *[STEP] * 50]).out
    assert np.abs(out["rates"][-60:]).max() < 1e-4
    # Without a reset the same turn of the setpoint is flown.
    turned = drive(program, [*slow, *flown, *[STEP] * 400, reset[1], *[STEP] * 50]).out
    assert np.abs(turned["rates"][-40:, 2]).max() > 0.05


# The excitation.


def excited(program, *events, axis=3, seconds=0.2, mode=HOLD_MODE, steps=600, settings=()):
    """A flight with an excitation requested in the air; events: (sample, command)."""
    setup = [f"param MIMO_EX_DUR {seconds}", "param MIMO_EX_HMIN 2", "param MIMO_EX_HMAX 9", *settings]
    commands = [*START, *setup, *AIRBORNE[len(START) :], f"mode 1 0 1 1 {mode}", *[STEP] * 300]
    commands += [f"param MIMO_EX_AX {axis}"]
    events = dict(events)
    for k in range(steps):
        commands += [*filter(None, [events.get(k)]), STEP]
    return drive(program, [*commands, "status"])


def last_end(result):
    return next(line for line in result.log if line.startswith("INFO excitation") and "last one" in line)


def active(result):
    return (result.out["excitation"][:, :2] != 0).any(axis=1)


def test_the_excitation_runs_once_on_roll_then_pitch_and_is_published(program, gains):
    result = excited(program)
    x, y, code = result.out["excitation"].T
    roll, pitch, pause = (np.flatnonzero(code == value) for value in (0, 1, 2))
    for samples, count in ((roll, 50), (pause, 250), (pitch, 50)):
        assert len(samples) == count
        assert np.ptp(samples) == count - 1
    assert roll[-1] + 1 == pause[0] and pause[-1] + 1 == pitch[0]
    amplitude = np.float32(0.1)
    assert set(np.abs(x[roll])) == {amplitude} and not x[np.setdiff1d(np.arange(len(x)), roll)].any()
    assert set(np.abs(y[pitch])) == {amplitude} and not y[np.setdiff1d(np.arange(len(y)), pitch)].any()
    assert set(code) == {-1, 0, 1, 2}
    assert "finished" in last_end(result)
    # The topic speaks in each sample from the request, within a second before the start, to the first one without.
    told = np.flatnonzero(result.announced)
    first, last = np.searchsorted(told, [roll[0], pitch[-1] + 1])
    assert told[last] - told[first] == last - first == pitch[-1] + 1 - roll[0]
    # A ground station hears fifty times a second that this controller flies without.
    idle = np.concatenate([np.diff(told[told < roll[0] - 250]), np.diff(told[last + 1 :])])
    assert len(idle) > 20 and set(idle) == {5}
    # The core gets the same excitation.
    inputs = level_inputs(len(x), excitation=np.column_stack([x, y, 0 * x]))
    assert_same_bits(result.out["torque"], native_outputs(gains, inputs)["moment"])


def test_yaw_follows_roll_and_pitch_with_its_own_amplitude_longer_pulses_and_name(program, gains):
    result = excited(program, axis=5, seconds=1.0, steps=1600, settings=["param MIMO_EX_AMPY 0.25"])
    x, y, code = result.out["excitation"].T
    stretches = [np.flatnonzero(code == value) for value in (0, 1, 3)]
    roll, pitch, yaw = stretches
    assert [len(stretch) for stretch in stretches] == [250] * 3 and np.count_nonzero(code == 2) == 500
    assert pitch[0] - roll[-1] == yaw[0] - pitch[-1] == 251
    on_yaw = np.array(result.names) == "MIMO_EXY"
    said = np.flatnonzero(on_yaw)
    assert np.array_equal(said[: len(yaw) + 1], np.append(yaw, yaw[-1] + 1))  # and the first sample without
    assert not x[said[len(yaw) :]].any() and set(code[said[len(yaw) :]]) == {-1}
    assert set(np.abs(x[roll])) == {np.float32(0.1)} and set(np.abs(x[yaw])) == {np.float32(0.25)}
    assert x[yaw[-1] + 1] == 0 and code[yaw[-1] + 1] == -1
    short, long = (pulses(np.sign(values)) for values in (x[roll], x[yaw]))
    assert short.min() >= 2 and short.max() <= 9 and long.min() >= 4 and long.max() <= 18 and long.max() > 9
    # The core gets it, and the topic says how far the vehicle has turned: it stands still here.
    injected = np.column_stack([np.where(on_yaw, 0, x), np.where(on_yaw, 0, y), np.where(on_yaw, x, 0)])
    assert_same_bits(result.out["torque"], native_outputs(gains, level_inputs(len(x), excitation=injected))["moment"])
    assert not y[on_yaw].any()


@pytest.mark.parametrize(("rate", "samples"), [(2.1, 0), (-2.1, 0), (1.9, 105), (-1.2, 166)])
def test_yaw_stops_when_it_turns_faster_than_2_rad_s_or_by_more_than_0_8_rad(program, rate, samples):
    setup = ["param MIMO_EX_DUR 10", *AIRBORNE, *[STEP] * 300, "param MIMO_EX_AX 4", *[STEP] * 300]
    result = drive(program, [*setup, *[f"gyro 4000 0 0 {rate}"] * 300, "status"])
    running = np.flatnonzero(result.out["excitation"][:, 2] == 3)
    assert running[-1] - 599 == pytest.approx(samples, abs=1)
    assert abs(result.out["excitation"][running[-1], 1]) == pytest.approx(abs(rate) * 0.004 * samples, abs=0.01)
    assert last_end(result).endswith("stop: turned")


def test_the_parts_of_the_torque_are_published_fifty_times_a_second(program):
    gains = coupled_gains()
    elements = [f"param MIMO_{code} {text(value)}" for code, value in gains.elements().items() if code != "TS"]
    tilted = f"setpoint {text(*quaternion(0.1, -0.2, 0.3), 0, 0, 0, -0.5)}"
    rng = np.random.default_rng(5)
    turning = [f"gyro 4000 {text(*(rng.normal(size=3) * 0.3))}" for _ in range(500)]
    result = drive(program, [*elements, "param MC_YAW_TQ_CUTOFF 0", *AIRBORNE, STEP, tilted, *turning])
    lines = [line.split()[1:] for line in result.other if line.startswith("MIMO_PID")]
    parts = np.array([[int(word, 16) for word in words] for words in lines], np.uint32).view(np.float32)
    parts = parts.reshape(-1, 5, 3)  # proportional, integral, derivative, feed-forward, cross-axis
    assert len(parts) == 100
    torque = result.out["torque"][4::5]
    free = np.abs(torque) < [1.0, 0.9, 0.8]
    free[:80] = False  # what fades after the hand-over is below 1e-7 after 1.6 s
    assert free[80:].mean() > 0.9
    np.testing.assert_allclose(parts.sum(axis=1)[free], torque[free], atol=2e-6)
    np.testing.assert_allclose(parts[:, 1], result.out["integral"][4::5])
    assert (np.abs(parts[:, [0, 1, 2, 4], :2]).max(axis=0) > 1e-3).all() and not parts[:, 4, 2].any()


@pytest.mark.parametrize(("axis", "column"), [(1, 0), (2, 1), (4, 0)])
def test_one_axis_alone_can_be_excited(program, axis, column):
    excitation = excited(program, axis=axis).out["excitation"]
    assert np.count_nonzero(excitation[:, column]) == 50
    assert set(excitation[:, 2]) == {-1.0, {1: 0.0, 2: 1.0, 4: 3.0}[axis]}
    assert not excitation[:, 1 - column].any()


@pytest.mark.parametrize(
    ("event", "reason"),
    [
        ("sticks 1 0.2 0 0 0", "a stick moved"),
        ("sticks 1 0 0 0 -0.2", "a stick moved"),
        (f"attitude {text(*quaternion(0.6, 0, 0))} 0 1 0 0 0", "EX_TILT"),
        (f"attitude {text(*quaternion(0, -0.6, 0))} 0 1 0 0 0", "EX_TILT"),
        (f"mode 0 0 1 1 {HOLD_MODE}", "disarmed"),
        ("mode 1 0 1 1 2", "mode"),
        ("land 0 1", "ground"),
    ],
)
def test_the_excitation_stops_at_once(program, event, reason):
    start = np.flatnonzero(active(excited(program, seconds=10)))[0] - 299  # in samples after the request
    result = excited(program, (start + 100, event), seconds=10)
    running = np.flatnonzero(active(result))
    assert len(running) == 100 and np.ptp(running) == 99
    assert reason in last_end(result)


def test_setting_the_axis_to_zero_stops_the_excitation(program):
    result = excited(program, (300, "param MIMO_EX_AX 0"), seconds=10)
    assert 50 <= np.count_nonzero(active(result)) <= 600 and not active(result)[-1]
    assert "cancelled" in last_end(result)


def test_a_stopped_excitation_does_not_restart(program):
    result = excited(program, (350, "land 1 0"), (360, "land 0 0"), seconds=10, steps=2000)
    assert not active(result)[300 + 351 :].any() and active(result)[300 + 340]


@pytest.mark.parametrize("event", [f"mode 0 0 1 1 {HOLD_MODE}", "mode 1 0 1 1 2", "land 1 0", "land 0 1"])
def test_the_excitation_waits_until_the_vehicle_is_ready(program, event):
    ready = 1000
    back = f"mode 1 0 1 1 {HOLD_MODE}" if event.startswith("mode") else "land 0 0"
    result = excited(program, (0, event), (ready, back), steps=1100)
    assert not active(result)[: 299 + ready].any()
    assert active(result)[299 + ready]


def test_an_axis_set_before_the_start_excites_nothing(program):
    commands = ["param MIMO_EX_AX 3", *AIRBORNE, *[STEP] * 600]
    assert not active(drive(program, commands)).any()


@pytest.mark.parametrize(
    "setting",
    ["MIMO_EX_AMP nan", "MIMO_EX_AMPY 0.6", "MIMO_EX_AMPY nan", "MIMO_EX_AMP 0.9", "MIMO_EX_HMIN 0", "MIMO_EX_HMAX 1"],
)
def test_invalid_excitation_settings_are_refused(program, setting):
    result = excited(program, settings=[f"param {setting}"])
    assert not active(result).any()
    assert "refused" in last_end(result)


def pulses(signs):
    """Lengths of the complete pulses between sign changes."""
    return np.diff(np.flatnonzero(np.diff(signs)))


def test_the_pulses_have_the_distribution_of_tunings_prbs(programs):
    for shortest, longest in ((10, 60), (1, 3), (7, 7)):
        lengths = []
        for seed in range(5):
            (line,) = drive(programs["crtp"], [f"prbs {seed} {shortest} {longest} 20000"]).other
            signs = np.array(line.split()[1:], int)
            assert set(signs) == {-1, 1}
            lengths.append(pulses(signs))
        ours = np.concatenate(lengths)
        theirs = pulses(np.sign(prbs(100_000, 1.0, shortest, longest, np.random.default_rng(0))))
        assert (ours.min(), ours.max()) == (shortest, longest) == (theirs.min(), theirs.max())
        assert ks_2samp(ours, theirs).pvalue > 0.05
    first = [drive(programs["crtp"], [f"prbs {seed} 10 60 1"]).other[0] for seed in range(20)]
    assert set(first) == {"prbs 1", "prbs -1"}


def test_other_gains_use_their_own_values_and_period(gains, tmp_path):
    other = dataclasses.replace(gains, filters=dataclasses.replace(gains.filters, Ts=0.002), moment_scale=None)
    program = build(other, "crtp", tmp_path)
    start = ["gyro_interval 2000", *AIRBORNE, "gyro 2000 0 0 0", *["gyro 2000 0.1 -0.2 0.3"] * 20]
    inputs = level_inputs(20, rates=[0.1, -0.2, 0.3])
    assert_same_bits(drive(program, start).out["torque"], native_outputs(other, inputs)["moment"])
