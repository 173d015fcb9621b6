"""The emitted tree: what is in it, that it is deterministic, and that it compiles and passes its own test."""

import json
import os
import subprocess
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from codegen.errors import CodegenError
from codegen.literals import float_literal
from codegen.parameters import IDENTITY, PARAMETERS
from codegen.render import TEMPLATES, render, write_tree
from codegen.toolchain import find_compiler
from tuning.files import sha256


def read_tree(folder):
    return {p.relative_to(folder).as_posix(): p.read_text() for p in folder.rglob("*") if p.is_file()}


def test_the_same_gains_give_the_same_bytes_and_nothing_is_rewritten(gains, tmp_path):
    assert write_tree(render(gains), tmp_path / "x") == list(render(gains))
    stamps = {p: p.stat().st_mtime_ns for p in (tmp_path / "x").rglob("*")}
    assert write_tree(render(gains), tmp_path / "x") == []
    assert stamps == {p: p.stat().st_mtime_ns for p in (tmp_path / "x").rglob("*")}
    assert read_tree(tmp_path / "x") == render(gains)


def test_the_output_tree_looks_like_the_template_tree(gains):
    expected = {
        path.relative_to(TEMPLATES).as_posix().removeprefix("package/").removesuffix(".jinja")
        for folder in ("core", "native", "package")
        for path in (TEMPLATES / folder).rglob("*")
        if path.is_file()
    }
    assert set(render(gains)) == expected | {"manifest.json"}


def test_the_manifest_holds_the_hash_of_every_file(gains):
    files = render(gains)
    manifest = json.loads(files.pop("manifest.json"))
    assert manifest["files"] == {name: sha256(content) for name, content in files.items()}


def test_nothing_generated_speaks_of_this_machine(gains, tmp_path):
    text = "\n".join(render(gains).values())
    for word in (str(tmp_path), str(Path.cwd()), str(TEMPLATES), os.uname().nodename):
        assert word not in text


def test_files_of_others_are_not_touched(gains, tmp_path):
    (tmp_path / "mine.txt").write_text("keep")
    with pytest.raises(CodegenError, match="did not generate"):
        write_tree(render(gains), tmp_path)
    assert read_tree(tmp_path) == {"mine.txt": "keep"}


def make(folder, *targets, **variables):
    command = ["make", "-s", "-C", str(folder / "native"), *targets, *(f"{k}={v}" for k, v in variables.items())]
    return subprocess.run(command, capture_output=True, text=True, check=False)


def test_the_emitted_makefile_builds_tests_and_runs_the_example(gains, tmp_path):
    write_tree(render(gains), tmp_path / "x")
    result = make(tmp_path / "x", "all", "test", "example")
    assert result.returncode == 0, result.stderr
    assert "0 of 256 rows differ" in result.stdout


def test_the_emitted_test_fails_when_one_bit_is_wrong(gains, tmp_path):
    write_tree(render(gains), tmp_path / "x")
    vectors = tmp_path / "x" / "native" / "test_vectors.hpp"
    head, outputs = vectors.read_text().split("kVectorOutputs")
    first = outputs.index("0x")
    digit = outputs[first + 9]
    flipped = outputs[: first + 9] + format(int(digit, 16) ^ 1, "x") + outputs[first + 10 :]
    vectors.write_text(f"{head}kVectorOutputs{flipped}")
    result = make(tmp_path / "x", "test")
    assert result.returncode != 0
    assert "1 of 256 rows differ" in result.stdout


FAST_MATH = [
    "-Ofast",
    "-ffast-math",
    "-funsafe-math-optimizations",
    "-freciprocal-math -fno-signed-zeros -fno-trapping-math",
]


@pytest.mark.parametrize(
    "flags", ["-O0", "-O2", "-O3", "-Os", "-O2 -mfma -ffp-contract=fast", *(f"{f} -fno-fast-math" for f in FAST_MATH)]
)
def test_no_optimisation_flag_changes_a_bit(gains, tmp_path, flags):
    if "-mfma" in flags and "fma" not in Path("/proc/cpuinfo").read_text():
        flags = flags.replace("-mfma ", "")
    write_tree(render(gains), tmp_path / "x")
    result = make(tmp_path / "x", "test", CXXFLAGS=f"-std=c++17 {flags}")
    assert result.returncode == 0, result.stdout + result.stderr


@pytest.mark.parametrize("flags", FAST_MATH)
def test_fast_math_is_refused_by_the_code_itself(gains, tmp_path, flags):
    write_tree(render(gains), tmp_path / "x")
    result = make(tmp_path / "x", "test", CXXFLAGS=f"-std=c++17 {flags}")
    assert result.returncode != 0
    assert "add -fno-fast-math" in result.stderr


def test_the_core_is_plain_cpp_11_without_library_calls(gains, tmp_path):
    write_tree(render(gains), tmp_path / "x")
    core = tmp_path / "x" / "core" / "mimo_pid.cpp"
    compiled = tmp_path / "core.o"
    flags = ["-std=c++11", "-O2", "-Wall", "-Wextra", "-Werror", "-fno-exceptions", "-c"]
    subprocess.run([find_compiler(), *flags, str(core), "-o", str(compiled)], check=True)
    symbols = subprocess.run(["nm", "-u", str(compiled)], capture_output=True, text=True, check=True).stdout.split()
    assert set(symbols) - {"U"} <= {"memset", "memcpy", "_GLOBAL_OFFSET_TABLE_"}


def test_the_parameter_header_is_valid_c(gains, tmp_path):
    write_tree(render(gains), tmp_path / "x")
    source = tmp_path / "use.c"
    source.write_text(
        f'#include "{tmp_path}/x/core/parameters.h"\n#include <stdio.h>\n'
        "int main(void) { for (int i = 0; i < MIMO_PID_PARAMETER_COUNT; i++) "
        'printf("%s %.9g\\n", mimo_pid_parameters[i].name, (double)mimo_pid_parameters[i].default_value); return 0; }\n'
    )
    subprocess.run(
        ["gcc", "-std=c99", "-Wall", "-Wextra", "-Werror", str(source), "-o", str(tmp_path / "use")], check=True
    )
    printed = subprocess.run([str(tmp_path / "use")], capture_output=True, text=True, check=True).stdout.split()
    values = gains.elements()
    assert printed[::2] == [p.name for p in PARAMETERS]
    assert [np.float32(v) for v in printed[1::2]] == [np.float32(values[p.code]) for p in PARAMETERS]


@given(st.floats(width=32, allow_nan=False, allow_infinity=False))
def test_a_literal_reads_back_to_the_same_bits(value):
    text = float_literal(value)
    assert text.endswith("F")
    assert np.float32(text[:-1]).tobytes() == np.float32(value).tobytes()


@pytest.mark.parametrize("value", [float("nan"), float("inf"), 1e39])
def test_no_literal_is_emitted_for_a_number_that_is_not_finite(value):
    with pytest.raises(CodegenError, match="correct the gains file"):
        float_literal(value)


def test_parameter_names_fit_a_vehicle():
    names = [p.name for p in PARAMETERS + IDENTITY]
    assert len(set(names)) == len(names)
    for parameter in PARAMETERS + IDENTITY:
        assert len(parameter.name) <= 16
        assert parameter.name.isupper() or "_" in parameter.name
        assert parameter.minimum < parameter.maximum


def test_a_gain_out_of_its_range_is_refused_by_name(gains):
    with pytest.raises(CodegenError, match=r"MIMO_RP_RR: got 99 s, expected -5 to 5"):
        render(gains.with_elements({"RP_RR": 99.0}))


def test_an_unknown_target_is_refused(gains):
    with pytest.raises(CodegenError, match="expected one of cortex-m4, native"):
        render(gains, "toaster")
