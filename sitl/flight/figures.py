"""Figures of flights: time histories of a manoeuvre and of an experiment."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from mimopilot.common.charts import AXIS_COLOURS
from mimopilot.common.charts import STYLES as STYLES
from mimopilot.common.charts import svg as svg
from mimopilot.sitl.flight.metrics import reference_responses
from mimopilot.sitl.flight.scenario import AXES
from mimopilot.sitl.flight.simulator import Flight
from mimopilot.tuning.reference_model import ReferenceModel

MODEL = {"color": "#888888", "linewidth": 3.0, "alpha": 0.6}
ALL_AXES = (*AXES, "yaw")
SETPOINT = {"color": "black", "linewidth": 1.0}


def manoeuvre_figure(flights: Mapping[str, Flight], inner: ReferenceModel, outer: ReferenceModel) -> Figure:
    """One manoeuvre under several gain sets: angle, off-axis angle, rate and torque over time.

    Parameters
    ----------
    flights : mapping
        Label -> flight; all of the same scenario.
    inner, outer : ReferenceModel
        Of the rate loop and of the attitude loop.
    """
    first = next(iter(flights.values()))
    scenario, axis = first.scenario, first.scenario.axis
    other = 1 - axis
    time = (np.arange(len(first.record)) - scenario.window[0]) * scenario.Ts
    shown = time >= -0.1
    figure = Figure(figsize=(9, 9.5), layout="constrained")
    panels: Any = figure.subplots(4, 1, sharex=True)
    model, _ = reference_responses(first, inner, outer)
    time, setpoint = time[shown], first.record["setpoint"][shown, axis]
    panels[0].step(time, np.degrees(setpoint), where="post", label="setpoint", **SETPOINT)
    panels[0].plot(time, np.degrees(model[shown]), label=f"reference model ({outer.label})", **MODEL)
    for (label, flight), (colour, style) in zip(flights.items(), STYLES, strict=False):
        line = {"color": colour, "linestyle": style, "linewidth": 1.6, "label": label}
        truth = flight.truth[shown]
        panels[0].plot(time, np.degrees(truth["attitude"][:, axis]), **line)
        panels[1].plot(time, np.degrees(truth["attitude"][:, other]), **line)
        panels[2].plot(time, np.degrees(truth["rates"][:, axis]), **line)
        panels[3].step(time, flight.record["moment"][shown, axis], where="post", **line)
    for panel, text in zip(
        panels,
        (
            f"{AXES[axis]} angle [deg]",
            f"off-axis: {AXES[other]} [deg]",
            f"{AXES[axis]} rate [deg/s]",
            f"{AXES[axis]} torque u (normalised)",
        ),
        strict=True,
    ):
        panel.set_ylabel(text)
        panel.grid(alpha=0.3)
        panel.axvspan(0, (scenario.window[1] - scenario.window[0]) * scenario.Ts, color="#000000", alpha=0.04)
    _legend_below(figure, panels[0])
    panels[0].set_title(f"{AXES[axis].capitalize()} {scenario.name}", loc="left")
    panels[3].set_xlabel("time from the start of the manoeuvre [s] (shaded: window of the performance figures)")
    panels[3].set_xlim(time[0], time[-1])
    figure.align_ylabels(panels)
    return figure


def experiment_figure(flight: Flight, zoom_s: float = 3.0) -> Figure:
    """An experiment: injected and total torque, rates and angles of all axes; a detail on the right."""
    time = np.arange(len(flight.record)) * flight.scenario.Ts
    record = flight.record
    figure = Figure(figsize=(9, 7), layout="constrained")
    panels: Any = figure.subplots(4, 2, sharex="col", sharey="row", width_ratios=[3, 2])
    signals = (
        ("injected torque", record["excitation"]),
        ("total torque u", record["moment"]),
        ("body rate [deg/s]", np.degrees(record["rates"])),
        ("angle [deg]", np.degrees(record["attitude"])),
    )
    excitation = flight.scenario.excitation
    shown = [axis for axis in range(3) if axis < 2 or excitation[:, axis].any()]
    roll = np.flatnonzero(excitation[:, 0])
    middle = time[roll[-1]] if len(roll) and roll[-1] + 1 < len(time) else time[-1] / 2
    for row, (text, values) in zip(panels, signals, strict=True):
        # The overview is drawn as pixels: its lines would be most of the size of a report.
        for panel, width, pixels in zip(row, (0.4, 1.2), (True, False), strict=True):
            for axis in shown:
                line = {"color": AXIS_COLOURS[axis], "linewidth": width, "rasterized": pixels, "label": ALL_AXES[axis]}
                panel.step(time, values[:, axis], where="post", **line)
            panel.grid(alpha=0.3)
        row[0].set_ylabel(text)
    _legend_below(figure, panels[0, 1])
    panels[0, 0].set_title("Closed-loop experiment", loc="left")
    panels[0, 1].set_title("where roll ends and pitch begins", loc="left")
    for column, limits in enumerate(((time[0], time[-1]), (middle - zoom_s / 2, middle + zoom_s / 2))):
        panels[3, column].set_xlabel("time [s]")
        panels[3, column].set_xlim(*limits)
    figure.align_ylabels(panels)
    return figure


def _legend_below(figure: Figure, panel: Any) -> None:
    """The legend of one panel below all of them, where it lies over no curve."""
    figure.legend(*panel.get_legend_handles_labels(), loc="outside lower center", ncols=5, fontsize=9)
