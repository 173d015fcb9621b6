"""Figures of the benchmark studies: each closed loop beside the reference model."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from mimopilot.common.charts import MODEL_COLOUR, NEW
from mimopilot.common.figures import Chart, Line, Panel
from mimopilot.sitl.studies.benchmarks import Benchmark
from mimopilot.tuning.law_filters import Filters
from mimopilot.tuning.loop_controller import LoopController, closed_loop, complementary_sensitivity

#: Colour and line style of each controller, in their order.
Looks = Sequence[tuple[str, str]]


def step_chart(
    name: str, caption: str, task: Benchmark, controllers: Mapping[str, LoopController], looks: Looks, samples: int
) -> Chart:
    """Noise-free response of both outputs (rows) to a unit step of each setpoint (columns)."""
    time = np.arange(samples) * task.plant.Ts
    steps = {label: _steps(task, controller, samples) for label, controller in controllers.items()}
    panels = []
    for i in range(2):
        for j in range(2):
            wanted = task.model.response(np.ones(samples)) if i == j else np.zeros(samples)
            lines = [_reference(time, wanted, step=True)]
            for (label, y), look in zip(steps.items(), looks, strict=True):
                lines.append(Line(time, y[j][:, i], label, *look, step=True))
            panels.append(Panel(f"step of setpoint {j + 1}: output {i + 1}", "time [s]", "[-]", lines))
    return Chart(name, caption, panels)


def sensitivity_chart(
    name: str, caption: str, task: Benchmark, controllers: Mapping[str, LoopController], looks: Looks
) -> Chart:
    """Magnitude of each element of T over frequency, beside the reference model."""
    Ts = task.plant.Ts
    omega = np.geomspace(1e-3, 1, 400) * np.pi / Ts
    plant, wanted = task.plant.frequency_response(omega), np.abs(task.model.frequency_response(omega))
    found = {label: np.abs(complementary_sensitivity(plant, one, omega)) for label, one in controllers.items()}
    panels = []
    for i in range(2):
        for j in range(2):
            lines = [_reference(omega, wanted)] if i == j else []
            for (label, T), look in zip(found.items(), looks, strict=True):
                lines.append(Line(omega, T[:, i, j], label, *look))
            scales: Any = {"log_x": True, "log_y": True, "y_range": (1e-3, 3.0)}
            panels.append(Panel(f"|T({i + 1},{j + 1})|", "frequency [rad/s]", "[-]", lines, **scales))
    return Chart(name, caption, panels)


def _reference(x: NDArray[Any], y: NDArray[Any], step: bool = False) -> Line:
    return Line(x, y, "reference", MODEL_COLOUR, width=3.0, step=step, opacity=0.6)


def _steps(task: Benchmark, controller: LoopController, samples: int) -> list[NDArray[np.float64]]:
    """Both outputs (samples, 2) after a unit step of each setpoint."""
    found = []
    for j in range(2):
        inputs = np.zeros((samples, 6))
        inputs[:, j] = 1.0
        found.append(closed_loop(task.plant, controller).simulate(inputs)[:, 2:])
    return found


def spread_figure(task: Benchmark, gains: NDArray[np.float64], samples: int, title: str) -> Figure:
    """Figure 5.2: steps of the setpoints with the gains of every run, in grey, and their mean.

    Not interactive: hundreds of lines are drawn as pixels.

    Parameters
    ----------
    task : Benchmark
    gains : (runs, 2, 2, 2) array
        See `sitl.studies.benchmark_studies.gain_spread`.
    samples : int
        Length of the steps.
    title : str
    """
    figure = Figure(figsize=(9, 6), layout="constrained")
    panels: Any = figure.subplots(2, 2, sharex=True)
    figure.suptitle(title, x=0.02, ha="left")
    time = np.arange(samples) * task.plant.Ts
    loops = [LoopController(dict(zip("PI", run, strict=True)), Filters(task.plant.Ts)) for run in gains]
    every = np.array([_steps(task, loop, samples) for loop in loops])  # (runs, setpoint, samples, output)
    for j in range(2):
        for i in range(2):
            steps = every[:, j, :, i]
            panels[i, j].grid(alpha=0.3)
            panels[i, j].plot(time, steps.T, color="#999999", linewidth=0.4, rasterized=True)
            wanted = task.model.response(np.ones(samples)) if i == j else np.zeros(samples)
            panels[i, j].plot(time, wanted, label="reference", color=MODEL_COLOUR, linewidth=3.0, alpha=0.6)
            panels[i, j].plot(time, steps.mean(axis=0), label="mean", color=NEW, linewidth=1.6)
        panels[0, j].set_title(f"step of setpoint {j + 1}", fontsize=10)
        panels[1, j].set_xlabel("time [s]")
        panels[j, 0].set_ylabel(f"output {j + 1} [-]")
    panels[0, 0].legend(fontsize=8)
    return figure
