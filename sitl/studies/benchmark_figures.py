"""Plots of the benchmark studies: each closed loop beside the reference model."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from mimopilot.sitl.flight.figures import MODEL, STYLES
from mimopilot.sitl.studies.benchmarks import Benchmark
from mimopilot.tuning.law import Filters
from mimopilot.tuning.loop_controller import LoopController, closed_loop, complementary_sensitivity

#: (colour, line style) of each controller: Okabe and Ito's palette for colour blindness.
LINES = (*STYLES[:4], (STYLES[4][0], (0, (5, 1, 1, 1, 1, 1))))


def step_figure(task: Benchmark, controllers: Mapping[str, LoopController], samples: int, title: str) -> Figure:
    """Noise-free response of both outputs (rows) to a unit step of each setpoint (columns)."""
    figure, panels = _panels(title)
    time = np.arange(samples) * task.plant.Ts
    for j in range(2):
        inputs = np.zeros((samples, 6))
        inputs[:, j] = 1.0
        for i in range(2):
            wanted = task.model.response(inputs[:, j]) if i == j else np.zeros(samples)
            panels[i, j].step(time, wanted, where="post", label="reference model", **MODEL)
        for (label, controller), (colour, style) in zip(controllers.items(), LINES, strict=False):
            y = closed_loop(task.plant, controller).simulate(inputs)[:, 2:]
            for i in range(2):
                line = {"color": colour, "linestyle": style, "linewidth": 1.6, "label": label}
                panels[i, j].step(time, y[:, i], where="post", **line)
        panels[0, j].set_title(f"step of setpoint {j + 1}", fontsize=10)
        panels[1, j].set_xlabel("time [s]")
        panels[j, 0].set_ylabel(f"output {j + 1} [-]")
    panels[0, 0].legend(fontsize=8)
    return figure


def sensitivity_figure(task: Benchmark, controllers: Mapping[str, LoopController], title: str) -> Figure:
    """Magnitude of each element of T over frequency, beside the reference model."""
    figure, panels = _panels(title)
    Ts = task.plant.Ts
    omega = np.geomspace(1e-3, 1, 400) * np.pi / Ts
    plant, wanted = task.plant.frequency_response(omega), np.abs(task.model.frequency_response(omega))
    for i in range(2):
        panels[i, i].loglog(omega, wanted, label="reference model", **MODEL)
        for (label, controller), (colour, style) in zip(controllers.items(), LINES, strict=False):
            T = np.abs(complementary_sensitivity(plant, controller, omega))
            for j in range(2):
                panels[i, j].loglog(omega, T[:, i, j], color=colour, linestyle=style, linewidth=1.6, label=label)
        for j in range(2):
            panels[i, j].set_ylim(1e-3, 3)
            panels[i, j].set_ylabel(f"|T({i + 1},{j + 1})| [-]")
        panels[1, i].set_xlabel("frequency [rad/s]")
    panels[0, 0].legend(fontsize=8)
    return figure


def spread_figure(task: Benchmark, gains: NDArray[np.float64], samples: int, title: str) -> Figure:
    """Figure 5.2: steps of the setpoints with the gains of every run, in grey, and their mean.

    Parameters
    ----------
    task : Benchmark
    gains : (runs, 2, 2, 2) array
        See `sitl.studies.benchmark_studies.gain_spread`.
    samples : int
        Length of the steps.
    title : str
    """
    figure, panels = _panels(title)
    time = np.arange(samples) * task.plant.Ts
    for j in range(2):
        inputs = np.zeros((samples, 6))
        inputs[:, j] = 1.0
        loops = (LoopController(dict(zip("PI", run, strict=True)), Filters(task.plant.Ts)) for run in gains)
        steps = np.array([closed_loop(task.plant, loop).simulate(inputs)[:, 2:] for loop in loops])
        for i in range(2):
            # Drawn as pixels: so many lines would be most of the size of a report.
            panels[i, j].plot(time, steps[:, :, i].T, color="#999999", linewidth=0.4, rasterized=True)
            wanted = task.model.response(inputs[:, j]) if i == j else np.zeros(samples)
            panels[i, j].plot(time, wanted, label="reference model", color="black", linewidth=1.2, linestyle=":")
            panels[i, j].plot(time, steps[:, :, i].mean(axis=0), label="mean", color=STYLES[1][0], linewidth=1.6)
        panels[0, j].set_title(f"step of setpoint {j + 1}", fontsize=10)
        panels[1, j].set_xlabel("time [s]")
        panels[j, 0].set_ylabel(f"output {j + 1} [-]")
    panels[0, 0].legend(fontsize=8)
    return figure


def _panels(title: str) -> tuple[Figure, Any]:
    figure = Figure(figsize=(9, 6), layout="constrained")
    panels: Any = figure.subplots(2, 2, sharex=True)
    for panel in panels.flat:
        panel.grid(alpha=0.3)
    figure.suptitle(title, x=0.02, ha="left")
    return figure, panels
