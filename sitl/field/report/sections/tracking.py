"""Setpoint, reference model and response of each axis over time."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from mimopilot.common.charts import INJECTED, MODEL_COLOUR, SETPOINT_COLOUR
from mimopilot.common.figures import Chart, Line, Panel, thinned
from mimopilot.common.html_report import ReportTable, Section
from mimopilot.sitl.field.report.analysis.flight_data import ReportedFlight
from mimopilot.tuning.gains import Gains
from mimopilot.tuning.logs.inspection import AXES
from mimopilot.tuning.logs.resample import Interval, Series, sampling_period

#: Length of the detail, s: one or two manoeuvres.
DETAIL = 4.0
#: Share of the angles' range that setpoints must cover to be what moves the vehicle; of an injection they cover little.
LED = 0.5
#: Highest rate at which a reference model is run, Hz.
MODEL_RATE = 250.0

#: What the numbers in a model's name are.
MODEL_UNITS = "(rad/s, damping, delay in samples)"

Signal = NDArray[np.float64]


def tracking_section(flights: Sequence[ReportedFlight], sets: Sequence[Gains]) -> Section:
    """Angles, rates and torque of every flight, whole and in detail, with the errors as a table."""
    charts: list[Chart] = []
    rows: list[list[str]] = []
    for number, flight in enumerate(flights):
        charts += tracking_charts(flight, number, len(flights), next((one for one in sets if _models(one)), None))
        charts += yaw_charts(flight, number, len(flights))
        rows += _errors(flight, len(flights) > 1)
    if not charts:
        return Section("Setpoint and response", "Neither angles nor rates are logged: there is no response to show.")
    columns = ("", "roll RMS", "pitch RMS", "roll largest", "pitch largest")
    tables = [ReportTable("Setpoint minus response in the air", columns, rows)] if rows else []
    missing = "" if rows else "No setpoint is logged, so there is no tracking error."
    return Section("Setpoint and response", missing, charts=charts, tables=tables)


def tracking_charts(flight: ReportedFlight, number: int, count: int, model: Gains | None) -> list[Chart]:
    """The whole flight, and the stretch in which most happens."""
    if flight.signal("y_o") is None and flight.signal("y_i") is None:
        return []
    named = f" in {flight.label}" if count > 1 else ""
    source = _models(model) if model else None
    driven = f"the attitude model of the new gains, {source} {MODEL_UNITS}, driven by the flown setpoint."
    reference = f" Reference: {driven}" if source else ""
    whole = (
        (flight.airborne[0][0], flight.airborne[-1][1]) if flight.airborne else (0.0, flight.span[1] - flight.span[0])
    )
    charts = [
        Chart(
            f"tracking-{number + 1}",
            f"Roll and pitch{named}, in the air.{reference} Drag to zoom; double click: all.",
            _panels(flight, whole, model),
        )
    ]
    detail = busiest(flight, whole)
    if detail is not None and detail[1] - detail[0] < 0.7 * (whole[1] - whole[0]):
        text = f"The same in detail, where most happens: {detail[0]:.1f} to {detail[1]:.1f} s{named}."
        charts.append(Chart(f"tracking-detail-{number + 1}", text, _panels(flight, detail, model)))
    return charts


def yaw_charts(flight: ReportedFlight, number: int, count: int) -> list[Chart]:
    """Heading, yaw rate and yaw torque in the air; none if the log holds none of them."""
    yaw, parts = flight.recording.yaw, flight.airborne
    if not parts:
        return []
    panels = []
    for title, unit, setpoint, response, injected, factor in (
        ("heading", "[deg]", "r_o", "y_o", "", 180 / np.pi),
        ("yaw rate", "[deg/s]", "r_i", "y_i", "r_bar", 180 / np.pi),
        ("yaw torque", "(normalised)", "", "u", "u_bar", 1.0),
    ):
        lines = []
        for name, label, look in (
            (setpoint, "setpoint", {"colour": SETPOINT_COLOUR, "width": 1.0, "step": True}),
            (response, "torque u" if response == "u" else "response", {"colour": flight.colour, "width": 1.3}),
            (injected, "injected", {"colour": INJECTED, "width": 0.9, "step": True}),
        ):
            if name in yaw:
                series = flight.since_begin(yaw[name])
                inside = (series.time >= parts[0][0]) & (series.time <= parts[-1][1])
                x, y = flight.drawn(series.time[inside], factor * series.values[inside, 0])
                if len(y) > 1 and (name != injected or y.any()):
                    lines.append(Line(x, y, label, **look))  # type: ignore[arg-type]
        if response in yaw and lines and np.ptp(yaw[response].values):  # a column of zeros is no signal
            panels.append(Panel(title, "time [s]", unit, lines, height=230))
    named = f" in {flight.label}" if count > 1 else ""
    text = f"Yaw{named}, in the air."
    return [Chart(f"tracking-yaw-{number + 1}", text, panels, columns=len(panels))] if panels else []


def busiest(flight: ReportedFlight, whole: Interval) -> Interval | None:
    """The stretch of `DETAIL` in which the setpoint moves most, or the answer where that moves far more."""
    moved_by = {name: _largest_move(flight.signal(name), whole) for name in ("r_o", "y_o")}
    led = moved_by["r_o"] > LED * moved_by["y_o"]
    for name in ("r_o", "y_o", "y_i")[0 if led else 1 :]:
        series = flight.signal(name)
        if series is None:
            continue
        inside = (series.time >= whole[0]) & (series.time <= whole[1])
        time, values = series.time[inside], series.values[inside]
        if len(time) < 10 or not np.ptp(values, axis=0).any() or time[-1] - time[0] < DETAIL:
            continue
        moved = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(values, axis=0)).sum(axis=1))])
        starts = np.arange(time[0], time[-1] - DETAIL, DETAIL / 4)
        if not len(starts):
            return None
        amount = np.interp(starts + DETAIL, time, moved) - np.interp(starts, time, moved)
        begin = float(starts[int(np.argmax(amount))])
        return begin, begin + DETAIL
    return None


def _largest_move(series: Series | None, part: Interval) -> float:
    """Peak to peak of a signal in a part, the larger axis; 0: not logged there."""
    if series is None:
        return 0.0
    inside = (series.time >= part[0]) & (series.time <= part[1])
    return float(np.ptp(series.values[inside], axis=0).max()) if inside.any() else 0.0


def _panels(flight: ReportedFlight, part: Interval, model: Gains | None) -> list[Panel]:
    rows = (
        ("angle", "[deg]", "r_o", "y_o", "", 180 / np.pi),
        ("rate", "[deg/s]", "r_i", "y_i", "r_bar", 180 / np.pi),
        ("torque", "(normalised)", "", "u", "u_bar", 1.0),
    )
    panels = []
    for what, unit, setpoint, answer, injected, factor in rows:
        for axis, name in enumerate(AXES):
            lines = []
            if answer == "y_o" and model is not None:
                lines += _reference(flight, part, axis, model)
            for signal, label, look in (
                (setpoint, "setpoint", {"colour": SETPOINT_COLOUR, "width": 1.0, "step": True}),
                (answer, "torque u" if answer == "u" else "response", {"colour": flight.colour, "width": 1.3}),
                (injected, "injected", {"colour": INJECTED, "width": 0.9, "step": True}),
            ):
                series = flight.signal(signal) if signal else None
                if series is not None:
                    inside = (series.time >= part[0]) & (series.time <= part[1])
                    x, y = flight.drawn(series.time[inside], factor * series.values[inside, axis])
                    if len(y) > 1 and (label != "injected" or y.any()):
                        lines.append(Line(x, y, label, **look))  # type: ignore[arg-type]
            if any(line.label in ("response", "torque u") for line in lines):
                panels.append(Panel(f"{name} {what}", "time [s]", unit, lines, x_range=part, height=230))
    return panels


def _models(gains: Gains) -> str:
    """The attitude model of a set, in words; empty: it has none."""
    followed = gains.filters.followed
    if followed is not None:
        return followed.label
    return gains.reference_models(0)[1].label if gains.provenance.outer_model else ""


def _reference(flight: ReportedFlight, part: Interval, axis: int, gains: Gains) -> list[Line]:
    """The answer of a set's attitude model to the flown setpoint."""
    setpoint = flight.signal("r_o")
    if setpoint is None or np.ptp(setpoint.values[:, axis]) <= 0:
        return []
    model = gains.filters.followed or gains.reference_models(axis)[1]
    grid = np.arange(setpoint.time[0], setpoint.time[-1], gains.Ts)
    held = setpoint.values[np.maximum(np.searchsorted(setpoint.time, grid, side="right") - 1, 0), axis]
    answer = model.response(held[:, None] - held[0])[:, 0] + held[0]
    inside = (grid >= part[0]) & (grid <= part[1])
    x, y = thinned(grid[inside], np.degrees(answer[inside]), flight.samples)
    return [Line(x, y, "reference", MODEL_COLOUR, width=2.4)]


def _errors(flight: ReportedFlight, several: bool) -> list[list[str]]:
    """Rows of the table: RMS and largest error of angle and rate in the air."""
    rows = []
    for what, unit, setpoint, answer in (("angle", "deg", "r_o", "y_o"), ("rate", "deg/s", "r_i", "y_i")):
        error = tracking_error(flight.signal(setpoint), flight.signal(answer), flight.airborne)
        if error is not None:
            size = [f"{value:.2f}" for value in (*np.sqrt(np.mean(error**2, axis=0)), *np.abs(error).max(axis=0))]
            rows.append([f"{what} [{unit}]{f', {flight.label}' if several else ''}", *size])
    return rows


def tracking_error(setpoint: Series | None, answer: Series | None, parts: Sequence[Interval]) -> Signal | None:
    """Setpoint minus response at the times of the answer in some intervals, (N, 2), degrees; None: not logged."""
    if setpoint is None or answer is None or sampling_period(answer.time) <= 0:
        return None
    inside = np.any([(answer.time >= a) & (answer.time <= b) for a, b in parts], axis=0) if parts else np.zeros(1, bool)
    inside = inside & (answer.time >= setpoint.time[0]) & (answer.time <= setpoint.time[-1])
    if np.count_nonzero(inside) < 2:
        return None
    held = setpoint.values[np.searchsorted(setpoint.time, answer.time[inside], side="right") - 1]
    return np.asarray(np.degrees(held - answer.values[inside]), np.float64)
