"""The controller on the emulated Cortex-M4F: bit-identical to the host, and within its budget."""

import dataclasses
import json
import re
import subprocess

import numpy as np
import pytest
import unicorn

from mimopilot.codegen import budget
from mimopilot.codegen.budget import BudgetItem, cycles, different_rows, processor_in_the_loop, stack_bytes, step_costs
from mimopilot.codegen.cortex_m4 import RAM, RAM_SIZE, EmulatedController, build_image, load_emulated, run_in_qemu
from mimopilot.codegen.errors import CodegenError
from mimopilot.codegen.layout import INPUT, to_array
from mimopilot.codegen.native import NativeController, load_native
from mimopilot.codegen.toolchain import CXX_FLAGS
from mimopilot.codegen.vectors import random_inputs
from mimopilot.common.errors import Error
from mimopilot.sitl.physics.airframe import FOLDER
from mimopilot.tuning.gains_file import load_gains
from mimopilot.tuning.parameter_row import Shape
from mimopilot.tuning.parameters import PARAMETERS, rows
from tests.conftest import assert_one_clear_line, following_gains

#: PX4's compiler flags that affect code, and those that the controller requires: -fno-fast-math, after which
#: -fno-math-errno must stand again.
PX4_FLAGS = (
    *("-std=gnu++14", "-Os", "-g", "-fdata-sections", "-ffunction-sections", "-fomit-frame-pointer"),
    *("-funsafe-math-optimizations", "-fno-strict-aliasing", "-fno-math-errno", "-fno-strength-reduce"),
    *("-fvisibility=hidden", "-fno-builtin-printf", "-fcheck-new", "-fno-exceptions", "-fno-rtti"),
    *("-fno-threadsafe-statics", "-Warray-bounds", "-Wcast-align", "-Wfloat-equal", "-Wlogical-op", "-Wpointer-arith"),
    *("-fno-fast-math", "-fno-math-errno"),
)
FLAGS = {
    "O0": (*CXX_FLAGS, "-O0"),
    "O2": CXX_FLAGS,
    "Os": (*CXX_FLAGS, "-Os"),
    "PX4": PX4_FLAGS,
    "PX4 O2": (*PX4_FLAGS, "-O2"),
}
ROWS = 10_000
#: Numbers that are gains; they are the first of the structure.
GAINS = sum(len(row.codes) for row in rows(Shape.MATRIX, Shape.YAW))
WEIGHT, SLEW = ([parameter.code for parameter in PARAMETERS].index(code) for code in ("YAW_W", "SP_SLEW"))


@pytest.fixture(scope="module")
def fixed():
    return following_gains()


@pytest.fixture(scope="module")
def image(fixed, tmp_path_factory):
    return build_image(fixed, tmp_path_factory.mktemp("image"))


@pytest.fixture(scope="module")
def inputs():
    return random_inputs(ROWS, np.random.default_rng(1))


@pytest.mark.parametrize("flags", FLAGS)
def test_both_emulators_are_bit_identical_to_the_host_over_ten_thousand_periods(fixed, inputs, tmp_path, flags):
    image = build_image(fixed, tmp_path, FLAGS[flags])
    expected = NativeController(load_native(fixed), fixed).run(inputs)
    assert different_rows(EmulatedController(image, fixed).run(inputs), expected) == 0
    assert different_rows(run_in_qemu(image, inputs), expected) == 0


def test_an_error_in_the_last_bit_of_a_gain_is_detected(fixed, image, inputs):
    array = to_array(fixed)
    array[4] = np.nextafter(array[4], np.float32(1))
    other = NativeController(load_native(fixed), fixed)
    assert other.set_gains(array)
    assert different_rows(EmulatedController(image, fixed).run(inputs), other.run(inputs)) > ROWS // 10


def test_state_and_outputs_are_bit_identical_after_gain_changes(fixed, image, inputs):
    emulated, native = EmulatedController(image, fixed), NativeController(load_native(fixed), fixed)
    rng = np.random.default_rng(4)
    for block in np.split(inputs[:2000], 40):
        changed = to_array(fixed)
        changed[:GAINS] *= rng.uniform(0.5, 1.5, GAINS).astype(np.float32)
        changed[rng.integers(GAINS)] = 0.0 if rng.random() < 0.7 else np.nan
        changed[-1] = rng.choice([0.0, 9.0, 20.0])  # model_omega
        changed[WEIGHT], changed[SLEW] = rng.uniform(0.1, 1.0), rng.choice([0.0, 2.0])
        assert emulated.set_gains(changed) == native.set_gains(changed)
        assert different_rows(emulated.run(block), native.run(block)) == 0
        assert emulated.state.tobytes() == native.state.tobytes()


def test_gains_and_inputs_of_a_wrong_type_are_refused_by_both_controllers(fixed, image):
    for controller in (EmulatedController(image, fixed), NativeController(load_native(fixed), fixed)):
        with pytest.raises(CodegenError, match="gains: got float64"):
            controller.set_gains(np.zeros(len(to_array(fixed))))
        with pytest.raises(CodegenError, match="inputs: got float32"):
            controller.run(np.zeros(3, np.float32))


def test_initial_gains_out_of_range_are_an_error_on_the_target(fixed, image):
    with pytest.raises(CodegenError, match="refused its gains"):
        EmulatedController(image, fixed.with_elements({"RP_RR": 1e7}))


def with_model(gains):
    """The gains with model following."""
    filters = dataclasses.replace(gains.filters, model_omega=10.0)
    return dataclasses.replace(gains, filters=filters, Kff_o=np.eye(2), Kaff_i=0.006 * np.eye(2))


@pytest.mark.parametrize(
    ("following", "instructions", "share"), [(False, 540, 0.002), (True, 700, 0.0026)], ids=["plain", "following"]
)
@pytest.mark.parametrize("name", ["adam0", "antr"])
def test_the_controllers_of_the_airframes_are_within_budget(name, following, instructions, share):
    gains = load_gains(FOLDER / f"{name}.gains.toml")
    figures = {f.name: f for f in processor_in_the_loop(with_model(gains) if following else gains)}
    assert [f.name for f in figures.values() if not f.passed] == []
    assert figures["rows"].value == ROWS
    limits = {f.name: f.limit for f in figures.values() if f.limit is not None}
    assert limits == {
        "rows_different": 0,
        "instructions_max": instructions,
        "budget_share": share,
        "text_bytes": 3072,
        "data_bytes": 0,
        "bss_bytes": 0,
        "stack_bytes": 128,
        "foreign_symbols": 0,
    }
    assert 200 < figures["instructions_mean"].value <= figures["instructions_max"].value
    assert figures["cycles_lower"].value > figures["instructions_max"].value
    assert figures["period_share"].value == pytest.approx(figures["budget_share"].value * 0.004 / gains.Ts)
    assert figures["budget_share"].value == pytest.approx(figures["cycles_upper"].value / 168e6 / 0.004)


def test_an_unoptimised_controller_exceeds_its_budget(fixed):
    figures = processor_in_the_loop(fixed, 200, flags=FLAGS["O0"])
    over = {f.name for f in figures if not f.passed}
    assert over == {"instructions_max", "budget_share", "text_bytes", "stack_bytes"}


def test_the_traced_blocks_contain_every_executed_instruction(fixed, image, inputs):
    listing = subprocess.run(
        ["arm-none-eabi-objdump", "-d", "--no-show-raw-insn", image.elf], capture_output=True, text=True, check=True
    ).stdout
    code = [(int(a, 16), word) for a, word in re.findall(r"^ *([0-9a-f]+):\t(\S+)", listing, re.MULTILINE)]
    conditional = {
        address
        for k, (_, word) in enumerate(code)
        if re.fullmatch("it[te]*", word)
        for address, _ in code[k + 1 : k + len(word)]
    }
    rows = inputs[:300]
    _, periods = EmulatedController(image, fixed).run_traced(rows)
    counted = step_costs(image, periods)[:, 0]
    single = EmulatedController(image, fixed)
    executed = []
    single._uc.hook_add(unicorn.UC_HOOK_CODE, lambda _uc, address, _size, _data: executed.append(address))
    each = []

    def close_period():
        each.append(executed.copy())
        executed.clear()

    single.run(rows, close_period)
    # The single-step hook omits instructions skipped by a condition, although they take time.
    starts = {address for address, _ in code}
    blocks = [[a for at, n in period for a in range(at, at + n, 2) if a in starts] for period in periods]
    assert [len(addresses) for addresses in blocks] == list(counted)
    for addresses, traced in zip(each, blocks, strict=True):
        assert [a for a in addresses if a not in conditional] == [a for a in traced if a not in conditional]


def test_measured_stack_use_is_within_the_call_graphs_bound(fixed, image, inputs):
    controller = EmulatedController(image, fixed)
    stack = np.frombuffer(controller._memory, np.uint8)[0x1000:]
    stack[:] = 0xA5
    controller.run(inputs[:2000])
    assert controller.set_gains(fixed.with_elements({"RP_RR": 0.2}))
    used = len(stack) - int(np.flatnonzero(stack != 0xA5)[0])
    assert 32 <= used <= stack_bytes(image)
    assert controller._uc.mem_read(RAM + RAM_SIZE - used, 1) != b"\xa5"


@pytest.mark.parametrize(
    ("instruction", "lower", "upper"),
    [
        ("add.w r0, r1, r2", 1, 1),
        ("vadd.f32 s0, s1, s2", 1, 2),
        ("vdiv.f32 s0, s1, s2", 14, 15),
        ("vmla.f32 s0, s1, s2", 3, 4),
        ("vmls.f32 s0, s1, s2", 3, 4),
        ("vldr s1, [r0, #4]", 1, 3),
        ("vstmia ip!, {s15}", 2, 3),
        ("vpush {d8-d9}", 5, 6),
        ("ldmia.w sp!, {r4, r5, pc}", 4, 7),
        ("strd r1, r2, [r0]", 3, 4),
        ("bne.n 800", 1, 4),
        ("bl 800", 2, 4),
        ("bic.w r0, r1, #1", 1, 1),
        ("ittet gt", 0, 1),
        ("vmrs APSR_nzcv, fpscr", 1, 2),
    ],
)
def test_each_instruction_class_has_its_documented_cycles(instruction, lower, upper):
    assert cycles(instruction) == (lower, upper)


def test_pil_prints_one_json_object_with_all_figures(mimopilot):
    for emulator in budget.EMULATORS:
        result = mimopilot("pil", FOLDER / "adam0.gains.toml", "--rows", 500, "--emulator", emulator, "--json")
        assert result.returncode == 0, result.stderr
        found = json.loads(result.stdout)
        assert set(found) >= {
            *("rows", "rows_different", "instructions_mean", "instructions_max", "text_bytes", "data_bytes"),
            *("bss_bytes", "stack_bytes", "budget_share"),
        }
        assert (found["rows"], found["rows_different"], found["emulator"]) == (500, 0, emulator)
    page = mimopilot("pil", FOLDER / "adam0.gains.toml", "--rows", 500).stdout
    assert page.count("pass") == 8
    assert "FAIL" not in page


def test_pil_fails_if_a_figure_exceeds_its_limit(monkeypatch, capsys):
    from mimopilot.cli.codegen import pil

    figures = [BudgetItem("rows_different", "rows that differ", 3, 0), BudgetItem("text_bytes", "code", 3072, 3072)]
    monkeypatch.setattr(budget, "processor_in_the_loop", lambda *_: figures)
    with pytest.raises(CodegenError, match="over its budget: rows_different") as error:
        pil(FOLDER / "adam0.gains.toml")
    assert error.value.exit_code == 1
    assert "FAIL" in capsys.readouterr().out


def test_a_missing_tool_is_reported_with_its_package(mimopilot_process, tmp_path, monkeypatch, fixed, image):
    import os

    environment = {**os.environ, "PATH": "/nowhere"}
    for arguments in (("pil", FOLDER / "adam0.gains.toml"), ("fly", "adam0", "--on", "cortex-m4")):
        result = mimopilot_process(*arguments, env=environment)
        assert_one_clear_line(result, "arm-none-eabi-g++", "apt-get install gcc-arm-none-eabi")
    monkeypatch.setitem(__import__("sys").modules, "unicorn", None)
    with pytest.raises(Error, match=r"pip install 'mimopilot\[emulator\]'"):
        EmulatedController(image, fixed)
    monkeypatch.setenv("PATH", "/nowhere")
    with pytest.raises(CodegenError, match="apt-get install qemu-system-arm"):
        run_in_qemu(image, np.zeros(1, INPUT))


def test_a_compiler_error_shows_its_first_lines_and_the_command(fixed, tmp_path):
    with pytest.raises(CodegenError, match=r"(?s)add -fno-fast-math.*to repeat: .*arm-none-eabi-g") as error:
        build_image(fixed, tmp_path, ("-Ofast",))
    assert error.value.exit_code == 1
    assert len(str(error.value).splitlines()) <= 7


def test_an_unknown_emulator_or_processor_is_refused(mimopilot):
    assert_one_clear_line(mimopilot("pil", FOLDER / "adam0.gains.toml", "--emulator", "bochs"), "'bochs'", "qemu")
    assert_one_clear_line(mimopilot("fly", "adam0", "--on", "z80"), "'z80'", "cortex-m4")


def test_an_invalid_memory_access_of_the_target_is_an_error(fixed):
    controller = load_emulated(fixed)
    controller.image.functions["step"] = 0x3000_0000  # no memory there
    with pytest.raises(CodegenError, match="the emulated controller stopped") as error:
        controller.run(random_inputs(1, np.random.default_rng(0)))
    assert error.value.exit_code == 1


def test_the_image_needs_no_cpp_library_and_no_double_arithmetic(image):
    linked = subprocess.run(["arm-none-eabi-nm", "-C", image.elf], capture_output=True, text=True, check=True).stdout
    assert "std::" not in linked
    assert "__aeabi_d" not in linked
