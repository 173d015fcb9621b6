"""Who may import whom: no arrow points upwards, none goes in a circle."""

import ast
import importlib
import subprocess
import sys

import pytest

from tests.paths import PACKAGES, TOP

#: Packages from the bottom up: each may import itself and those before it, never one after it.
LAYERS = (
    "mimopilot.common",
    "mimopilot.tuning",
    "mimopilot.tuning.plant",
    "mimopilot.tuning.estimation",
    "mimopilot.tuning.logs",
    "mimopilot.tuning.analysis",
    "mimopilot.tuning.design",
    "mimopilot.codegen",
    "mimopilot.sitl",
    "mimopilot.sitl.physics",
    "mimopilot.sitl.autopilot",
    "mimopilot.sitl.faults",
    "mimopilot.sitl.flight",
    "mimopilot.sitl.crtp",
    "mimopilot.sitl.mavlink",
    "mimopilot.sitl.mavlink.wire",
    "mimopilot.sitl.mavlink.simulator_api",
    "mimopilot.sitl.mavlink.vehicle",
    "mimopilot.sitl.mavlink.ground_station",
    "mimopilot.sitl.mavlink.ground_station.experiments",
    "mimopilot.sitl.mavlink.log_transfer",
    "mimopilot.sitl.campaign",
    "mimopilot.sitl.field.report.analysis",
    "mimopilot.sitl.field.report.sections",
    "mimopilot.sitl.field.report",
    "mimopilot.sitl.field",
    "mimopilot.sitl.studies",
    "mimopilot.api",
    "mimopilot",
    "mimopilot.cli",
)
#: What code generation and simulation may know of tuning; these packages tune, too.
TUNERS = ("mimopilot.sitl.studies", "mimopilot.sitl.field")
CONTRACT = {
    "mimopilot.codegen": ("mimopilot.tuning",),
    "mimopilot.sitl": ("mimopilot.tuning", "mimopilot.tuning.logs"),
}


def modules():
    """Every module's name -> its file; what is emitted with a target is none."""
    found = {}
    for package, folder in PACKAGES.items():
        if package == "mimopilot.firmware_templates":
            continue
        for path in folder.rglob("*.py"):
            parts = path.relative_to(folder).with_suffix("").parts
            found[".".join([package, *parts]).removesuffix(".__init__")] = path
    return found


MODULES = modules()


def package_of(module):
    if module == "mimopilot.__main__":
        return "mimopilot.cli"
    return module if MODULES[module].name == "__init__.py" else module.rpartition(".")[0]


def imports(module):
    """Modules of ours that a module imports, anywhere in it, also for its type checker."""
    for node in ast.walk(ast.parse(MODULES[module].read_text())):
        names = []
        if isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{module}: relative import"
            whole = [f"{node.module}.{alias.name}" for alias in node.names]
            names = [name if name in MODULES else node.module for name in whole]
        elif isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        yield from (name for name in names if name in MODULES)


ARROWS = {module: set(imports(module)) - {module} for module in MODULES}


def test_every_package_has_its_layer():
    assert {package_of(module) for module in MODULES} == set(LAYERS)


@pytest.mark.parametrize("package", LAYERS)
def test_a_package_imports_only_itself_and_those_below(package):
    above = set(LAYERS[LAYERS.index(package) + 1 :])
    for module in MODULES:
        if package_of(module) == package and module != "mimopilot":  # its __init__ names the public API
            assert not {name for name in ARROWS[module] if package_of(name) in above}, module


def test_only_studies_field_work_and_the_public_api_know_how_gains_are_found():
    for module in MODULES:
        contract = CONTRACT.get(".".join(module.split(".")[:2]))
        if contract and not package_of(module).startswith(TUNERS):
            tuning = {package_of(name) for name in ARROWS[module]}
            assert {name for name in tuning if name.startswith("mimopilot.tuning")} <= set(contract), module


def test_only_the_front_door_imports_the_field_work_and_the_demo_its_report():
    for module in MODULES:
        used = {package_of(name) for name in ARROWS[module] if package_of(name).startswith("mimopilot.sitl.field")}
        if module == "mimopilot.sitl.studies.demo":  # its page has the sections of a flight's report
            used = {package for package in used if not package.startswith("mimopilot.sitl.field.report")}
        if used:
            assert package_of(module).startswith(("mimopilot.sitl.field", "mimopilot.api", "mimopilot.cli")), module


def test_no_modules_import_one_another_in_a_circle():
    below, left = set(), dict(ARROWS)
    left["mimopilot"] = set()
    while left:
        free = {module for module, targets in left.items() if targets <= below}
        assert free, f"a circle among {', '.join(sorted(left))}"
        below |= free
        left = {module: targets for module, targets in left.items() if module not in free}


def test_no_two_classes_have_one_name():
    seen = {}
    for module, path in MODULES.items():
        for node in ast.parse(path.read_text()).body:
            if isinstance(node, ast.ClassDef):
                name = node.name.removeprefix("_")
                assert name not in seen, f"{name}: in {seen[name]} and {module}"
                seen[name] = module


def test_the_templates_hold_no_python_but_a_script_that_is_emitted():
    templates = TOP / "firmware_templates"
    assert [path.relative_to(templates).as_posix() for path in templates.rglob("*.py")] == ["ardupilot/install.py"]


def test_the_benchmarks_can_be_imported():
    """No test runs them: what they import may not move away unseen."""
    assert importlib.import_module("tests.bench").main


def test_files_beside_a_script_that_are_called_as_our_folders_are_not_imported(tmp_path):
    for name in ("tuning", "codegen", "sitl", "common", "cli"):
        (tmp_path / f"{name}.py").write_text("raise SystemExit('the wrong module was imported')")
    script = "import mimopilot as mp; mp.load_airframe('adam0'); mp.tune; import mimopilot.codegen.render"
    done = subprocess.run([sys.executable, "-c", script], cwd=tmp_path, capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")
    help_text = subprocess.run(
        [sys.executable, "-m", "mimopilot", "--help"], cwd=tmp_path, capture_output=True, text=True
    )
    assert "tune" in help_text.stdout


def test_importing_the_package_loads_no_numerical_library():
    """`mimopilot --help` answers at once: what takes long is imported by what needs it."""
    script = (
        "import sys, mimopilot, mimopilot.cli.main; "
        "print([name for name in ('numpy', 'scipy', 'numba', 'pymavlink', 'matplotlib') if name in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert done.stdout == "[]\n"
