"""The wheel: what it holds, and that it works where it is installed."""

import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest

from mimopilot.common.extras import EXTRAS
from tests.conftest import assert_one_clear_line
from tests.package import build_wheel, install, use
from tests.paths import PACKAGES, TOP


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    return build_wheel(tmp_path_factory.mktemp("build"))


def test_the_wheel_holds_every_file_that_is_not_python(wheel):
    held = set(zipfile.ZipFile(wheel).namelist())
    wanted = {
        (Path(package.replace(".", "/")) / path.relative_to(folder)).as_posix()
        for package, folder in PACKAGES.items()
        for path in folder.rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    }
    assert wanted <= held


def test_it_works_outside_of_the_tree(wheel, tmp_path):
    programs = install(wheel, tmp_path / "venv")
    assert use(programs, tmp_path, "--version").startswith("mimopilot ")
    use(programs, tmp_path, "experiment", "adam0", "--seconds-per-axis", "8", "--out", "flight.ulg")
    use(programs, tmp_path, "tune", "flight.ulg", "--out", "my.gains.toml")
    use(programs, tmp_path, "generate", "my.gains.toml", "--target", "px4", "--out", "firmware")
    assert (tmp_path / "firmware/core/mimo_pid.cpp").is_file()
    assert "off-axis" in use(programs, tmp_path, "fly", "adam0", "--gains", "my.gains.toml")
    use(programs, tmp_path, "report", "flight.ulg", "--gains", "my.gains.toml", "--out", "flight.html")
    assert "plotly" in (tmp_path / "flight.html").read_text()


MISSING = {
    "plotly": (
        "report x.ulg --out x.html",
        "tune x.ulg --out x --report x.html",
        "autotune --connect udpin:127.0.0.1:14550 --out tuned",
        "demo --out x",
        "reproduce numerical-example --out x",
    ),
    "pyarrow": ("campaign adam0 --out x",),
    "unicorn": ("pil my.gains.toml",),
    "cflib": ("params --connect usb://0",),
}


@pytest.mark.parametrize(
    ("package", "command"), [(package, command) for package, commands in MISSING.items() for command in commands]
)
def test_a_command_without_its_optional_package_names_the_extra_before_it_begins(
    mimopilot, gains, tmp_path, monkeypatch, package, command
):
    gains.save(tmp_path / "my.gains.toml")
    (extra,) = (one for one in EXTRAS if one.package == package)
    monkeypatch.setitem(sys.modules, package, None)
    done = mimopilot(*command.split())
    assert_one_clear_line(done, f"needs {package}, which is not installed: pip install 'mimopilot[{extra.name}]'")
    assert {path.name for path in tmp_path.iterdir()} == {"my.gains.toml"}


def test_every_use_of_a_link_names_the_extra_without_pymavlink(tmp_path):
    """In a process of its own: whatever uses a link finds it missing while it is imported."""
    script = "import sys; sys.modules['pymavlink'] = None; from mimopilot.cli.main import main; main()"
    line = ("autotune", "--connect", "udpin:127.0.0.1:14550", "--out", "tuned")
    done = subprocess.run([sys.executable, "-c", script, *line], cwd=tmp_path, capture_output=True, text=True)
    assert_one_clear_line(done, "needs pymavlink, which is not installed: pip install 'mimopilot[vehicle]'")
    assert not list(tmp_path.iterdir())


def test_every_extra_is_one_of_the_package():
    extras = tomllib.loads((TOP / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    for one in EXTRAS:
        assert any(line.startswith((one.package, f"dask[{one.package}]")) for line in extras[one.name])
