"""Figures of the attitude studies: tracking, motor commands, gains and costs with their spread."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mimopilot.common import charts
from mimopilot.common.figures import Chart, LimitLine, Line, Panel, thinned
from mimopilot.sitl.flight.figures import BEFORE, FROM_START, OVERVIEW_SAMPLES
from mimopilot.sitl.flight.metrics import FIGURE_LABELS, reference_responses
from mimopilot.sitl.flight.scenario import AXES
from mimopilot.sitl.flight.simulator import Flight
from mimopilot.sitl.studies.attitude_run import AttitudeRun
from mimopilot.sitl.studies.attitude_statistics import StudyStatistics
from mimopilot.sitl.studies.attitude_study import (
    AUTOTUNE,
    BEST,
    DEFAULT,
    MIMO,
    MIMO_PRINTED,
    MIMO_THESIS,
    PRINTED_KEYS,
    SISO,
    SISO_OWN,
    SISO_PRINTED,
    SISO_THESIS,
    AttitudeStudy,
)

#: Method -> colour and line style; flown, SISO and MIMO as in every report.
LOOKS = {
    DEFAULT: (charts.FLOWN, ":"),
    AUTOTUNE: (charts.FIFTH, "--"),
    SISO_THESIS: (charts.FIFTH, ":"),
    SISO_OWN: (charts.FIFTH, "-."),
    SISO_PRINTED: (charts.FIFTH, "-"),
    MIMO_THESIS: (charts.FURTHER, "-."),
    MIMO_PRINTED: (charts.FURTHER, "-"),
    SISO: (charts.SISO, "--"),
    MIMO: (charts.NEW, "-"),
    BEST: (charts.FURTHER, "--"),
}
#: Methods in the time histories.
TUNED = (SISO_THESIS, MIMO_THESIS, SISO, MIMO)
MATRICES = {"Kp_o": "1/s", "Kp_i": "s", "Ki_i": "-", "Kd_i": "s^2"}
ELEMENTS = ("roll<-roll", "roll<-pitch", "pitch<-roll", "pitch<-pitch")
#: Figure -> label.
COSTS = {name: FIGURE_LABELS[name] for name in ("J_M_o", "J_M_i", "J_r_o", "J_r_i", "offaxis_peak_deg", "effort_rms")}
#: J_M,o against the attitude model of MIMO's design, for all methods alike.
SAME_MODEL, SAME_MODEL_LABEL = "J_M_o_design", "J_M,o, MIMO's model"
#: Percentiles at the ends of the bars.
LOW, HIGH = 5, 95
#: Height of a panel with one row per method: of its frame, and of a row, px.
FRAME, ROW = 130, 22
#: Figures over all runs; the others are of one run.
OF_ALL_RUNS = ("gains", "costs")
#: Height of a motor's panel, px.
MOTOR = 170
#: Length of the detail of the motors in an experiment, s.
MOTOR_DETAIL = 2.0
#: Least ratio of the largest to the least cost that is drawn on a logarithmic axis, and the room at its ends.
DECADE, ROOM = 10.0, 1.2

#: Rows of a panel: place, values of every seed, colour, marker, label.
Row = tuple[float, NDArray[np.float64], str, str, str]


def tracking_chart(found: AttitudeRun, study: AttitudeStudy) -> Chart:
    """Error of angle and rate to the reference models of their setpoints, in both doublets."""
    panels = []
    for place, (name, title, unit) in enumerate((("attitude", "angle", "[deg]"), ("rates", "rate", "[deg/s]"))):
        for column, axis in enumerate(AXES):
            lines = []
            for method in _drawn(found):
                flight = found.flights[method][column]
                model = reference_responses(flight, *study.models(method, flight.scenario.Ts))[place]
                shown = _shown(flight)
                error = np.degrees(flight.record[name][shown, column] - model[shown])
                lines.append(Line(_time(flight)[shown], error, method, *LOOKS[method]))
            panels.append(Panel(f"{axis} doublet: {title} minus model", FROM_START, unit, lines))
    return Chart(f"{study.name}-tracking", "Measured minus reference model; each method's own model.", panels)


def _drawn(found: AttitudeRun) -> list[str]:
    """The methods of a run whose time histories are drawn."""
    return [method for method in TUNED if method in found.flights]


def _time(flight: Flight) -> NDArray[np.float64]:
    """Time from the start of the doublet, s, (N,)."""
    return np.asarray((np.arange(len(flight.record)) - flight.scenario.window[0]) * flight.scenario.Ts, np.float64)


def _shown(flight: Flight) -> NDArray[np.bool_]:
    """Samples from shortly before the doublet until one doublet length after it, (N,)."""
    start, stop = flight.scenario.window
    return np.asarray((_time(flight) >= -BEFORE) & (_time(flight) <= 2 * (stop - start) * flight.scenario.Ts))


def motors_chart(found: AttitudeRun, rotors: int, name: str) -> Chart:
    """Commands of all motors in both doublets, one row of panels per motor."""
    panels = []
    for motor in range(rotors):
        for column, axis in enumerate(AXES):
            lines = []
            for method in _drawn(found):
                flight = found.flights[method][column]
                shown = _shown(flight)
                command = flight.record["commands"][shown, motor]
                lines.append(Line(_time(flight)[shown], command, method, *LOOKS[method], step=True))
            title = f"{axis} doublet: motor {motor + 1}"
            panels.append(Panel(title, FROM_START, "[-]", lines, y_range=(-0.05, 1.05), height=MOTOR + 40))
    return Chart(f"{name}-motors", "Motor commands in the doublets (thrust, 0 to 1).", panels)


def experiment_motors_chart(flight: Flight, rotors: int, name: str) -> Chart:
    """Commands of all motors in the experiment, with the mean of each; a detail where roll ends and pitch begins."""
    time = np.asarray(np.arange(len(flight.record)) * flight.scenario.Ts, np.float64)
    middle = time[-1] / 2
    detail = (middle - MOTOR_DETAIL / 2, middle + MOTOR_DETAIL / 2)
    near = (time >= detail[0]) & (time <= detail[1])
    panels = []
    for motor in range(rotors):
        command = flight.record["commands"][:, motor]
        mean = [LimitLine(float(command.mean()), colour=charts.SETPOINT_COLOUR, dash="-")]
        whole = [Line(*thinned(time, command, OVERVIEW_SAMPLES), colour=charts.FLOWN, width=0.8)]
        part = [Line(time[near], command[near], colour=charts.FLOWN, width=1.3, step=True)]
        title = f"motor {motor + 1}, mean {command.mean():.3f}"
        span = (0.0, float(time[-1]))
        panels += [
            Panel(title, "time [s]", "[-]", whole, mean, x_range=span, height=MOTOR),
            Panel(f"motor {motor + 1}, in detail", "time [s]", "[-]", part, mean, x_range=detail, height=MOTOR),
        ]
    caption = "Motor commands in the experiment (thrust, 0 to 1), with the mean of each."
    return Chart(f"{name}-experiment-motors", caption, panels, linked=False)


def gains_chart(found: StudyStatistics, printed: Mapping[str, Any], table: str) -> Chart:
    """Median and 5 to 95 % of every gain over the seeds; a cross marks a value printed in the thesis."""
    methods = found.study.methods()[::-1]
    panels = []
    for name, unit in MATRICES.items():
        for element, label in enumerate(ELEMENTS):
            rows: list[Row] = [
                (place, found.gains(method, name).reshape(-1, 4)[:, element], LOOKS[method][0], "o", "")
                for place, method in enumerate(methods)
            ]
            crosses = {
                float(place): float(np.ravel(printed[key][name])[element])
                for place, method in enumerate(methods)
                if (key := PRINTED_KEYS.get(method, "")) in printed
            }
            lines = [*_bars(rows, methods), *_crosses(crosses, f"{table} as printed")]
            zero = [LimitLine(0.0, colour=charts.MODEL_COLOUR, upright=True, dash="-")]
            panels.append(_by_method(f"{name}, {label}", f"{name} [{unit}]", lines, methods, zero))
    caption = f"Median and {LOW} to {HIGH} % of the gains of {len(found.runs)} experiments."
    return Chart(f"{found.study.name}-gains", caption, panels, linked=False)


def costs_chart(found: StudyStatistics, methods: Sequence[str], printed: Mapping[str, Any], axis_printed: str) -> Chart:
    """Median and 5 to 95 % of every cost over the seeds, by method, for roll and pitch."""
    names, panels = list(methods)[::-1], []
    for name, text in COSTS.items():
        rows: list[Row] = [
            (place + shift, found.values(method, axis, name), colour, marker, f"{axis} doublet")
            for axis, shift, colour, marker in zip(AXES, (0.16, -0.16), charts.AXIS_COLOURS[:2], "os", strict=True)
            for place, method in enumerate(names)
        ]
        side = 0.16 if axis_printed == AXES[0] else -0.16
        crosses = {
            place + side: float(flown[name])
            for place, method in enumerate(names)
            if name in (flown := printed.get(PRINTED_KEYS.get(method, ""), {}))
        }
        lines = [*_bars(rows, names), *_crosses(crosses, "printed, real flight")]
        panels.append(_by_method(text.partition(" [")[0], text, lines, names, stretched=True))
    caption = f"Median and {LOW} to {HIGH} % of the figures of {len(found.runs)} seeds."
    return Chart(f"{found.study.name}-costs", caption, panels, linked=False)


def _bars(rows: Sequence[Row], methods: Sequence[str]) -> list[Line]:
    """A bar from `LOW` to `HIGH` and a marker at the median for each row; rows of one look are one line."""
    lines: list[Line] = []
    for colour, marker, label in dict.fromkeys(row[2:] for row in rows):
        alike = [(place, values) for place, values, *look in rows if tuple(look) == (colour, marker, label)]
        y = np.array([place for place, _ in alike])
        # A lost flight has infinite costs, for which a plot has no place.
        found = np.array([np.percentile(values, [LOW, 50, HIGH]) for _, values in alike])
        found[~np.isfinite(found)] = np.nan
        ends = np.column_stack([found[:, 0], found[:, 2], np.full(len(y), np.nan)]).ravel()
        text = [
            f"{methods[round(place)]}: {middle:.4g}, {LOW} to {HIGH} %: {low:.4g} to {high:.4g}"
            for place, (low, middle, high) in zip(y, found, strict=True)
        ]
        lines.append(Line(ends, np.repeat(y, 3), colour=colour, width=3.0))
        lines.append(Line(found[:, 1], y, label, colour, width=0, marker=marker, text=text))
    return lines


def _crosses(values: Mapping[float, float], label: str) -> list[Line]:
    """Printed values at the places of their methods."""
    if not values:
        return []
    x, y = np.array([*values.values()]), np.array([*values])
    return [
        Line(x, y, label, charts.SETPOINT_COLOUR, width=0, marker="x", text=[f"{label}: {value:.4g}" for value in x])
    ]


def _by_method(
    title: str,
    label: str,
    lines: Sequence[Line],
    methods: Sequence[str],
    marks: Sequence[LimitLine] = (),
    stretched: bool = False,
) -> Panel:
    """A panel with a row for each method; `stretched`: logarithmic where the values need it."""
    values = np.concatenate([line.x for line in lines])
    low, high = float(np.nanmin(values)), float(np.nanmax(values))
    log = stretched and low > 0 and high > DECADE * low
    span = (low / ROOM, high * ROOM) if log else None
    height = FRAME + ROW * len(methods)
    return Panel(title, label, "", lines, marks, log_x=log, x_range=span, y_names=methods, height=height)
