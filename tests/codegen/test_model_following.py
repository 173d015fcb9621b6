"""Model following in the compiled C++: off it costs no bit; on it starts, follows and restarts as described."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mimopilot.codegen.layout import to_array
from mimopilot.codegen.native import SOURCES, NativeController, NativeLibrary, load_native
from mimopilot.codegen.render import render, write_tree
from mimopilot.codegen.toolchain import compile_shared, find_compiler
from mimopilot.codegen.vectors import random_inputs
from mimopilot.tuning.controller import Controller
from mimopilot.tuning.errors import TuningError
from mimopilot.tuning.gains import Limits
from mimopilot.tuning.parameters import PARAMETERS
from tests.codegen.input_rows import input_rows, rotation_of, tilted
from tests.conftest import coupled_gains, following_gains

TS = 0.004
HOLD = 25


@pytest.fixture(scope="module")
def library():
    return load_native(coupled_gains())


def model_of(controller):
    """Angle, rate and acceleration of the attitude model, (3, 2)."""
    return np.array([controller.state["model"][0][name] for name in ("angle", "rate", "acceleration")])


def tilt_of(q, heading=0.0):
    """Tilt of an attitude in the axes of a heading, (2,): 2 sin of half its angle, times its axis."""
    east_north = np.cross([0.0, 0.0, 1.0], rotation_of(q).as_matrix()[:, 2])[:2]
    angle = np.arctan2(np.linalg.norm(east_north), rotation_of(q).as_matrix()[2, 2])
    c, s = np.cos(heading), np.sin(heading)
    return np.array([[c, s], [-s, c]]) @ east_north * (2 * np.sin(angle / 2) / np.sin(angle))


@pytest.fixture(scope="module")
def without_model(tmp_path_factory):
    """The controller compiled with model following taken out: the compiler leaves out all of its code."""
    tree = tmp_path_factory.mktemp("plain")
    write_tree(render(coupled_gains(), "native"), tree)
    core, switch = tree / "core/mimo_pid.cpp", "return !within(gains.model_omega, 0.0F);"
    assert core.read_text().count(switch) == 1
    core.write_text(core.read_text().replace(switch, "(void)gains;\n\treturn false;"))
    compile_shared(find_compiler(), [tree / source for source in SOURCES], tree / "plain.so")
    return NativeLibrary(tree / "plain.so")


def fly_changes(library, base):
    """Outputs of 4000 random periods with four gain changes."""
    blocks = np.split(random_inputs(4000, np.random.default_rng(2)), 4)
    changes = ({"RP_RR": 0.2, "AP_PP": 4.0}, {"RI_RR": 0.0, "RI_RP": 0.0, "D_POLE": 0.0}, {"SP_SLEW": 3.0}, {})
    controller, outputs = NativeController(library, base), []
    for block, change in zip(blocks, changes, strict=True):
        outputs.append(controller.run(block))
        assert controller.set_gains(base.with_elements(change))
    return np.concatenate(outputs)


def test_without_a_model_every_bit_is_that_of_a_controller_without_the_code_of_model_following(library, without_model):
    gains = coupled_gains()
    with_code, without = fly_changes(library, gains), fly_changes(without_model, gains)
    assert with_code.tobytes() == without.tobytes()
    saturated = np.mean(np.abs(without["moment"]) >= np.float32(gains.limits.moment_max))
    assert 0.02 < saturated < 0.5
    # The code that was taken out is that of model following.
    assert fly_changes(without_model, following_gains()).tobytes() == without.tobytes()
    assert (fly_changes(library, following_gains()) != without).mean() > 0.3


@given(seed=st.integers(0, 10_000))
@settings(max_examples=30, deadline=None)
def test_while_the_model_is_off_its_gains_and_damping_have_no_effect(library, seed):
    rng = np.random.default_rng(seed)
    blocks = np.split(random_inputs(300, rng), 3)
    plain = to_array(coupled_gains())
    loaded = plain.copy()
    for i, parameter in enumerate(PARAMETERS):
        if parameter.code.startswith(("AF", "RA")):
            loaded[i] = rng.normal() * 10.0 ** rng.integers(-3, 5)
        elif parameter.code == "M_DAMP":
            loaded[i] = rng.uniform(0.1, 2.0)
        elif parameter.code == "M_OMEGA":
            loaded[i] = rng.choice([0.0, -0.0])
    one, other = NativeController(library, coupled_gains()), NativeController(library, coupled_gains())
    assert other.set_gains(loaded)
    for block in blocks:
        assert one.run(block).tobytes() == other.run(block).tobytes()
        assert one.set_gains(plain) and other.set_gains(loaded)


def test_the_state_of_the_model_is_that_of_the_independent_recursion(library):
    """In double precision, for a random setpoint on both axes."""
    gains = following_gains()
    rng = np.random.default_rng(1)
    start = np.array([0.1, -0.2])
    wanted = np.repeat(rng.normal(size=(20, 2)) * 0.3, 30, axis=0)
    inputs = input_rows(600, attitude=tilted(start), attitude_setpoint=tilted(wanted))
    controller = NativeController(library, gains)
    found = np.array([model_of(controller) for k in range(600) if len(controller.run(inputs[k : k + 1]))])
    angle = start + gains.filters.followed.response(wanted[1:] - start)
    np.testing.assert_allclose(found[0], [start, [0, 0], [0, 0]], atol=1e-7)
    np.testing.assert_allclose(found[1:, 0], angle, atol=1e-5)
    rate = np.diff(angle, axis=0, prepend=start[None]) / TS
    np.testing.assert_allclose(found[1:, 1], rate, atol=1e-4)
    np.testing.assert_allclose(found[1:, 2], np.diff(rate, axis=0, prepend=np.zeros((1, 2))) / TS, atol=2e-3)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_with_full_feedforward_a_perfect_rate_loop_turns_the_vehicle_exactly_as_the_model(dtype):
    """With Kff_o = 1, angle = model is the solution of y_o(k) = y_o(k-1) + Ts r_i(k), for any Kp_o."""
    limits = Limits((9, 9, 9), (1, 1, 1), (0.3, 0.3, 0.3))
    gains = dataclasses.replace(following_gains(), Kff_o=np.eye(2), limits=limits)
    setpoint = np.zeros((400, 2))
    setpoint[1:200, 0], setpoint[50:, 1] = 0.4, -0.3
    angle = gains.filters.followed.response(setpoint)
    controller, flown = Controller(gains, dtype), np.zeros(2)
    for k in range(len(setpoint)):
        out = controller.step(tilted(setpoint[k]), tilted(angle[k]), np.zeros(3))
        flown = flown + TS * out.rates_setpoint[:2]
        np.testing.assert_allclose(flown, angle[k], atol=2e-5 if dtype is np.float32 else 1e-12)
    assert np.abs(angle).max(axis=0) == pytest.approx([0.4 * 1.0152, 0.3 * 1.0152], rel=5e-3)  # damping 0.8: 1.5 % over


def test_with_full_feedforward_an_integrating_plant_that_moves_as_the_model_gets_only_its_torque(library):
    """Rates and angles as the model's leave no error: u = Kaff al."""
    none = {name: np.zeros((2, 2)) for name in ("Kd_i", "Kff_i")}
    gains = dataclasses.replace(following_gains(), Kff_o=np.eye(2), **none)
    setpoint = np.zeros((300, 2))
    setpoint[1:] = [0.1, -0.05]
    angle = gains.filters.followed.response(setpoint)
    rate = np.diff(angle, axis=0, prepend=np.zeros((1, 2))) / TS
    acceleration = np.diff(rate, axis=0, prepend=np.zeros((1, 2))) / TS
    inputs = input_rows(300, attitude_setpoint=tilted(setpoint), attitude=tilted(angle))
    inputs["rates"][:, :2] = rate
    moment = NativeController(library, gains).run(inputs)["moment"][:, :2]
    np.testing.assert_allclose(moment, acceleration @ gains.Kaff_i.T, atol=2e-5)
    assert np.abs(moment).max() > 0.04


@pytest.mark.parametrize(("heading", "turn"), [(0.2, 0.0), (0.2, 0.2), (2.5, -1.9), (-2.0, 0.4)])
def test_the_first_sample_starts_at_the_measured_tilt_whatever_the_setpoint(library, heading, turn):
    """The heading of the setpoint is `heading`; that of the measured attitude is `turn` less."""
    controller = NativeController(library, following_gains())
    attitude, setpoint = tilted([0.3, 0.1], heading - turn), tilted([0.5, -0.4], heading)
    first = controller.run(input_rows(2, attitude_setpoint=setpoint, attitude=attitude))[0]
    # The model has the measured direction of body z, so no torque but that of yaw.
    assert first["rates_setpoint"][:2] == pytest.approx([0, 0], abs=2e-6)
    assert first["moment"][:2] == pytest.approx([0, 0], abs=1e-6)
    # Yaw as ever: of the turn, weighted, which the controller interpolates.
    weight = following_gains().filters.yaw_weight
    expected = 1.5 * 2 * np.sin(weight * turn / 2) / weight
    assert first["rates_setpoint"][2] == pytest.approx(expected, rel=0.01 * turn**2, abs=1e-6)
    # One period later by hand, in the axes of the setpoint's heading: al = 81 e, w = Ts al, th = y_o + Ts w.
    start = tilt_of(attitude, heading)
    acceleration = 81.0 * (np.array([0.5, -0.4]) - start)
    rate = TS * acceleration
    expected = np.array([start + TS * rate, rate, acceleration])
    assert model_of(controller) == pytest.approx(expected, rel=1e-5, abs=1e-6)


def test_the_second_sample_flies_the_models_first_step(library):
    """From level: r = Kp_o Ts w + Kff_o w."""
    gains = following_gains()
    setpoint, level = tilted([0.2, -0.5], 0.3), tilted([0.0, 0.0], 0.3)
    second = NativeController(library, gains).run(input_rows(2, attitude_setpoint=setpoint, attitude=level))[1]
    rate = TS * 81.0 * np.array([0.2, -0.5])
    assert second["rates_setpoint"][:2] == pytest.approx(gains.Kp_o @ (TS * rate) + gains.Kff_o @ rate, rel=1e-4)


def test_the_models_rate_and_acceleration_are_turned_by_the_yaw_error(library):
    """Level, at rest, the setpoint 0.8 rad to the right: what is north of the setpoint is north-west of the vehicle."""
    gains = following_gains()
    none = {name: np.zeros((2, 2)) for name in ("Kp_o", "Kp_i", "Ki_i", "Kd_i", "Kff_i")}
    only = dataclasses.replace(gains, **none, Kff_o=np.eye(2), Kaff_i=0.01 * np.eye(2))
    setpoint = tilted([0.05, 0.0], 0.8)
    out = NativeController(library, only).run(input_rows(2, attitude_setpoint=setpoint))[1]
    acceleration = 81.0 * 0.05 * np.array([np.cos(0.8), np.sin(0.8)])
    assert out["rates_setpoint"][:2] == pytest.approx(TS * acceleration, rel=1e-4)
    assert out["moment"][:2] == pytest.approx(0.01 * acceleration, rel=1e-4)


def test_while_disarmed_the_model_stays_at_the_measured_attitude_and_arming_starts_it_there(library):
    controller = NativeController(library, following_gains())
    inputs = input_rows(60, attitude_setpoint=tilted([0.4, 0.2]))
    controller.run(inputs)
    assert (np.abs(model_of(controller)[0]) > 0.05).all()
    for tilt in (0.1, 0.25, -0.3):
        inputs["attitude"], inputs["armed"] = tilted([tilt, tilt], 0.7), 0
        controller.run(inputs[:2])
        assert model_of(controller) == pytest.approx(
            np.array([tilt_of(inputs["attitude"][0]), [0, 0], [0, 0]]), abs=1e-7
        )
    inputs["armed"], inputs["attitude"] = 1, tilted([0.2, 0.2])
    out = controller.run(inputs[:1])
    assert out["rates_setpoint"][0, :2] == pytest.approx([0, 0], abs=2e-6)
    assert model_of(controller)[0] == pytest.approx([0.2, 0.2], abs=1e-7)
    controller.run(inputs[:1])
    assert model_of(controller)[2, 0] == pytest.approx(81.0 * 0.2, rel=1e-5)


def test_on_the_ground_the_model_follows_as_the_setpoint_acts_without_it(library):
    inputs = input_rows(40, attitude_setpoint=[[0.2, 0.1, 0.0]])
    flying, landed = (NativeController(library, following_gains()) for _ in range(2))
    flying.run(inputs)
    inputs["landed"] = 1
    landed.run(inputs)
    assert (model_of(flying) == model_of(landed)).all()


@pytest.mark.parametrize("field", ["attitude_setpoint", "attitude", "rates"])
def test_after_a_fault_the_model_starts_at_the_attitude_of_that_moment(library, field):
    controller = NativeController(library, following_gains())
    inputs = input_rows(40, attitude_setpoint=tilted([0.4, 0.2]), attitude=tilted([0.1, 0.1]))
    flown = controller.run(inputs)
    before = model_of(controller)
    broken = inputs.copy()
    broken[field][:, 1] = np.nan
    held = controller.run(broken[:HOLD])
    assert not held["fault"].any()
    np.testing.assert_array_equal(model_of(controller), before)  # it stands still, as the rate setpoint does
    assert (held["rates_setpoint"] == flown["rates_setpoint"][-1]).all()
    assert controller.run(broken[:5])["fault"].all()
    inputs["attitude"] = tilted([0.15, -0.2])
    out = controller.run(inputs[:1])[0]
    assert out["fault"] == 0
    assert out["rates_setpoint"][:2] == pytest.approx([0, 0], abs=2e-6)
    assert model_of(controller) == pytest.approx(np.array([[0.15, -0.2], [0, 0], [0, 0]]), abs=1e-7)


def test_the_model_goes_on_while_the_rate_setpoint_saturates(library):
    gains = following_gains()
    slow = dataclasses.replace(gains, limits=dataclasses.replace(gains.limits, rate_max=(0.1, 0.1, 0.1)))
    inputs = input_rows(200, attitude_setpoint=[[0.5, -0.5, 0.0]])
    free, limited = NativeController(library, gains), NativeController(library, slow)
    free.run(inputs)
    out = limited.run(inputs)
    assert (np.abs(out["rates_setpoint"][50:, :2]) == np.float32(0.1)).all()
    assert (model_of(free) == model_of(limited)).all()


def steady(controller, changed, inputs):
    """Torque of the period before and after a gain change, with constant inputs."""
    before = controller.run(inputs)["moment"][-1]
    assert controller.set_gains(changed)
    return before, controller.run(inputs[:1])["moment"][0]


@pytest.mark.parametrize("start", [coupled_gains, following_gains])
def test_switching_the_model_is_bumpless(library, start):
    """The torque goes on as with the old gains, within one period of integration."""
    target = following_gains() if start is coupled_gains else coupled_gains()
    inputs = input_rows(400, attitude_setpoint=tilted([0.03, -0.02]), attitude=tilted([0.02, -0.03]))
    controller = NativeController(library, start())
    before, after = steady(controller, target, inputs)
    assert np.abs(after - before).max() < 3e-4
    # The other integrals had to take over what the attitude error gave.
    assert np.abs(controller.state["integral"][0]).max() > 1e-3
    if target.filters.followed:
        assert model_of(controller) == pytest.approx(np.array([[0.02, -0.03], [0, 0], [0, 0]]), abs=1e-7)


def test_a_gain_change_while_the_model_moves_counts_its_terms(library):
    """Compared with the torque of the same period under the old gains."""
    gains = following_gains()
    changed = gains.with_elements(
        {"AF_RR": 0.2, "AF_RP": 0.5, "RA_RR": 0.008, "RA_PP": -0.002, "M_OMEGA": 14.0, "M_DAMP": 0.5, "RP_RR": 0.2}
    )
    inputs = input_rows(12, attitude_setpoint=[[0.1, -0.08, 0.0]])
    old, new, cold = (NativeController(library, gains) for _ in range(3))
    for controller in (old, new):
        controller.run(inputs)
    cold.run(inputs)
    cold.state["gains"][0] = to_array(changed)  # without adjusting the integrals
    assert new.set_gains(changed)
    following, adjusted, jumped = (controller.run(inputs[:1])["moment"][0] for controller in (old, new, cold))
    assert np.abs(adjusted - following).max() < 2e-3
    assert np.abs(jumped - following)[:2].min() > 0.02
    # The model went on from where it was.
    assert model_of(new)[0] == pytest.approx(model_of(old)[0], abs=1e-3)


def test_a_model_that_is_too_fast_for_the_period_or_badly_damped_is_refused_by_the_controller(library):
    controller = NativeController(library, following_gains())
    held = controller.state.tobytes()
    codes = [parameter.code for parameter in PARAMETERS]
    for code, value in (("M_OMEGA", 62.6), ("M_OMEGA", -1.0), ("M_DAMP", 0.09), ("M_DAMP", 2.1), ("M_OMEGA", np.nan)):
        array = to_array(following_gains())
        array[codes.index(code)] = value
        assert not controller.set_gains(array), code
    assert controller.state.tobytes() == held
    fastest = to_array(following_gains())
    fastest[codes.index("M_OMEGA")], fastest[codes.index("M_DAMP")] = 62.5, 2.0
    assert controller.set_gains(fastest)


@given(omega=st.floats(0.01, 2500.0), Ts=st.floats(1e-4, 0.1))
@settings(max_examples=200, deadline=None)
def test_the_gains_and_the_controller_agree_on_the_fastest_model(library, omega, Ts):
    """Also where rounding to single precision decides."""
    for value in (omega, 0.25 / Ts, np.nextafter(0.25 / Ts, 0), np.nextafter(0.25 / Ts, 1e9)):
        array = to_array(following_gains())
        codes = [parameter.code for parameter in PARAMETERS]
        array[codes.index("TS")], array[codes.index("M_OMEGA")] = Ts, value
        filters = dataclasses.replace(following_gains().filters, Ts=Ts, model_omega=float(value))
        try:
            dataclasses.replace(following_gains(), filters=filters)
            valid = True
        except TuningError:
            valid = False
        assert NativeController(library).set_gains(array) == valid
