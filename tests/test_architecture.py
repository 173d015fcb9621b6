"""Who may import whom: no arrow points upwards."""

import ast
import importlib
from pathlib import Path

import pytest

TOP = Path(__file__).resolve().parents[1]
FORBIDDEN = {"tuning": {"codegen", "sitl"}, "codegen": {"sitl"}}
#: What the bench may know of tuning, outside of its studies.
BENCH_MAY_USE = {
    "cache",
    "compiled",
    "drawing",
    "errors",
    "excitation",
    "files",
    "flown",
    "gains",
    "output",
    "parallel",
    "reference",
    "toml",
}


def imports(path):
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.module:
            yield node.module
        elif isinstance(node, ast.Import):
            yield from (name.name for name in node.names)


@pytest.mark.parametrize("room", FORBIDDEN)
def test_a_room_does_not_import_those_above_it(room):
    for path in (TOP / room).rglob("*.py"):
        assert not {name.split(".")[0] for name in imports(path)} & FORBIDDEN[room], path


def test_only_studies_use_how_gains_are_found_and_only_the_front_door_uses_studies():
    for path in (TOP / "sitl").rglob("*.py"):
        if "studies" in path.parts:
            continue
        for name in imports(path):
            assert not name.startswith("mimopilot.sitl.studies"), path
            if name.startswith("tuning."):
                assert name.split(".")[1] in BENCH_MAY_USE, (path, name)


def test_the_templates_hold_no_python():
    assert not list((TOP / "firmware_templates").rglob("*.py"))


def test_the_benchmarks_can_be_imported():
    """No test runs them: what they import may not move away unseen."""
    assert importlib.import_module("tests.bench").main
