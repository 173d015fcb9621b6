"""The examples run, and show what they say."""

import os
import runpy
import subprocess
import sys

import pytest

from tests.conftest import run_here
from tests.paths import TOP

EXAMPLES = sorted((TOP / "examples").glob("*.py"))
#: Example -> files that it leaves in its folder.
LEAVES = {
    "campaign": ("campaign/report.html", "campaign/results.parquet", "worst.ulg"),
    "compare_methods": ("siso-vrft.gains.toml", "mimo-vrft.gains.toml"),
    "log_to_gains": ("my.gains.toml", "firmware/px4/README.md"),
}


RUN = subprocess.run


def in_this_process(line, *arguments, **options):
    """A command of an example, without the start of a process; other programs, such as compilers, run as they are."""
    if line[:3] != [sys.executable, "-m", "mimopilot"]:
        return RUN(line, *arguments, **options)
    done = run_here(options["cwd"], *line[3:])
    assert done.returncode == 0, done.stderr
    return done


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_an_example_runs(path, tmp_path, monkeypatch, capfd):
    assert os.access(path, os.X_OK)
    monkeypatch.setattr(subprocess, "run", in_this_process)
    monkeypatch.setattr(sys, "argv", [str(path), str(tmp_path / "out"), "--quick"])
    runpy.run_path(str(path), run_name="__main__")
    assert all((tmp_path / "out" / name).stat().st_size for name in LEAVES[path.stem])
    shown = capfd.readouterr().out
    if path.stem == "log_to_gains":
        default, tuned = (float(row.split(" by ")[1].split()[0]) for row in shown.splitlines()[-2:])
        assert tuned < default / 3
    if path.stem == "compare_methods":
        siso, mimo = (float(row.split()[-3]) for row in shown.splitlines()[-2:])
        assert mimo < siso / 3
