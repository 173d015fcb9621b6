"""Model following in the compiled C++: off it costs no bit; on it starts, follows and restarts as described."""

import dataclasses
import hashlib
import random

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mimopilot.codegen.layout import INPUT, to_array
from mimopilot.codegen.native import NativeController, load_native
from mimopilot.codegen.vectors import random_inputs
from mimopilot.tuning.controller import Controller
from mimopilot.tuning.errors import TuningError
from mimopilot.tuning.gains import Limits
from mimopilot.tuning.parameters import PARAMETERS
from tests.conftest import coupled_gains, following_gains

TS = 0.004
HOLD = 25
#: Hash of the outputs of `fly_recording` with the controller as it was before model following.
RECORDED = "5f37b919ee0b238d6d1aa4dc9527f28f84039fabae408f556c0840b46b24dcde"


@pytest.fixture(scope="module")
def library():
    return load_native(coupled_gains())


def armed_inputs(rows=1, **values):
    """Armed rows of zeros with the given fields."""
    inputs = np.zeros(rows, INPUT)
    inputs["armed"] = 1
    for name, value in values.items():
        inputs[name] = value
    return inputs


def model_of(controller):
    """Angle, rate and acceleration of the attitude model, (3, 2)."""
    return np.array([controller.state["model"][0][name] for name in ("angle", "rate", "acceleration")])


def inputs_of_the_recording(rows):
    """Inputs that depend on no version of NumPy; they include runs of invalid values."""
    draw = random.Random(2).random
    inputs = np.zeros(rows, INPUT)
    sizes = {"attitude_setpoint": 0.5, "attitude": 0.3, "rates": 0.3, "excitation": 0.1}
    for name, size in sizes.items():
        inputs[name] = [[size * (2 * draw() - 1) for _ in range(3)] for _ in range(rows)]
    inputs["saturation"] = [[int(3 * draw()) - 1 for _ in range(3)] for _ in range(rows)]
    inputs["armed"] = [draw() > 0.02 for _ in range(rows)]
    inputs["landed"] = [draw() < 0.05 for _ in range(rows)]
    for name in sizes:
        for value in (np.nan, np.inf, 1e38, -0.0, 1e-42):
            inputs[name][int(rows * draw()), int(3 * draw())] = value
        start = int((rows - 40) * draw())
        inputs[name][start : start + 40, int(3 * draw())] = np.nan
    return inputs


def fly_recording(library, gains):
    """Hash of the outputs of 4000 periods with four gain changes, and the share of saturated torques."""
    changes = ({"RP_RR": 0.2, "AP_PP": 4.0}, {"RI_RR": 0.0, "RI_RP": 0.0, "D_POLE": 0.0}, {"RD_RP": -0.001}, {})
    controller, digest, saturated = NativeController(library, gains), hashlib.sha256(), 0.0
    for block, change in zip(np.split(inputs_of_the_recording(4000), 4), changes, strict=True):
        outputs = controller.run(block)
        digest.update(outputs.tobytes())
        saturated += np.mean(np.abs(outputs["moment"]) >= gains.limits.moment_max) / 4
        gains = gains.with_elements(change)
        assert controller.set_gains(gains)
    return digest.hexdigest(), saturated


def test_without_a_model_every_bit_is_as_it_was_before_model_following(library, gains):
    digest, saturated = fly_recording(library, gains)
    assert digest == RECORDED
    assert 0.02 < saturated < 0.5
    assert fly_recording(library, following_gains())[0] != RECORDED


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
    inputs = armed_inputs(600, attitude=[[0.1, -0.2, 0.0]])
    inputs["attitude_setpoint"][:, :2] = np.repeat(rng.normal(size=(20, 2)) * 0.3, 30, axis=0)
    controller = NativeController(library, gains)
    found = np.array([model_of(controller) for k in range(600) if len(controller.run(inputs[k : k + 1]))])
    start = np.array([0.1, -0.2])
    angle = start + gains.filters.followed.response(inputs["attitude_setpoint"][1:, :2].astype(float) - start)
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
    setpoint = np.zeros((400, 3))
    setpoint[1:200, 0], setpoint[50:, 1] = 0.4, -0.3
    angle = gains.filters.followed.response(setpoint[:, :2])
    controller, flown = Controller(gains, dtype), np.zeros(2)
    for k in range(len(setpoint)):
        out = controller.step(setpoint[k], np.append(angle[k], 0), np.zeros(3))
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
    inputs = armed_inputs(300)
    for name, signal in (("attitude_setpoint", setpoint), ("attitude", angle), ("rates", rate)):
        inputs[name][:, :2] = signal
    moment = NativeController(library, gains).run(inputs)["moment"][:, :2]
    np.testing.assert_allclose(moment, acceleration @ gains.Kaff_i.T, atol=2e-5)
    assert np.abs(moment).max() > 0.04


def test_the_first_sample_starts_at_the_measured_attitude_whatever_the_setpoint(library):
    controller = NativeController(library, following_gains())
    inputs = armed_inputs(2, attitude_setpoint=[[0.5, -0.4, 0.2]], attitude=[[0.3, 0.1, 0.0]])
    first, second = controller.run(inputs)
    assert (first["rates_setpoint"][:2] == 0).all() and (first["moment"][:2] == 0).all()
    assert first["rates_setpoint"][2] == pytest.approx(0.3, rel=1e-6)  # yaw as ever
    # One period later by hand: al = 81 e, w = Ts al, th = y_o + Ts w.
    acceleration = 81.0 * np.array([0.2, -0.5])
    assert model_of(controller)[2] == pytest.approx(acceleration, rel=1e-5)
    rate = TS * acceleration
    gains = following_gains()
    expected = gains.Kp_o @ (TS * rate) + gains.Kff_o @ rate
    assert second["rates_setpoint"][:2] == pytest.approx(expected, rel=1e-4)


def test_while_disarmed_the_model_stays_at_the_measured_attitude_and_arming_starts_it_there(library):
    controller = NativeController(library, following_gains())
    inputs = armed_inputs(60, attitude_setpoint=[[0.4, 0.2, 0.0]])
    controller.run(inputs)
    assert (np.abs(model_of(controller)[0]) > 0.05).all()
    for attitude in (0.1, 0.25, -0.3):
        inputs["attitude"], inputs["armed"] = attitude, 0
        controller.run(inputs[:1])
        assert model_of(controller).tolist() == [[np.float32(attitude)] * 2, [0, 0], [0, 0]]
    inputs["armed"], inputs["attitude"] = 1, 0.2
    out = controller.run(inputs[:1])
    assert (out["rates_setpoint"][0, :2] == 0).all()
    assert model_of(controller)[0].tolist() == [np.float32(0.2)] * 2
    controller.run(inputs[:1])
    assert model_of(controller)[2, 0] == pytest.approx(81.0 * 0.2, rel=1e-5)


def test_on_the_ground_the_model_follows_as_the_setpoint_acts_without_it(library):
    inputs = armed_inputs(40, attitude_setpoint=[[0.2, 0.1, 0.0]])
    flying, landed = (NativeController(library, following_gains()) for _ in range(2))
    flying.run(inputs)
    inputs["landed"] = 1
    landed.run(inputs)
    assert (model_of(flying) == model_of(landed)).all()


@pytest.mark.parametrize("field", ["attitude_setpoint", "attitude", "rates"])
def test_after_a_fault_the_model_starts_at_the_attitude_of_that_moment(library, field):
    controller = NativeController(library, following_gains())
    inputs = armed_inputs(40, attitude_setpoint=[[0.4, 0.2, 0.0]], attitude=[[0.1, 0.1, 0.0]])
    controller.run(inputs)
    before = model_of(controller)
    broken = inputs.copy()
    broken[field][:, 1] = np.nan
    held = controller.run(broken[:HOLD])
    assert not held["fault"].any()
    assert (model_of(controller)[0] > before[0]).all()  # it goes on with the held value
    assert controller.run(broken[:5])["fault"].all()
    inputs["attitude"][:, :2] = [0.15, -0.2]
    out = controller.run(inputs[:1])[0]
    assert out["fault"] == 0
    assert (out["rates_setpoint"][:2] == 0).all()
    np.testing.assert_array_equal(model_of(controller), np.float32([[0.15, -0.2], [0, 0], [0, 0]]))


def test_the_model_goes_on_while_the_rate_setpoint_saturates(library):
    gains = following_gains()
    slow = dataclasses.replace(gains, limits=dataclasses.replace(gains.limits, rate_max=(0.1, 0.1, 0.1)))
    inputs = armed_inputs(200, attitude_setpoint=[[0.5, -0.5, 0.0]])
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
    inputs = armed_inputs(400, attitude_setpoint=[[0.03, -0.02, 0.0]], attitude=[[0.02, -0.03, 0.0]])
    controller = NativeController(library, start())
    before, after = steady(controller, target, inputs)
    assert np.abs(after - before).max() < 3e-4
    # The other integrals had to take over what the attitude error gave.
    assert np.abs(controller.state["integral"][0]).max() > 1e-3
    if target.filters.followed:
        assert model_of(controller).tolist() == [[np.float32(0.02), np.float32(-0.03)], [0, 0], [0, 0]]


def test_a_gain_change_while_the_model_moves_counts_its_terms(library):
    """Compared with the torque of the same period under the old gains."""
    gains = following_gains()
    changed = gains.with_elements(
        {"AF_RR": 0.2, "AF_RP": 0.5, "RA_RR": 0.008, "RA_PP": -0.002, "M_OMEGA": 14.0, "M_DAMP": 0.5, "RP_RR": 0.2}
    )
    inputs = armed_inputs(12, attitude_setpoint=[[0.1, -0.08, 0.0]])
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
