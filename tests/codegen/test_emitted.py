"""The emitted code, as a user builds it: static analysis, sanitisers, fuzzing, host and target."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from mimopilot.codegen.layout import OUTPUT, offset, to_array
from mimopilot.codegen.native import NativeController, load_native
from mimopilot.codegen.render import render, write_tree
from mimopilot.codegen.toolchain import CORTEX_M4_FLAGS, WARNINGS, find_compiler
from mimopilot.codegen.vectors import random_inputs
from mimopilot.tuning.controller import MAX_NORM_ERROR, MAX_RATE
from mimopilot.tuning.parameter_row import Shape
from mimopilot.tuning.parameters import ROWS

BIN = Path(sys.executable).parent
HERE = Path(__file__).parent


@pytest.fixture
def tree(gains, tmp_path):
    write_tree(render(gains, "cortex-m4"), tmp_path / "tree")
    return tmp_path / "tree"


def run(*command, cwd=None):
    return subprocess.run(list(map(str, command)), capture_output=True, text=True, check=False, cwd=cwd, timeout=300)


def sources(tree):
    return sorted(path for folder in ("core", "native", "cortex_m4") for path in (tree / folder).glob("*.cpp"))


def test_both_makefiles_build_with_warnings_as_errors_and_run(tree):
    for folder in ("native", "cortex_m4"):
        text = (tree / folder / "Makefile").read_text()
        for flag in WARNINGS:
            assert f" {flag}" in text
        result = run("make", "-C", tree / folder, "all", "test", "example")
        assert result.returncode == 0, result.stderr
        assert "0 of 256 rows differ" in result.stdout
        assert "9  roll" in result.stdout


def test_the_host_and_the_target_print_the_same_example(tree):
    printed = [run("make", "-s", "-C", tree / folder, "example").stdout for folder in ("native", "cortex_m4")]
    assert len(printed[0].splitlines()) == 10
    assert printed[0] == printed[1]


def test_the_test_on_the_target_fails_if_one_bit_is_wrong(tree):
    vectors = tree / "native" / "test_vectors.hpp"
    head, outputs = vectors.read_text().split("kVectorOutputs")
    at = outputs.index("0x") + 9
    vectors.write_text(f"{head}kVectorOutputs{outputs[:at]}{int(outputs[at], 16) ^ 1:x}{outputs[at + 1 :]}")
    result = run("make", "-s", "-C", tree / "cortex_m4", "test")
    assert result.returncode != 0
    assert "1 of 256 rows differ" in result.stdout


def test_the_firmware_steps_once_per_period_and_calls_the_board_functions(tree):
    # A board that ends the emulation after 250 periods, with success if each torque opposed the error.
    (tree / "board.cpp").write_text("""
#include "cortex_m4/board.hpp"
namespace {
int periods = 0;
int answered = 0;
}
void read_board(mimopilot::Input &input)
{
    input.armed = 1;
    input.attitude_setpoint[0] = 1.0F;
    input.attitude[0] = 0.99875026F;  // 0.1 rad of roll
    input.attitude[1] = 0.04997917F;
}
void write_board(const mimopilot::Output &output)
{
    if (output.moment[0] < 0.0F) { answered++; }
    if (++periods < 250) { return; }
    const int reason = answered == 250 ? 0x20026 : 0;
    __asm__ volatile("mov r1, %0; mov r0, #0x18; bkpt 0xab" : : "r"(reason) : "r0", "r1", "memory");  // SYS_EXIT
}
""")
    folder = tree / "cortex_m4"
    built = run("make", "-C", folder, "build/mimo_pid.elf", "BOARD=../board.cpp")
    assert built.returncode == 0, built.stderr
    machine = ("-machine", "netduinoplus2", "-display", "none", "-serial", "none", "-monitor", "none")
    ended = run("qemu-system-arm", *machine, "-semihosting", "-kernel", folder / "build" / "mimo_pid.elf")
    assert ended.returncode == 0, ended.stderr


CMAKE = """
cmake_minimum_required(VERSION 3.10)
project(caller CXX)
add_subdirectory(${TREE}/core core)
set(SOURCES ${TREE}/native/test_main.cpp)
if(CMAKE_CROSSCOMPILING)
  list(APPEND SOURCES ${TREE}/cortex_m4/startup.cpp)
  add_definitions(-DMIMO_PID_SEMIHOSTING)
  link_libraries(-nostdlib -T${TREE}/cortex_m4/stm32f4.ld mimo_pid -Wl,--start-group -lc -lgcc -lrdimon -Wl,--end-group)
endif()
add_executable(test_main ${SOURCES})
target_link_libraries(test_main mimo_pid)
"""


@pytest.mark.parametrize("target", ["host", "cortex-m4"])
def test_the_cmake_library_builds_for_host_and_target(tree, tmp_path, target):
    (tmp_path / "CMakeLists.txt").write_text(CMAKE)
    options = [f"-DTREE={tree}"]
    if target == "cortex-m4":
        options += ["-DCMAKE_SYSTEM_NAME=Generic", "-DCMAKE_TRY_COMPILE_TARGET_TYPE=STATIC_LIBRARY"]
        options += ["-DCMAKE_CXX_COMPILER=arm-none-eabi-g++", f"-DCMAKE_CXX_FLAGS={' '.join(CORTEX_M4_FLAGS)}"]
    build = tmp_path / "build"
    for command in ([BIN / "cmake", "-S", tmp_path, "-B", build, *options], [BIN / "cmake", "--build", build]):
        result = run(*command)
        assert result.returncode == 0, result.stdout + result.stderr
    program = [build / "test_main"]
    if target == "cortex-m4":
        quiet = ("-display", "none", "-serial", "none", "-monitor", "none", "-chardev", "stdio,id=host")
        semihosting = "enable=on,target=native,chardev=host"
        program = ["qemu-system-arm", "-machine", "netduinoplus2", *quiet, "-semihosting-config", semihosting]
        program += ["-kernel", build / "test_main"]
    ended = run(*program)
    assert ended.returncode == 0
    assert "0 of 256 rows differ" in ended.stdout


def test_cppcheck_finds_nothing(tree):
    checks = "--enable=warning,style,performance,portability"
    command = (BIN / "cppcheck", checks, "--error-exitcode=1", "--language=c++", "--std=c++17", "--quiet")
    result = run(*command, *sources(tree))
    assert (result.returncode, result.stderr) == (0, "")


def test_cppcheck_finds_an_inserted_error(tree):
    core = tree / "core" / "mimo_pid.cpp"
    wrong = "for (int i = 0; i <= kAxes; i++) { state.integral[i] = 0.0F; }"
    core.write_text(f"{core.read_text()}\nvoid wrong(mimopilot::State &state) {{ using mimopilot::kAxes; {wrong} }}\n")
    result = run(BIN / "cppcheck", "--error-exitcode=1", "--language=c++", "--quiet", core)
    assert result.returncode == 1
    assert "arrayIndexOutOfBounds" in result.stderr


def test_clang_tidy_finds_nothing(tree):
    configuration = f"--config-file={HERE / '.clang-tidy'}"
    result = run(BIN / "clang-tidy", "--quiet", configuration, *sources(tree), "--", "-std=c++17")
    assert result.returncode == 0, result.stdout
    assert "error:" not in result.stdout


def test_the_sanitisers_report_nothing_on_the_test_vectors(tree):
    flags = "-std=c++17 -O1 -g -fsanitize=address,undefined -fno-sanitize-recover=all"
    result = run("make", "-s", "-C", tree / "native", "test", "example", f"CXXFLAGS={flags}")
    assert result.returncode == 0, result.stderr
    assert "0 of 256 rows differ" in result.stdout


def test_no_function_of_the_core_has_an_unbounded_or_large_stack_frame(tree):
    for compiler in (find_compiler(), "arm-none-eabi-g++"):
        target = CORTEX_M4_FLAGS if "arm" in compiler else ()
        flags = ("-std=c++11", "-O2", "-Wstack-usage=256", "-Werror", "-c", "-o", tree / "core.o")
        result = run(compiler, *flags, *target, tree / "core" / "mimo_pid.cpp")
        assert result.returncode == 0, result.stderr


def place(key, shape=None):
    """Where a row of the parameter table lies among the gains."""
    row = next(row for row in ROWS if row.key == key and shape in (None, row.shape))
    first = offset(row) // 4
    return slice(first, first + len(row.codes))


def test_a_million_steps_with_invalid_inputs_and_gain_changes_stay_finite_and_limited(gains):
    rng = np.random.default_rng(7)
    wild = np.array([np.nan, np.inf, -np.inf, 1e38, -1e38, 3e38, 1e-40, -1e-45, 0.0, -0.0, 12.5, 100.0], np.float32)
    controller = NativeController(load_native(gains), gains)
    current = to_array(gains)
    accepted = refused = faulty = bumped = 0
    last = np.zeros((1, 3), np.float32)
    for _ in range(100):
        inputs = random_inputs(10_000, rng)
        for name in ("attitude_setpoint", "attitude", "rates_setpoint", "rates", "excitation", "yaw_rate_setpoint"):
            hit = rng.random(inputs[name].shape) < rng.choice([0.0, 0.001, 0.3])
            inputs[name][hit] = rng.choice(wild, int(hit.sum()))
        for name in ("saturation", "silent"):
            integers = rng.integers(-(2**31), 2**31, inputs[name].shape)
            inputs[name] = np.where(rng.random(inputs[name].shape) < rng.choice([0.01, 1.0]), integers, inputs[name])
        inputs["rate_mode"] = rng.integers(-(2**31), 2**31, 20).repeat(500) * (rng.random(20) < 0.3).repeat(500)
        outputs = controller.run(inputs)
        rate_max = np.where(inputs["rate_mode"][:, None] != 0, np.float32(MAX_RATE), current[place("rate_max")])
        r = outputs["rates_setpoint"]
        held = np.vstack([last, r[:-1]]) == r  # one that is held is limited as it was
        last = r[-1:]
        assert ((np.abs(r) <= rate_max) | held).all()
        assert (np.abs(outputs["moment"]) <= current[place("moment_max")]).all()
        assert (np.abs(controller.state["integral"]) <= current[place("integral_max")]).all()
        assert np.isfinite(controller.state["derivative"]).all()
        # Tilts are within 2, give or take the length of a quaternion; with the smallest damping ratio, 0.1, the model
        # passes them sixfold at most.
        assert (np.abs(controller.state["model"]["angle"]) < 8 * 2.0).all()
        for name in ("attitude", "attitude_setpoint"):
            assert np.linalg.norm(controller.state[name]) == pytest.approx(1, abs=MAX_NORM_ERROR / 2 + 1e-3)
        assert all(np.isfinite(controller.state["model"][name]).all() for name in ("rate", "acceleration"))
        faulty += int((outputs["fault"] != 0).sum())
        bumped += int((np.abs(outputs["moment"]) == current[place("moment_max")]).any(axis=1).sum())
        changed = to_array(gains)
        for row in ROWS:
            count = len(row.codes)
            if row.shape in (Shape.MATRIX, Shape.YAW):
                size = rng.choice([1e-30, 1.0, 30.0, 1e5]).astype(np.float32)
                changed[place(row.key, row.shape)] *= size * rng.choice([-1, 1], count)
            elif row.shape is Shape.AXES:
                changed[place(row.key)] = rng.uniform(1e-3, 50, count)
            elif row.shape is Shape.POLE:
                changed[place(row.key)] = rng.uniform(0, 0.999)
        changed[place("yaw_weight")] = rng.uniform(1e-6, 1)
        changed[place("setpoint_slew")] = rng.choice([0.0, 1e-30, 1.0, 25.0])
        changed[place("model_damping")] = rng.uniform(0.1, 2.0)
        changed[place("model_omega")] = rng.choice([0.0, 1e-30, 1.0, 62.5])
        if rng.random() < 0.3:
            changed[rng.integers(len(changed))] = rng.choice(wild[:6])
        if controller.set_gains(changed):
            current, accepted = changed, accepted + 1
        else:
            refused += 1
    assert len(outputs) == 10_000 and outputs.dtype == OUTPUT
    assert accepted > 40
    assert refused > 15
    assert faulty > 5_000
    assert bumped > 10_000
