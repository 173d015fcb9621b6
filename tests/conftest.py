"""Fixtures shared by all tests."""

from __future__ import annotations

import io
import os
import subprocess
import sys
from collections.abc import Callable
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import replace
from functools import partial
from pathlib import Path

# As the command line does, before numpy is loaded: results are compared with printed ones.
os.environ["OPENBLAS_NUM_THREADS"] = os.environ["OMP_NUM_THREADS"] = os.environ["MKL_NUM_THREADS"] = "1"
# Parallel workers of pytest set it; what the tests read is a pipe.
os.environ.pop("COLUMNS", None)

import numpy as np
import pytest
from hypothesis import HealthCheck, settings

import mimopilot.cli.main as front_door
from mimopilot.tuning.gains import Gains, Limits, YawGains
from mimopilot.tuning.law_filters import Filters, StockFilters

#: No deadlines: tests must not depend on the machine's speed.
settings.register_profile("any machine", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("any machine")

Run = Callable[..., "subprocess.CompletedProcess[str]"]


#: Files that take longest, by far: they begin first, so that at the end no worker is left alone with one.
LONGEST = (
    "test_sitl.py",
    "test_attitude_studies.py",
    "test_certify.py",
    "test_campaign.py",
    "test_confidence_intervals.py",
    "test_package.py",
    "test_verdicts.py",
    "test_autotune_command.py",
    "test_response_design.py",
    "test_stability_figures.py",
    "test_sitl_links.py",
    "test_damage.py",
)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Sort the longest files to the front; all others keep their order."""
    place = {name: number for number, name in enumerate(LONGEST)}
    items.sort(key=lambda item: place.get(item.path.name, len(LONGEST)))


def pytest_addoption(parser: pytest.Parser) -> None:
    """Golden directories are rewritten on purpose only."""
    parser.addoption("--update-golden", action="store_true", help="rewrite the golden directories of tests/codegen")


def coupled_gains() -> Gains:
    """A full, coupled set with every term in use."""
    return Gains(
        Kp_o=np.array([[6.0, 0.3], [-0.2, 5.5]]),
        Kp_i=np.array([[0.15, 0.02], [0.01, 0.13]]),
        Ki_i=np.array([[0.25, 0.03], [-0.02, 0.2]]),
        Kd_i=np.array([[0.003, 0.0004], [0.0002, 0.002]]),
        Kff_i=np.array([[0.02, 0.001], [0.002, 0.03]]),
        yaw=YawGains(1.5, 0.5, 0.1, 0.01, 0.02),
        filters=Filters(Ts=0.004, derivative_cutoff_hz=30.0),
        limits=Limits(rate_max=(5.0, 4.0, 3.0), moment_max=(1.0, 0.9, 0.8), integral_max=(0.3, 0.25, 0.2)),
        moment_scale=(2.54592, 2.54592, 0.2736),
    )


def following_gains() -> Gains:
    """`coupled_gains` with model following: another controller, with both of its matrices full."""
    gains = coupled_gains()
    return replace(
        gains,
        filters=replace(gains.filters, model_omega=9.0, model_damping=0.8),
        Kff_o=np.array([[0.9, 0.04], [-0.03, 1.05]]),
        Kaff_i=np.array([[0.006, 0.0005], [-0.0004, 0.007]]),
    )


def stock_gains(controller: str = "px4-stock") -> Gains:
    """A set for a stock controller, every term and filter in use, each axis with its own."""
    filters = {
        "px4-stock": StockFilters("px4-stock", (30.0, 30.0, 30.0), torque_hz=(0.0, 0.0, 2.0)),
        "ardupilot-stock": StockFilters(
            "ardupilot-stock",
            derivative_hz=(20.0, 25.0, 10.0),
            setpoint_hz=(20.0, 22.0, 15.0),
            error_hz=(0.0, 30.0, 2.5),
            derivative_feedforward=(0.001, 0.002, 0.003),
            shaping_s=(0.15, 0.15, 0.15),
        ),
        "betaflight": StockFilters("betaflight", (75.0, 70.0, 65.0), derivative2_hz=(100.0, 110.0, 120.0)),
    }
    diagonal = {
        name: np.diag(np.diag(getattr(coupled_gains(), name))) for name in ("Kp_o", "Kp_i", "Ki_i", "Kd_i", "Kff_i")
    }
    base = replace(coupled_gains(), limits=Limits((5.0, 4.0, 3.0), integral_max=(0.3, 0.25, 0.2)))
    return replace(base, filters=Filters(0.0025, stock=filters[controller]), **diagonal)


@pytest.fixture
def gains() -> Gains:
    """See `coupled_gains`."""
    return coupled_gains()


def run_here(folder: Path, *arguments: object) -> subprocess.CompletedProcess[str]:
    """Run the command line from a folder in this process, which saves a start; returns what a process would."""
    output, errors, code = io.StringIO(), io.StringIO(), 0
    with pytest.MonkeyPatch.context() as patch, redirect_stdout(output), redirect_stderr(errors):
        patch.chdir(folder)
        patch.setattr(sys, "argv", ["mimopilot", *map(str, arguments)])
        patch.setattr(sys, "stdin", io.StringIO())
        try:
            front_door.main()
        except SystemExit as end:
            code = int(end.code or 0)
    return subprocess.CompletedProcess(arguments, code, output.getvalue(), errors.getvalue())


@pytest.fixture
def mimopilot(tmp_path: Path) -> Run:
    """`run_here` from the test's folder."""
    return partial(run_here, tmp_path)


@pytest.fixture
def mimopilot_process(tmp_path: Path) -> Run:
    """Run the command line as a user would, in a process of its own; returns the finished process."""

    def run(*arguments: object, **keywords: object) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, "-m", "mimopilot", *map(str, arguments)]
        return subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, timeout=300, **keywords)  # type: ignore[call-overload,no-any-return]

    return run


def assert_one_clear_line(result: subprocess.CompletedProcess[str], *words: str, code: int = 2) -> None:
    """The command failed with `code` and one message that holds `words`, and no traceback."""
    assert result.returncode == code, result.stderr
    assert "Traceback" not in result.stderr
    lines = result.stderr.strip().splitlines()
    assert len(lines) == 1, result.stderr
    for word in words:
        assert word in lines[0]
