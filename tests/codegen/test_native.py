"""The compiled C++ controller: bit-identical to the Python reference, and the behaviour of each of its rules."""

import dataclasses
import subprocess

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mimopilot.codegen.errors import CodegenError
from mimopilot.codegen.layout import to_array
from mimopilot.codegen.native import NativeController, NativeLibrary, build_native, load_native
from mimopilot.codegen.vectors import random_inputs, reference_outputs
from mimopilot.tuning.controller import Controller
from mimopilot.tuning.gains import Limits
from mimopilot.tuning.parameter_row import Shape
from mimopilot.tuning.parameters import MATRICES, ROWS, YAW_GAINS
from tests.codegen.input_rows import input_rows
from tests.conftest import following_gains

TS = 0.004
HOLD = 25


@pytest.fixture(scope="module")
def library():
    from tests.conftest import gains

    return load_native(gains.__wrapped__())


def random_gains(base, rng):
    """Other gains and filters, of every row of the table that is no limit and no period."""
    elements, changes = base.elements(), {}
    for row in ROWS:
        for code in row.codes:
            if row.shape in (Shape.MATRIX, Shape.YAW):
                value = elements[code]
                changes[code] = float(np.float32(value + rng.normal() * (abs(value) + 0.05) * 0.5))
            elif row.shape is Shape.POLE:
                changes[code] = float(rng.uniform(0.0, 0.95))
    changes["YAW_W"] = float(rng.choice([1.0, 0.4, rng.uniform(0.01, 1.0)]))
    changes["SP_SLEW"] = float(rng.choice([0.0, rng.uniform(0.01, 20.0)]))
    changes["M_DAMP"] = float(rng.uniform(0.1, 2.0))
    changes["M_OMEGA"] = float(rng.choice([0.0, rng.uniform(0.5, 60.0)]))
    if rng.random() < 0.3:
        changes |= {"RI_RR": 0.0, "RI_RP": 0.0}
    if rng.random() < 0.2:
        changes |= {"D_POLE": 0.0}
    return base.with_elements(changes)


def test_ten_thousand_random_periods_with_gain_changes_are_bit_identical(library, gains):
    rng = np.random.default_rng(20)
    inputs = random_inputs(10_000, rng)
    native, reference = NativeController(library, gains), Controller(gains)
    different = saturated = faulty = 0
    for block in np.split(inputs, 40):
        got, expected = native.run(block), reference_outputs(reference, block)
        different += int((got.view(np.uint8) != expected.view(np.uint8)).reshape(len(block), -1).any(axis=1).sum())
        saturated += int((np.abs(expected["moment"]) >= [1.0, 0.9, 0.8]).any(axis=1).sum())
        faulty += int((expected["fault"] != 0).sum())
        assert np.isfinite(got["moment"]).all()
        changed = random_gains(gains, rng)
        assert native.set_gains(changed)
        reference.set_gains(changed)
    assert different == 0
    # The random inputs reached saturation, faults and values that are not finite.
    assert saturated > 200
    assert faulty > 50
    assert sum(np.count_nonzero(~np.isfinite(inputs[name])) for name in ("rates", "attitude")) > 100


@given(seed=st.integers(0, 10_000))
@settings(max_examples=25, deadline=None)
def test_any_gains_and_inputs_are_bit_identical(library, seed):
    from tests.conftest import gains

    rng = np.random.default_rng(seed)
    changed = random_gains(gains.__wrapped__(), rng)
    inputs = random_inputs(300, rng)
    got = NativeController(library, changed).run(inputs)
    expected = reference_outputs(Controller(changed), inputs)
    assert (got.view(np.uint8) == expected.view(np.uint8)).all()


def test_denormal_inputs_are_not_flushed_to_zero(library, gains):
    inputs = input_rows(2, rates=[[1e-40, 0, 0]])
    got = NativeController(library, gains).run(inputs)
    assert 0 < abs(got["moment"][0, 0]) < 1.2e-38


@pytest.mark.parametrize("matrix", list(MATRICES))
@pytest.mark.parametrize("i", [0, 1])
@pytest.mark.parametrize("j", [0, 1])
def test_each_gain_element_changes_only_its_own_output(library, matrix, i, j):
    gains = following_gains()
    # All matrices are diagonal and only axis j has inputs, so element (i, j) may affect only output i.
    base = dataclasses.replace(gains, **{name: np.diag(np.diag(getattr(gains, name))) for name in MATRICES})
    changed = getattr(base, matrix).copy()
    changed[i, j] += 0.0625
    other = dataclasses.replace(base, **{matrix: changed})
    rng = np.random.default_rng(3)
    signals = np.zeros((3, 50, 3))
    signals[:, :, j] = 0.1 * rng.standard_normal((3, 50))
    inputs = input_rows(50, attitude_setpoint=signals[0], attitude=signals[1], rates=signals[2])
    before, after = (NativeController(library, g).run(inputs)["moment"] for g in (base, other))
    changed_outputs = (before != after).any(axis=0)
    assert list(np.flatnonzero(changed_outputs)) == [i]


@pytest.mark.parametrize("name", YAW_GAINS)
def test_each_yaw_gain_changes_only_yaw(library, gains, name):
    other = dataclasses.replace(gains, yaw=dataclasses.replace(gains.yaw, **{name: getattr(gains.yaw, name) + 0.0625}))
    rng = np.random.default_rng(3)
    setpoint, attitude, rates = 0.1 * rng.standard_normal((3, 50, 3))
    inputs = input_rows(50, attitude_setpoint=setpoint, attitude=attitude, rates=rates)
    before, after = (NativeController(library, g).run(inputs)["moment"] for g in (gains, other))
    assert list(np.flatnonzero((before != after).any(axis=0))) == [2]


def test_a_positive_derivative_gain_damps(library, gains):
    only = {name: np.zeros((2, 2)) for name in MATRICES} | {"Kd_i": np.eye(2) * 0.01}
    damping = dataclasses.replace(gains, **only)
    inputs = input_rows(20)
    inputs["rates"][:, 0] = np.arange(20) * 0.01  # accelerating in roll
    assert (NativeController(library, damping).run(inputs)["moment"][1:, 0] < 0).all()


def test_the_first_sample_has_no_derivative(library, gains):
    only = {name: np.zeros((2, 2)) for name in MATRICES} | {"Kd_i": np.eye(2)}
    out = NativeController(library, dataclasses.replace(gains, **only)).run(input_rows(1, rates=[[3.0, -2.0, 1.0]]))
    assert (out["moment"][0, :2] == 0).all()


def test_gain_changes_are_bumpless_within_the_integrator_limit(library, gains):
    inputs = input_rows(40, attitude_setpoint=[[0.02, -0.01, 0.01]], rates=[[0.01, 0.02, -0.01]])
    controller = NativeController(library, gains)
    before = controller.run(inputs)["moment"][-1]
    assert controller.set_gains(
        gains.with_elements({"RP_RR": 0.2, "RP_RP": -0.05, "AP_RR": 4.0, "RI_PP": 0.4, "RP_YY": 0.3})
    )
    after = controller.run(inputs[:1])["moment"][0]
    # Only one period of integration may change the output.
    assert np.abs(after - before).max() < 2e-4
    jumped = NativeController(library, gains.with_elements({"RP_RR": 0.2, "AP_RR": 4.0})).run(inputs)["moment"][-1]
    assert np.abs(jumped - before).max() > 10 * np.abs(after - before).max()


def test_an_axis_without_integral_gain_clears_its_integrator(library, gains):
    controller = NativeController(library, gains)
    controller.run(input_rows(100, attitude_setpoint=[[0.05, 0.05, 0.05]]))
    assert (controller.state["integral"][0] != 0).all()
    assert controller.set_gains(gains.with_elements({"RI_RR": 0.0, "RI_RP": 0.0}))
    assert controller.state["integral"][0, 0] == 0
    assert controller.state["integral"][0, 1] != 0


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 1e38, -1e7])
def test_gains_out_of_range_are_refused_without_effect(library, gains, bad):
    controller = NativeController(library, gains)
    controller.run(input_rows(10, attitude_setpoint=[[0.1, 0.1, 0.1]]))
    before = controller.state.tobytes()
    for index in range(len(to_array(gains))):
        array = to_array(gains)
        array[index] = bad
        assert not controller.set_gains(array)
    assert controller.state.tobytes() == before


def test_initialise_refuses_gains_that_are_not_finite(library, gains):
    array = to_array(gains)
    assert (
        library.lib.mimo_pid_initialise(library.ffi.new("uint8_t[1024]"), library.ffi.from_buffer("float[]", array))
        == 1
    )
    array[0] = np.nan
    assert (
        library.lib.mimo_pid_initialise(library.ffi.new("uint8_t[1024]"), library.ffi.from_buffer("float[]", array))
        == 0
    )


def test_saturation_stops_the_integrator_only_in_its_direction(library, gains):
    only_integral = {name: np.zeros((2, 2)) for name in MATRICES} | {"Kp_o": np.eye(2), "Ki_i": np.eye(2)}
    g = dataclasses.replace(gains, **only_integral, limits=Limits((9, 9, 9), (1, 1, 1), (0.5, 0.5, 0.5)))
    setpoint = input_rows(1, attitude_setpoint=[[1.0, 0, 0]])
    for sign, moves in ((1, False), (-1, True), (0, True)):
        controller = NativeController(library, g)
        setpoint["saturation"][0, 0] = sign
        controller.run(setpoint)
        assert (controller.state["integral"][0, 0] > 0) == moves


def test_the_integrator_does_not_wind_up_while_the_excitation_saturates(library, gains):
    g = gains.with_elements({"UMAX_R": 0.2})
    controller = NativeController(library, g)
    controller.run(input_rows(200, attitude_setpoint=[[0.01, 0, 0]], excitation=[[0.5, 0, 0]]))
    assert controller.state["integral"][0, 0] == 0


def test_disarming_clears_the_integrator_and_landing_holds_it(library, gains):
    controller = NativeController(library, gains)
    controller.run(input_rows(50, attitude_setpoint=[[0.05, 0.02, 0.01]]))
    held = controller.state["integral"].copy()
    controller.run(input_rows(50, attitude_setpoint=[[0.05, 0.02, 0.01]], landed=1))
    assert (controller.state["integral"] == held).all()
    controller.run(input_rows(1, attitude_setpoint=[[0.05, 0.02, 0.01]], armed=0))
    assert (controller.state["integral"] == 0).all()


@pytest.mark.parametrize(("field", "bit"), [("attitude_setpoint", 1), ("attitude", 2), ("rates", 4)])
@pytest.mark.parametrize("bad", [np.nan, np.inf, 1e38, -101.0])
def test_after_25_invalid_samples_the_controller_only_damps_the_rates(library, gains, field, bit, bad):
    controller = NativeController(library, gains)
    normal = input_rows(20, attitude_setpoint=[[0.05, 0.02, 0.0]], attitude=[[0.01, 0, 0]], rates=[[0.3, -0.2, 0.1]])
    controller.run(normal)
    broken = normal[:1].repeat(HOLD + 1)
    broken[field][:, 0] = bad
    out = controller.run(broken)
    assert (out["fault"][:HOLD] == 0).all()
    assert out["fault"][HOLD] == bit
    assert out["fault_count"][HOLD] == HOLD + 1
    integral = controller.state["integral"].copy()
    again = controller.run(broken)
    assert (controller.state["integral"] == integral).all()
    y = np.array([0.3, -0.2, 0.1])
    if field == "rates":
        y[0] = 0
    expected = np.append(-gains.Kp_i @ y[:2], -gains.yaw.Kp_i * y[2])
    if field == "rates":
        expected[0] = 0
        assert again["moment"][-1, 0] == 0
    assert again["moment"][-1] == pytest.approx(expected, abs=1e-6)
    recovered = controller.run(normal)
    assert (recovered["fault"] == 0).all()
    assert np.isfinite(recovered["moment"]).all()


def test_a_recovered_rate_causes_no_derivative_kick(library, gains):
    only = {name: np.zeros((2, 2)) for name in MATRICES} | {"Kd_i": np.eye(2) * 0.1}
    controller = NativeController(library, dataclasses.replace(gains, **only))
    controller.run(input_rows(5))
    lost = input_rows(40, rates=[[np.nan, 0, 0]])
    controller.run(lost)
    assert controller.run(input_rows(1, rates=[[2.0, 0, 0]]))["moment"][0, 0] == 0


def test_an_excitation_that_is_not_finite_is_not_injected(library, gains):
    controller, clean = NativeController(library, gains), NativeController(library, gains)
    extreme = controller.run(input_rows(3, excitation=[[np.nan, np.inf, 7.0]]))
    assert (extreme["moment"] == clean.run(input_rows(3))["moment"]).all()
    # NaN means no excitation; infinity and 7 are faults.
    assert extreme["fault_count"][-1] == 6


def test_yaw_turns_the_shorter_way(library, gains):
    inputs = input_rows(1, attitude_setpoint=[[0, 0, 3.1]], attitude=[[0, 0, -3.1]])
    out = NativeController(library, gains).run(inputs)
    # From -3.1 to 3.1 rad the shorter way is -0.083 rad.
    assert out["rates_setpoint"][0, 2] == pytest.approx(1.5 * (6.2 - 2 * np.pi), rel=1e-4)


def test_the_rate_setpoint_is_limited(library, gains):
    tight = dataclasses.replace(gains, limits=dataclasses.replace(gains.limits, rate_max=(0.5, 0.4, 0.3)))
    out = NativeController(library, tight).run(input_rows(1, attitude_setpoint=[[0.3, -0.3, 0.3]]))
    assert out["rates_setpoint"][0].tolist() == np.float32([0.5, -0.4, 0.3]).tolist()


def test_a_library_with_another_interface_is_refused(gains, tmp_path):
    path = build_native(gains, tmp_path / "a")
    source = tmp_path / "a" / "native" / "mimo_pid_native.cpp"
    text = source.read_text()
    hash_line = next(line for line in text.splitlines() if "mimo_pid_interface_hash" in line)
    source.write_text(text.replace(hash_line, "uint32_t mimo_pid_interface_hash(void) { return 1U; }"))
    other = path.with_name("other.so")
    subprocess.run(
        ["g++", "-shared", "-fPIC", "-o", other, source, tmp_path / "a" / "core" / "mimo_pid.cpp"], check=True
    )
    with pytest.raises(CodegenError, match="another version of the interface"):
        NativeLibrary(other)


def test_the_library_contains_the_gains_it_was_generated_with(gains, library):
    assert (library.default_gains() == to_array(gains)).all()


@pytest.mark.parametrize("cached", [True, False])
def test_a_damaged_library_is_built_again(gains, tmp_path, monkeypatch, cached):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    folder = None if cached else tmp_path / "tree"
    path = build_native(gains, folder)
    whole = path.read_bytes()
    assert NativeLibrary(path).default_gains().tolist() == to_array(gains).tolist()
    middle = len(whole) // 2
    for damaged in (whole[:middle], bytes(len(whole)), whole[:middle] + b"\xff" + whole[middle + 1 :]):
        path.unlink()  # the file of the loaded library must not change
        path.write_bytes(damaged)
        assert build_native(gains, folder) == path
        assert path.read_bytes() == whole
    before = path.stat().st_mtime_ns
    assert build_native(gains, folder) == path
    assert path.stat().st_mtime_ns == before


def test_a_library_of_other_gains_in_its_place_is_built_again(gains, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    other = gains.with_elements({"RP_RR": 0.25})
    mine, foreign = build_native(gains), build_native(other)
    mine.write_bytes(foreign.read_bytes())
    assert load_native(gains).default_gains().tolist() == to_array(gains).tolist()
