"""Plots of the attitude studies: tracking, motor commands, gains and costs with their spread."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter
from numpy.typing import NDArray

from mimopilot.common.charts import AXIS_COLOURS, FIFTH, FLOWN, STYLES
from mimopilot.sitl.flight.metrics import FIGURE_LABELS, reference_responses
from mimopilot.sitl.flight.scenario import AXES
from mimopilot.sitl.flight.simulator import Flight
from mimopilot.sitl.studies.attitude_run import AttitudeRun
from mimopilot.sitl.studies.attitude_statistics import StudyStatistics
from mimopilot.sitl.studies.attitude_study import (
    MIMO,
    MIMO_THESIS,
    PRINTED_KEYS,
    SISO,
    SISO_THESIS,
    AttitudeStudy,
)

#: Methods in the plots; method -> (colour, line style) and marker.
TUNED = (SISO_THESIS, MIMO_THESIS, SISO, MIMO)
LOOK = {
    SISO_THESIS: ((FIFTH, ":"), "s"),
    MIMO_THESIS: (STYLES[3], "o"),
    SISO: (STYLES[1], "^"),
    MIMO: (STYLES[2], "v"),
}
PRINTED = {"color": "black", "marker": "x", "markersize": 7, "markeredgewidth": 1.6, "linestyle": "none"}
MATRICES = {"Kp_o": "1/s", "Kp_i": "s", "Ki_i": "-", "Kd_i": "s^2"}
ELEMENTS = ("roll<-roll", "roll<-pitch", "pitch<-roll", "pitch<-pitch")
#: Figure -> label.
COSTS = {name: FIGURE_LABELS[name] for name in ("J_M_o", "J_M_i", "J_r_o", "J_r_i", "offaxis_peak_deg", "effort_rms")}
#: J_M,o against the attitude model of MIMO's design, for all methods alike.
SAME_MODEL, SAME_MODEL_LABEL = "J_M_o_design", "J_M,o, MIMO's model"
#: Percentiles at the ends of the bars.
LOW, HIGH = 5, 95


def tracking_figure(found: AttitudeRun, study: AttitudeStudy) -> Figure:
    """Error of angle and rate to the reference models of their setpoints, in both doublets."""
    figure = Figure(figsize=(9, 5.5), layout="constrained")
    panels: Any = figure.subplots(2, 2, sharex=True, sharey="row")
    for method, (colour, style) in _lines(found):
        for column, (axis, flight) in enumerate(zip(AXES, found.flights[method], strict=True)):
            scenario, record = flight.scenario, flight.record
            models = reference_responses(flight, *study.models(method, scenario.Ts))
            shown = _shown(flight)
            for panel, name, model in zip(panels[:, column], ("attitude", "rates"), models, strict=True):
                line = {"color": colour, "linestyle": style, "linewidth": 1.5, "label": method}
                panel.plot(_time(flight)[shown], np.degrees(record[name][shown, column] - model[shown]), **line)
            panels[0, column].set_title(f"{axis} doublet", loc="left", fontsize=10)
            panels[1, column].set_xlabel("time from the start of the doublet [s]")
    for panel, text in zip(panels[:, 0], ("angle - model [deg]", "rate - model [deg/s]"), strict=True):
        panel.set_ylabel(text)
    for panel in panels.flat:
        panel.grid(alpha=0.3)
        panel.axhline(0, color="black", linewidth=0.6)
    _legend(figure, panels[0, 0])
    figure.suptitle(f"{study.title}: measured minus reference model", x=0.02, ha="left")
    return figure


def _lines(found: AttitudeRun) -> list[tuple[str, Any]]:
    """The plotted methods of a run, with their colour and line style."""
    return [(method, line) for method, (line, _) in LOOK.items() if method in found.flights]


def _time(flight: Flight) -> NDArray[np.float64]:
    """Time from the start of the doublet, s, (N,)."""
    return np.asarray((np.arange(len(flight.record)) - flight.scenario.window[0]) * flight.scenario.Ts, np.float64)


def _shown(flight: Flight) -> NDArray[np.bool_]:
    """Samples from 0.1 s before the doublet until one doublet length after it, (N,)."""
    start, stop = flight.scenario.window
    return np.asarray((_time(flight) >= -0.1) & (_time(flight) <= 2 * (stop - start) * flight.scenario.Ts))


def motors_figure(found: AttitudeRun, rotors: int, title: str) -> Figure:
    """Commands of all motors in both doublets, one row of panels per motor."""
    figure = Figure(figsize=(9, 1.5 + 1.5 * rotors), layout="constrained")
    panels: Any = figure.subplots(rotors, 2, sharex=True, sharey=True)
    for method, (colour, style) in _lines(found):
        for column, flight in enumerate(found.flights[method]):
            shown = _shown(flight)
            for motor in range(rotors):
                line = {"color": colour, "linestyle": style, "linewidth": 1.5, "label": method}
                command = flight.record["commands"][shown, motor]
                panels[motor, column].step(_time(flight)[shown], command, where="post", **line)
    for panel in panels.flat:
        panel.grid(alpha=0.3)
        panel.set_ylim(-0.05, 1.05)
    for motor in range(rotors):
        panels[motor, 0].set_ylabel(f"motor {motor + 1} [-]")
    for column, axis in enumerate(AXES):
        panels[0, column].set_title(f"{axis} doublet", loc="left", fontsize=10)
        panels[-1, column].set_xlabel("time from the start of the doublet [s]")
    _legend(figure, panels[0, 0])
    figure.suptitle(f"{title}: motor commands (thrust, 0 to 1)", x=0.02, ha="left")
    return figure


def experiment_motors_figure(flight: Flight, rotors: int, title: str) -> Figure:
    """Commands of all motors in the experiment, with the mean of each; a detail where roll ends and pitch begins."""
    figure = Figure(figsize=(9, 1.5 + 1.3 * rotors), layout="constrained")
    panels: Any = figure.subplots(rotors, 2, sharex="col", sharey=True, width_ratios=[3, 2])
    time = np.arange(len(flight.record)) * flight.scenario.Ts
    for motor in range(rotors):
        command = flight.record["commands"][:, motor]
        # As in `experiment_figure`: the overview is drawn as pixels.
        for panel, width, pixels in zip(panels[motor], (0.4, 1.2), (True, False), strict=True):
            panel.step(time, command, where="post", color=FLOWN, linewidth=width, rasterized=pixels)
            panel.axhline(command.mean(), color="black", linewidth=0.8)
            panel.grid(alpha=0.3)
        panels[motor, 0].set_ylabel(f"motor {motor + 1} [-]")
        panels[motor, 0].set_title(f"mean {command.mean():.3f}", loc="left", fontsize=9)
    middle = time[-1] / 2
    for column, limits in enumerate(((time[0], time[-1]), (middle - 1.0, middle + 1.0))):
        panels[-1, column].set_xlabel("time [s]")
        panels[-1, column].set_xlim(*limits)
    figure.suptitle(f"{title}: motor commands in the experiment (thrust, 0 to 1)", x=0.02, ha="left")
    return figure


def gains_figure(found: StudyStatistics, printed: Mapping[str, Any], table: str) -> Figure:
    """Median and 5 to 95 % of every gain over the seeds; a cross marks a value printed in the thesis."""
    figure = Figure(figsize=(9, 8.5), layout="constrained")
    panels: Any = figure.subplots(4, 4)
    shown = {method: look for method, look in LOOK.items() if method in found.study.methods()}
    for row, (name, unit) in zip(panels, MATRICES.items(), strict=True):
        for element, panel in enumerate(row):
            for place, (method, look) in enumerate(shown.items()):
                values = found.gains(method, name).reshape(-1, 4)[:, element]
                _spread(panel, place, values, look, method)
                if (key := PRINTED_KEYS.get(method, "")) in printed:
                    value = np.ravel(printed[key][name])[element]
                    panel.plot(place + 0.25, value, label=f"{table} as printed", **PRINTED)
            panel.axhline(0, color="black", linewidth=0.6)
            panel.set_xlim(-0.6, len(shown) - 0.4)
            panel.set_xticks([])
            panel.grid(alpha=0.3, axis="y")
            panel.tick_params(labelsize=8)
        row[0].set_ylabel(f"{name} [{unit}]")
    for panel, text in zip(panels[0], ELEMENTS, strict=True):
        panel.set_title(text, fontsize=10)
    _legend(figure, panels[0, 0])
    title = f"{found.study.title}: gains, median and {LOW} to {HIGH} % of {len(found.runs)} experiments"
    figure.suptitle(title, x=0.02, ha="left")
    return figure


def costs_figure(
    found: StudyStatistics, methods: Sequence[str], printed: Mapping[str, Any], axis_printed: str
) -> Figure:
    """Median and 5 to 95 % of every cost over the seeds, by method, for roll and pitch."""
    figure = Figure(figsize=(9, 8.5), layout="constrained")
    panels: Any = figure.subplots(3, 2, sharey=True)
    places = np.arange(len(methods))[::-1]
    for panel, (name, text) in zip(panels.flat, COSTS.items(), strict=True):
        for axis, shift, colour, marker in zip(AXES, (0.16, -0.16), AXIS_COLOURS[:2], "os", strict=True):
            for place, method in zip(places, methods, strict=True):
                values = found.values(method, axis, name)
                low, middle, high = np.percentile(values, [LOW, 50, HIGH])
                panel.plot([low, high], [place + shift] * 2, color=colour, linewidth=2.2)
                filled = colour if axis == "roll" else "white"
                panel.plot(
                    middle,
                    place + shift,
                    marker,
                    color=colour,
                    markerfacecolor=filled,
                    markersize=6,
                    label=f"{axis} doublet",
                )
                flown = printed.get(PRINTED_KEYS.get(method, ""), {})
                if axis == axis_printed and name in flown:
                    panel.plot(flown[name], place + shift, label="printed, real flight", **PRINTED)
        low, high = panel.dataLim.x0, panel.dataLim.x1
        panel.set_xscale("log" if high > 10 * low else "linear")
        panel.xaxis.set_minor_formatter(NullFormatter())
        panel.set_xlabel(text)
        panel.set_yticks(places, methods)
        panel.grid(alpha=0.3, axis="x")
        panel.tick_params(labelsize=8)
    _legend(figure, panels[0, 0])
    title = f"{found.study.title}: median and {LOW} to {HIGH} % of {len(found.runs)} seeds"
    figure.suptitle(title, x=0.02, ha="left")
    return figure


def _spread(panel: Any, place: float, values: NDArray[np.float64], look: Any, label: str) -> None:
    (colour, _), marker = look
    low, middle, high = np.percentile(values, [LOW, 50, HIGH])
    panel.plot([place, place], [low, high], color=colour, linewidth=2.5)
    panel.plot(place, middle, marker, color=colour, markersize=6, label=label)


def _legend(figure: Figure, panel: Any) -> None:
    """A legend below the figure with each label of a panel once."""
    handles = dict(zip(*reversed(panel.get_legend_handles_labels()), strict=True))
    figure.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=4, fontsize=9)
