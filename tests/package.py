"""The package built, installed outside of the tree and used: ``python -m tests.package python3.12`` (make pythons)."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
import sysconfig
import tempfile
import time
from pathlib import Path

from tests.paths import PACKAGES, TOP

#: Largest base installation, MB: what the project allows itself.
BASE_MB = 600
#: What an installation's users do first.
STEPS = (
    ("--version",),
    ("doctor", "--json"),
    ("experiment", "adam0", "--seconds-per-axis", "8", "--out", "flight.ulg"),
    ("tune", "flight.ulg", "--out", "my.gains.toml"),
    ("generate", "my.gains.toml", "--target", "px4", "--out", "firmware"),
    ("fly", "adam0", "--gains", "my.gains.toml"),
    ("report", "flight.ulg", "--gains", "my.gains.toml", "--out", "flight.html"),
    ("demo", "--out", "demo"),
)


def build_wheel(folder: Path) -> Path:
    """Build sdist and, from it, the wheel, in a copy of the sources; a warning is a failure."""
    copy = folder / "source"
    copy.mkdir()
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(TOP / name, copy)
    for package in PACKAGES.values():
        shutil.copytree(package, copy / package.name, ignore=shutil.ignore_patterns("__pycache__"))
    command = [sys.executable, "-m", "build", "--no-isolation", "--outdir", str(folder / "dist"), str(copy)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=folder, env=_environment())
    text = done.stdout + done.stderr
    assert done.returncode == 0, text
    assert not (found := re.findall(r".*(?:[Ww]arning|[Dd]eprecat).*", text)), found
    (wheel,) = (folder / "dist").glob("*.whl")
    return wheel


def install(wheel: Path, folder: Path, python: str | None = None, extras: str = "") -> Path:
    """A virtual environment with the wheel and its extras, as ``[NAME]``; the folder of its programs.

    Without a Python it is this one, and the dependencies are those of this environment.
    """
    subprocess.run([python or sys.executable, "-m", "venv", folder], check=True)
    pip = [folder / "bin/python", "-m", "pip", "install", "--quiet", "--disable-pip-version-check"]
    if python is None:
        (library,) = (folder / "lib").glob("python3*/site-packages")
        pip.append("--no-deps")
        # After the environment's own packages: the wheel wins over a project that is installed editable.
        (library / "dependencies.pth").write_text(sysconfig.get_path("purelib") + "\n")
    subprocess.run([*pip, f"{wheel}{extras}"], check=True, env=_environment())
    return folder / "bin"


def use(programs: Path, folder: Path, *arguments: str) -> str:
    """Standard output of a command of the installed package, run from a folder."""
    command = [programs / "mimopilot", *arguments]
    done = subprocess.run(command, capture_output=True, text=True, cwd=folder, check=False, env=_environment())
    assert done.returncode == 0, (arguments, done.stdout, done.stderr)
    return done.stdout


def _environment() -> dict[str, str]:
    """This environment without Python's variables, which could lead to the sources of this tree."""
    return {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}


def main(python: str) -> None:
    """Build, install with all dependencies on a Python, and use."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        wheel = build_wheel(folder)
        for extras in ("", "[vehicle,report]"):
            programs = install(wheel, folder / "venv", python, extras)
            size = sum(path.lstat().st_size for path in (folder / "venv").rglob("*")) / 1e6
            print(f"{python}: {size:.0f} MB with mimopilot{extras}", flush=True)
            assert extras or size <= BASE_MB, f"the base installation has {size:.0f} MB, at most {BASE_MB} are wanted"
        work = folder / "work"
        work.mkdir()
        for step in STEPS:
            begin = time.monotonic()
            output = use(programs, work, *step)
            shown = json.loads(output)["ok"] if step[0] == "doctor" else output.strip().splitlines()[-1]
            print(f"{python}: {' '.join(step)}: {time.monotonic() - begin:.1f} s: {shown}", flush=True)


if __name__ == "__main__":
    main(sys.argv[1])
