"""The emitted tree: its files, the same bytes each time, compilation, and its own test."""

import dataclasses
import json
import os
import subprocess
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mimopilot.codegen.errors import CodegenError
from mimopilot.codegen.literals import float_literal
from mimopilot.codegen.render import render, write_tree
from mimopilot.codegen.targets import DESCRIPTION, TEMPLATES, targets
from mimopilot.codegen.toolchain import find_compiler
from mimopilot.common.files import sha256
from mimopilot.tuning.errors import TuningError
from mimopilot.tuning.parameters import ENABLE, EXCITATION, IDENTITY, PARAMETERS
from tests.conftest import assert_one_clear_line


def read_tree(folder):
    return {p.relative_to(folder).as_posix(): p.read_text() for p in folder.rglob("*") if p.is_file()}


def test_the_same_gains_give_the_same_bytes_and_no_file_is_rewritten(gains, tmp_path):
    assert write_tree(render(gains), tmp_path / "x") == list(render(gains))
    stamps = {p: p.stat().st_mtime_ns for p in (tmp_path / "x").rglob("*")}
    assert write_tree(render(gains), tmp_path / "x") == []
    assert stamps == {p: p.stat().st_mtime_ns for p in (tmp_path / "x").rglob("*")}
    assert read_tree(tmp_path / "x") == render(gains)


@pytest.mark.parametrize("target", targets())
def test_the_output_tree_has_the_layout_of_the_template_tree(gains, target):
    files = render(gains, target)
    expected = {"manifest.json"}
    for path in (p for folder in targets()[target].folders for p in (TEMPLATES / folder).rglob("*") if p.is_file()):
        if path.name == DESCRIPTION:
            continue
        name = path.relative_to(TEMPLATES).as_posix().removeprefix("package/")
        expected.add(name.removesuffix(".jinja"))
        if not name.endswith(".jinja"):
            assert files[name] == path.read_text()
    assert set(files) == expected


def test_the_manifest_lists_the_hash_of_every_file(gains):
    files = render(gains)
    manifest = json.loads(files.pop("manifest.json"))
    assert manifest["files"] == {name: sha256(content) for name, content in files.items()}


def test_no_generated_file_names_this_machine(gains, tmp_path):
    text = "\n".join(content for target in targets() for content in render(gains, target).values())
    for word in (str(tmp_path), str(Path.cwd()), str(TEMPLATES), os.uname().nodename):
        assert word not in text


FOREIGN = {
    "another file": {"mine.txt": "keep"},
    "a manifest of another program": {"manifest.json": '{"generator": "theirs", "files": {}}'},
    "a manifest that is not JSON": {"manifest.json": "keep"},
    "a manifest of another shape": {"manifest.json": "[1]"},
}


@pytest.mark.parametrize("case", FOREIGN)
def test_a_folder_with_foreign_files_is_not_changed_unless_forced(gains, tmp_path, case):
    for name, text in FOREIGN[case].items():
        (tmp_path / name).write_text(text)
    with pytest.raises(CodegenError, match=r"did not generate.*--force"):
        write_tree(render(gains), tmp_path)
    assert read_tree(tmp_path) == FOREIGN[case]
    write_tree(render(gains), tmp_path, force=True)
    assert read_tree(tmp_path) == FOREIGN[case] | render(gains)


def test_a_foreign_file_in_a_generated_folder_is_not_overwritten_unless_forced(gains, tmp_path):
    write_tree(render(gains), tmp_path)
    mine = tmp_path / "px4/src/CMakeLists.txt"
    mine.parent.mkdir(parents=True)
    mine.write_text("keep")
    before = read_tree(tmp_path)
    with pytest.raises(CodegenError, match=r"CMakeLists.txt: mimopilot did not generate it.*--force"):
        write_tree(render(gains, "px4"), tmp_path)
    assert read_tree(tmp_path) == before
    assert "px4/src/CMakeLists.txt" in write_tree(render(gains, "px4"), tmp_path, force=True)


def test_another_target_is_added_to_a_generated_tree_and_foreign_files_stay(gains, tmp_path):
    write_tree(render(gains), tmp_path)
    (tmp_path / "notes.txt").write_text("keep")
    write_tree(render(gains, "px4"), tmp_path)
    assert read_tree(tmp_path) == render(gains, "px4") | {"notes.txt": "keep"}


def test_targets_share_a_folder_only_with_the_same_gains(gains, tmp_path):
    write_tree(render(gains, "px4"), tmp_path)
    before = read_tree(tmp_path)
    other = gains.with_elements({"RP_RR": 0.2})
    for target in ("ardupilot", "native"):
        with pytest.raises(CodegenError, match=r"holds px4/.* of another target, which would stay with other gains"):
            write_tree(render(other, target), tmp_path)
    assert read_tree(tmp_path) == before
    write_tree(render(gains, "ardupilot"), tmp_path)
    both = read_tree(tmp_path)
    assert set(json.loads(both["manifest.json"])["files"]) == both.keys() - {"manifest.json"}
    with pytest.raises(CodegenError, match="of another target"):
        write_tree(render(other, "px4"), tmp_path)
    assert read_tree(tmp_path) == both


def test_what_an_older_version_emitted_for_the_target_may_stay(gains, tmp_path):
    write_tree(render(gains, "px4"), tmp_path)
    before = read_tree(tmp_path)
    manifest = json.loads(before["manifest.json"])
    manifest["files"]["px4/old.cpp"] = ""
    (tmp_path / "px4/old.cpp").write_text("old")
    (tmp_path / "manifest.json").write_text(json.dumps(manifest))
    other = render(gains.with_elements({"RP_RR": 0.2}), "px4")
    write_tree(other, tmp_path)
    assert read_tree(tmp_path) == before | other | {"px4/old.cpp": "old"}


@pytest.mark.parametrize("taken", ["core", "manifest.json", "native/Makefile"])
def test_nothing_is_written_when_a_path_is_taken(gains, tmp_path, taken):
    blocked = tmp_path / "x" / taken
    if "." in taken or taken.endswith("Makefile"):
        blocked.mkdir(parents=True)
    else:
        blocked.parent.mkdir(parents=True)
        blocked.write_text("a file in place of a folder")
    before = sorted(tmp_path.rglob("*"))
    with pytest.raises(CodegenError, match="give --out"):
        write_tree(render(gains), tmp_path / "x", force=True)
    assert sorted(tmp_path.rglob("*")) == before


def test_a_folder_that_is_not_writable_is_refused_before_anything_is_written(gains, tmp_path, monkeypatch):
    # Root may write everywhere, so the answer of the system is simulated.
    monkeypatch.setattr("mimopilot.codegen.render.os.access", lambda path, mode: Path(path).name != "core")
    (tmp_path / "x" / "core").mkdir(parents=True)
    with pytest.raises(CodegenError, match="core: cannot be written to; give --out"):
        write_tree(render(gains), tmp_path / "x", force=True)
    assert read_tree(tmp_path) == {}


@pytest.mark.parametrize("force", [False, True])
@pytest.mark.parametrize("name", ["core", "manifest.json", "native/Makefile"])
@pytest.mark.parametrize("target", ["outside", "outside/file", "outside/new", "loop"])
def test_no_link_is_followed_out_of_the_tree(gains, tmp_path, force, name, target):
    write_tree(render(gains), tmp_path / "x")
    (tmp_path / "outside").mkdir()
    (tmp_path / "outside/file").write_text((tmp_path / "x/manifest.json").read_text())
    link = tmp_path / "x" / name
    link.rename(tmp_path / "own")
    link.symlink_to(link if target == "loop" else tmp_path / target)
    before = {path: path.is_file() and path.read_bytes() for path in tmp_path.rglob("*")}
    changed = gains.with_elements({"RP_RR": 0.25})
    with pytest.raises(OSError, match="is a link, and nothing is written through it") as caught:
        write_tree(render(changed), tmp_path / "x", force)
    assert caught.value.filename == str(link)
    assert {path: path.is_file() and path.read_bytes() for path in tmp_path.rglob("*")} == before


def test_a_device_or_a_pipe_in_place_of_a_file_is_refused_before_anything_is_written(gains, tmp_path):
    (tmp_path / "native").mkdir()
    os.mkfifo(tmp_path / "native/Makefile")
    with pytest.raises(CodegenError, match="native/Makefile: is a device or a pipe"):
        write_tree(render(gains), tmp_path, force=True)
    assert [path.name for path in tmp_path.rglob("*")] == ["native", "Makefile"]


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
def test_the_core_refuses_to_compile_with_fast_math(gains, tmp_path, flags):
    write_tree(render(gains), tmp_path / "x")
    result = make(tmp_path / "x", "test", CXXFLAGS=f"-std=c++17 {flags}")
    assert result.returncode != 0
    assert "add -fno-fast-math" in result.stderr


def test_the_core_is_plain_cpp_11_without_library_calls(gains, tmp_path):
    write_tree(render(gains), tmp_path / "x")
    core = tmp_path / "x" / "core" / "mimo_pid.cpp"
    compiled = tmp_path / "core.o"
    flags = ["-std=c++11", "-O2", "-Wall", "-Wextra", "-Werror", "-fno-math-errno", "-fno-exceptions", "-c"]
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
def test_a_number_that_is_not_finite_is_refused_as_a_literal(value):
    with pytest.raises(CodegenError, match="correct the gains file"):
        float_literal(value)


def test_parameter_names_are_valid_on_a_vehicle():
    table = (*PARAMETERS, *IDENTITY, *EXCITATION, ENABLE)
    assert len({p.name for p in table}) == len(table)
    for parameter in table:
        assert len(parameter.name) <= 16
        assert parameter.name.isupper() or "_" in parameter.name
        assert parameter.minimum < parameter.maximum


def test_a_gain_out_of_range_is_refused_by_name(gains):
    with pytest.raises(TuningError, match=r"MIMO_RP_RR: got 99 s, expected 0.0001 to 5"):
        render(gains.with_elements({"RP_RR": 99.0}))


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("MIMO_RATE_P_ROLL_", "has 17 characters"),
        ("MIMO_RP_RR", "two parameters"),
        ("2_MIMO", "expected a letter"),
        ("mimo_rp", "expected a letter"),
    ],
)
def test_a_name_that_is_invalid_on_a_vehicle_is_refused(gains, monkeypatch, name, reason):
    odd = dataclasses.replace(EXCITATION[0], name=name)
    monkeypatch.setattr("mimopilot.tuning.parameters.EXCITATION", (odd,))
    with pytest.raises(TuningError, match=f"{name}: {reason}"):
        render(gains)


def test_gains_for_shaped_setpoints_are_emitted_for_others_with_a_warning(gains):
    shaped = dataclasses.replace(gains, filters=dataclasses.replace(gains.filters, shaping_s=0.15))
    warned = {name for name, target in targets().items() if target.shaping_warning(shaped)}
    assert warned == {"px4", "crazyflie"}
    assert not any(target.shaping_warning(gains) for target in targets().values())


def test_an_unknown_target_is_refused(gains):
    with pytest.raises(CodegenError, match=f"expected one of {', '.join(sorted(targets()))}$"):
        render(gains, "unknown")


def test_an_option_of_a_target_reaches_its_templates_and_an_unknown_one_is_refused(gains, tmp_path, mimopilot):
    gains.save(tmp_path / "g.toml")
    start = ("generate", "g.toml", "--target", "px4", "--uncertified", "--out")
    assert mimopilot(*start, "a", "--px4-api", "descriptor").returncode == 0
    assert mimopilot(*start, "b", "--option", "px4-api=descriptor").returncode == 0
    module = "px4/src/modules/mc_mimo_pid/mc_mimo_pid.cpp"
    assert (tmp_path / "a" / module).read_bytes() == (tmp_path / "b" / module).read_bytes()
    for text, message in (("nonsense=1", "no target has it; known: "), ("px4_api", "expected NAME=VALUE")):
        assert_one_clear_line(mimopilot(*start, "c", "--option", text), message)
    assert not (tmp_path / "c").exists()


def test_a_target_with_an_unknown_entry_or_the_name_of_another_is_refused(tmp_path, monkeypatch):
    cases = ('name = "x"\nhelp = ""\ntypo = 1\n', "not a target: 'folders'"), (None, "choose another name")
    for text, message in cases:
        (tmp_path / "a").mkdir(exist_ok=True)
        (tmp_path / "b").mkdir(exist_ok=True)
        whole = 'name = "x"\nhelp = ""\nfolders = ["core"]\n'
        (tmp_path / "a" / DESCRIPTION).write_text(text or whole)
        (tmp_path / "b" / DESCRIPTION).write_text(whole)
        monkeypatch.setattr("mimopilot.codegen.targets.TEMPLATES", tmp_path)
        targets.cache_clear()
        with pytest.raises(CodegenError, match=message):
            targets()
    monkeypatch.undo()
    targets.cache_clear()
    assert "px4" in targets()
