"""The wheel: what it holds, and that it works where it is installed."""

import zipfile
from pathlib import Path

import pytest

from mimopilot.cli import campaign
from mimopilot.common.errors import Error
from tests.package import build_wheel, install, use
from tests.paths import PACKAGES


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


def test_a_campaign_without_pyarrow_names_the_extra(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "pyarrow", None)
    with pytest.raises(Error, match=r"pip install 'mimopilot\[campaign\]'"):
        campaign.campaign("adam0", out=Path("x"))
