"""What the compiled C++ flies: the slew limit of the setpoint, rate mode, held inputs and silent sources."""

import dataclasses

import numpy as np
import pytest

from mimopilot.codegen.native import NativeController, load_native
from tests.codegen.input_rows import input_rows, quaternion, rotation_of, tilted
from tests.conftest import coupled_gains, following_gains

TS = 0.004
HOLD = 25
LEVEL = (1.0, 0.0, 0.0, 0.0)
SETPOINT_FAULT, ATTITUDE_FAULT, ROLL_FAULT, PITCH_FAULT, YAW_FAULT = 1, 2, 4, 8, 16


@pytest.fixture(scope="module")
def library():
    return load_native(coupled_gains())


def slewing(slew, base=coupled_gains):
    return base().with_elements({"SP_SLEW": slew})


def flown_setpoints(controller, inputs):
    """The attitude setpoint that is flown in each period, (N, 4)."""
    found = []
    for row in np.split(inputs, len(inputs)):
        assert controller.run(row)["fault"] == 0
        found.append(controller.state["attitude_setpoint"][0].copy())
    return np.array(found)


def angles_between(a, b):
    return (rotation_of(a).inv() * rotation_of(b)).magnitude()


@pytest.mark.parametrize("slew", [0.5, 3.0, 25.0])
@pytest.mark.parametrize(
    ("start", "target"),
    [
        ([0.0, 0.0, 0.0], [0.0, 0.0, 3.1]),
        ([0.3, -0.2, 2.0], [0.3, -0.2, 2.002]),
        ([0.3, -0.2, 2.0], [-0.6, 0.9, -2.5]),
        ([-0.2, 0.1, -3.0], [0.4, 0.1, 3.0]),
    ],
)
@pytest.mark.parametrize("sign", [1, -1])
def test_a_step_of_any_size_is_flown_at_the_slew_limit_on_the_great_circle(library, slew, start, target, sign):
    start, target = np.float32(quaternion([start, target])) * np.float32([[1], [sign]])
    whole = angles_between(start, target)
    periods = int(whole / (slew * TS)) + 3
    inputs = input_rows(periods, attitude=start, attitude_setpoint=target)
    controller = NativeController(library, slewing(slew))
    path = flown_setpoints(controller, inputs)
    turned = angles_between(start, path)
    steps = np.diff(turned, prepend=0.0)
    moving = int(np.argmax((path == target).all(axis=1)))
    np.testing.assert_allclose(steps[:moving], slew * TS, rtol=5e-3, atol=1e-6)
    assert 0 < steps[moving] < 1.005 * slew * TS + 1e-6
    # It arrives exactly, stays, and is never off the great circle.
    assert (path[moving:] == target).all()
    np.testing.assert_allclose(turned + angles_between(path, target), whole, atol=5e-4)
    assert moving == pytest.approx(whole / (slew * TS), abs=1 + 5e-3 * moving)


def test_a_setpoint_that_moves_more_slowly_than_the_limit_is_flown_as_given(library):
    angles = np.zeros((300, 3))
    angles[:, 0], angles[:, 2] = 0.9 * TS * np.arange(300), 0.3
    inputs = input_rows(300, attitude=angles[0], attitude_setpoint=angles, rates=[[0.1, 0.2, 0.3]])
    assert (flown_setpoints(NativeController(library, slewing(1.0)), inputs) == inputs["attitude_setpoint"]).all()
    plain, limited = (NativeController(library, gains).run(inputs) for gains in (coupled_gains(), slewing(1.0)))
    assert plain.tobytes() == limited.tobytes()


@pytest.mark.parametrize("before", ["disarmed", "rate mode", "fault"])
def test_the_flown_setpoint_starts_at_the_measured_attitude(library, before):
    """At arming, after rate mode and after a fault: one step from there, wherever it was."""
    slew = 2.0
    controller = NativeController(library, slewing(slew))
    target, attitude = [0.0, 0.0, 2.0], [0.2, -0.1, -0.5]
    inputs = input_rows(100, attitude_setpoint=target)
    path = flown_setpoints(controller, inputs)
    assert angles_between(LEVEL, path[-1]) == pytest.approx(slew * TS * 100, rel=5e-3)
    other = input_rows(30, attitude_setpoint=target, attitude=attitude)
    if before == "disarmed":
        other["armed"] = 0
    elif before == "rate mode":
        other["rate_mode"] = 1
    else:
        other["rates"] = np.nan
    assert bool(controller.run(other)["fault"][-1]) == (before == "fault")
    back = flown_setpoints(controller, input_rows(3, attitude_setpoint=target, attitude=attitude))
    measured = quaternion(attitude)
    assert angles_between(measured, back) == pytest.approx(slew * TS * np.arange(1, 4), rel=5e-3)
    out = NativeController(library, slewing(slew)).run(input_rows(1, attitude_setpoint=target, attitude=attitude))
    assert np.abs(out["rates_setpoint"]).max() < 6 * slew * TS  # the error is of one step


def test_the_attitude_model_follows_the_slewed_setpoint(library):
    controller = NativeController(library, slewing(0.5, following_gains))
    inputs = input_rows(200, attitude_setpoint=tilted([0.5, 0.0]))
    flown_setpoints(controller, inputs)
    # After 0.8 s at 0.5 rad/s; a model of 9 rad/s and damping 0.8 lags a ramp by 2 * 0.8 / 9 s.
    expected = 0.5 * (0.8 - 1.6 / 9)
    assert controller.state["model"][0]["angle"][0] == pytest.approx(2 * np.sin(expected / 2), rel=0.02)
    assert controller.state["model"][0]["rate"][0] == pytest.approx(0.5, rel=0.03)


def test_in_rate_mode_the_given_rates_are_flown_with_the_rate_gains_alone(library):
    gains = coupled_gains()
    rng = np.random.default_rng(1)
    wanted, rates = 20 * rng.uniform(-1, 1, (50, 3)), 0.3 * rng.standard_normal((50, 3))
    wanted[:, 0] *= 0.01
    inputs = input_rows(50, rate_mode=1, rates_setpoint=wanted, rates=rates, yaw_rate_setpoint=2.0)
    out = NativeController(library, gains).run(inputs)
    # Also beyond rate_max, which is 5, 4, 3 rad/s.
    assert (out["rates_setpoint"] == np.float32(wanted)).all()
    assert (np.abs(wanted[:, 1:]).max(axis=0) > [8, 6]).all()
    # The attitude and its setpoint do not matter, valid or not, and no other attitude gain does.
    for name, value in (("attitude", np.nan), ("attitude", quaternion([1.0, 0.5, -2.0])), ("attitude_setpoint", 7.0)):
        other = inputs.copy()
        other[name] = value
        found = NativeController(library, gains).run(other)
        assert (found["moment"] == out["moment"]).all() and not found["fault"].any()
    changes = {"AP_RR": 1.0, "AP_PR": 2.0, "AP_YY": 0.3, "YAW_W": 0.9, "SP_SLEW": 1.0, "RMAX_R": 0.1, "RMAX_P": 0.1}
    other = NativeController(library, gains.with_elements(changes)).run(inputs)
    assert other.tobytes() == out.tobytes()
    # The rate law by hand, in the first period: no derivative yet, and one period of integral.
    error = wanted[0] - rates[0]
    gain = {name: np.zeros((3, 3)) for name in ("Kp_i", "Ki_i", "Kff_i")}
    for name, matrix in gain.items():
        matrix[:2, :2], matrix[2, 2] = getattr(gains, name), getattr(gains.yaw, name)
    v = gain["Kp_i"] @ error + TS * gain["Ki_i"] @ error + gain["Kff_i"] @ wanted[0]
    limit = np.array(gains.limits.moment_max)
    assert out["moment"][0] == pytest.approx(np.clip(v, -limit, limit), rel=1e-5)


@pytest.mark.parametrize("base", [coupled_gains, following_gains])
def test_switching_the_mode_acts_at_once_both_ways_and_keeps_the_integrals(library, base):
    gains = base()
    attitude = {"attitude_setpoint": tilted([0.05, -0.02]), "attitude": tilted([0.03, 0.01])}
    angle = input_rows(50, rates=[[0.02, -0.01, 0.03]], **attitude)
    rate = angle.copy()
    rate["rate_mode"], rate["rates_setpoint"] = 1, [0.3, -0.2, 0.1]
    controller = NativeController(library, gains)
    controller.run(angle)
    integral = controller.state["integral"][0].copy()
    out = controller.run(rate[:1])[0]
    assert (out["rates_setpoint"] == np.float32([0.3, -0.2, 0.1])).all()
    step = np.abs(controller.state["integral"][0] - integral)
    assert (step > 0).all() and (step < TS * 0.5).all()
    controller.run(rate)
    integral = controller.state["integral"][0].copy()
    out = controller.run(angle[:1])[0]
    # As a controller that was never in rate mode: the attitude model starts at the measured attitude.
    assert (out["rates_setpoint"] == NativeController(library, gains).run(angle[:1])[0]["rates_setpoint"]).all()
    step = np.abs(controller.state["integral"][0] - integral)
    assert (step < TS * 0.5).all()


def test_back_from_rate_mode_a_lost_attitude_is_a_fault_at_once_and_a_new_one_is_none(library):
    lost = input_rows(
        60, rate_mode=1, rates_setpoint=[[0.3, -0.2, 0.1]], attitude=(np.nan, 0, 0, 0), rates=[[0.1, 0, 0]]
    )
    for attitude, fault in (((np.nan, 0.0, 0.0, 0.0), ATTITUDE_FAULT), (LEVEL, 0)):
        controller = NativeController(library, coupled_gains())
        assert not controller.run(lost)["fault"].any()
        out = controller.run(input_rows(1, attitude=attitude, attitude_setpoint=[[0.1, 0, 0]], rates=[[0.1, 0, 0]]))[0]
        assert out["fault"] == fault
        assert (out["rates_setpoint"][0] > 0.5) == (fault == 0)


@pytest.mark.parametrize("bad", [np.nan, np.inf, 100.5])
def test_in_rate_mode_an_invalid_rate_setpoint_is_held_and_then_a_fault(library, bad):
    controller = NativeController(library, coupled_gains())
    inputs = input_rows(HOLD + 1, rate_mode=1, rates_setpoint=[[0.3, -0.2, 0.1]], rates=[[0.2, 0, 0]])
    controller.run(inputs)
    inputs["rates_setpoint"][:, 1] = bad
    inputs["rates_setpoint"][:, 0] = 0.7  # a setpoint is taken as a whole
    out = controller.run(inputs)
    assert (out["rates_setpoint"][:HOLD] == np.float32([0.3, -0.2, 0.1])).all()
    assert list(out["fault"]) == [0] * HOLD + [SETPOINT_FAULT]
    assert (out["rates_setpoint"][HOLD] == 0).all()


@pytest.mark.parametrize("field", ["attitude_setpoint", "attitude"])
def test_a_missing_setpoint_or_attitude_holds_the_rate_setpoint(library, field):
    controller = NativeController(library, coupled_gains())
    inputs = input_rows(HOLD, attitude_setpoint=[[0.2, -0.1, 0.3]], yaw_rate_setpoint=0.5)
    held = controller.run(inputs)["rates_setpoint"][-1]
    moving = quaternion(np.linspace([0.0, 0.0, 0.0], [0.3, 0.1, -0.2], HOLD))
    inputs["attitude"], inputs["attitude_setpoint"] = moving, quaternion([0.5, 0.4, 0.0])
    inputs["yaw_rate_setpoint"] = -1.0
    inputs[field] = np.nan
    inputs["rates"][:, 0] = np.linspace(0, 0.2, HOLD)
    out = controller.run(inputs)
    assert (out["rates_setpoint"] == held).all() and not out["fault"].any()
    assert (np.diff(out["moment"][:, 0]) < 0).all()  # the rate controller goes on
    assert (out["fault_count"] == np.arange(1, HOLD + 1)).all()


@pytest.mark.parametrize(("field", "bit"), [("attitude_setpoint", SETPOINT_FAULT), ("attitude", ATTITUDE_FAULT)])
def test_a_quaternion_whose_squared_length_is_off_by_more_than_two_percent_is_invalid(library, field, bit):
    for square, invalid in ((0.9795, True), (0.9805, False), (1.0195, False), (1.0205, True), (0.0, True), (4.0, True)):
        inputs = input_rows(HOLD + 2, attitude_setpoint=[[0.2, -0.1, 0.3]])
        inputs[field] *= np.sqrt(square)
        out = NativeController(library, coupled_gains()).run(inputs)
        # The first sample of a flight has nothing to hold.
        assert list(out["fault"]) == [bit * invalid] * len(inputs), square


@pytest.mark.parametrize("bit", [SETPOINT_FAULT, ATTITUDE_FAULT, ROLL_FAULT, PITCH_FAULT, YAW_FAULT])
def test_a_silent_source_is_a_fault_at_once(library, bit):
    gains = coupled_gains()
    controller = NativeController(library, gains)
    inputs = input_rows(
        50, attitude_setpoint=[[0.1, 0.05, 0.2]], rates=[[0.3, -0.2, 0.1]], excitation=[[0.1, 0.1, 0.1]]
    )
    controller.run(inputs)
    integral = controller.state["integral"].copy()
    inputs["silent"] = bit
    out = controller.run(inputs[:2])
    assert (out["fault"] == bit).all() and list(out["fault_count"]) == [1, 2]
    assert (controller.state["integral"] == integral).all()
    y = np.where([bit == ROLL_FAULT << i for i in range(3)], 0.0, [0.3, -0.2, 0.1])
    d = controller.state["derivative"][0].astype(float)
    expected = -np.append(gains.Kp_i @ y[:2] + gains.Kd_i @ d[:2], gains.yaw.Kp_i * y[2] + gains.yaw.Kd_i * d[2])
    expected[y == 0] = 0
    assert out["moment"][-1] == pytest.approx(expected, abs=1e-6)
    inputs["silent"] = 0
    again = controller.run(inputs[:1])[0]
    assert again["fault"] == 0 and np.abs(again["rates_setpoint"]).max() > 0.2


def test_a_silent_attitude_does_not_matter_in_rate_mode_and_a_silent_setpoint_does(library):
    inputs = input_rows(2, rate_mode=1, rates_setpoint=[[0.3, 0.0, 0.0]])
    for bit, fault in ((ATTITUDE_FAULT, 0), (SETPOINT_FAULT, SETPOINT_FAULT), (ROLL_FAULT, ROLL_FAULT), (32, 0)):
        inputs["silent"] = [0, bit]
        assert list(NativeController(library, coupled_gains()).run(inputs)["fault"]) == [0, fault]


def test_a_yaw_rate_setpoint_of_nan_is_none_and_one_out_of_range_is_counted(library):
    def run(yaw_rate):
        inputs = input_rows(3, attitude_setpoint=[[0.1, 0.05, 0.2]], yaw_rate_setpoint=yaw_rate)
        return NativeController(library, coupled_gains()).run(inputs)

    none = run(0.0)
    assert run(np.nan).tobytes() == none.tobytes()
    for bad in (np.inf, 101.0, -1e38):
        out = run(bad)
        assert (out["rates_setpoint"] == none["rates_setpoint"]).all() and not out["fault"].any()
        assert list(out["fault_count"]) == [1, 2, 3]
    assert run(1.0)["rates_setpoint"][0, 2] == pytest.approx(none["rates_setpoint"][0, 2] + 1.0, rel=1e-6)


def test_a_rate_that_was_missing_for_long_counts_as_zero_for_the_other_axis(library):
    """Pitch keeps its damping; the coupling of roll's rate into it ends."""
    gains = dataclasses.replace(coupled_gains(), Kd_i=np.zeros((2, 2)))
    controller = NativeController(library, gains)
    inputs = input_rows(HOLD + 1, rates=[[2.0, -0.2, 0.1]])
    controller.run(inputs)
    inputs["rates"][:, 0] = np.nan
    out = controller.run(inputs)
    assert (controller.run(inputs[:1])["fault"] == ROLL_FAULT).all()
    assert out["moment"][HOLD] == pytest.approx([0.0, gains.Kp_i[1, 1] * 0.2, -0.5 * 0.1], rel=1e-6)
