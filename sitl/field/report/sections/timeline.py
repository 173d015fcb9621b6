"""Timeline: the phases of each flight, its angles and its motors; and what its log holds."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mimopilot.common.charts import AXIS_COLOURS
from mimopilot.common.figures import Chart, LimitLine, Line, Panel
from mimopilot.common.html_report import ReportTable, Section
from mimopilot.sitl.field.report.analysis.flight_data import PHASES, ReportedFlight
from mimopilot.tuning.axes import axis_names
from mimopilot.tuning.logs.resample import Series, sampling_period

#: Names of the signals, their factor from SI and unit in the table.
SIGNALS = {
    "u": ("torque (normalised)", 1.0, ""),
    "y_i": ("body rates", 180 / np.pi, "deg/s"),
    "y_o": ("angles", 180 / np.pi, "deg"),
    "r_o": ("attitude setpoint", 180 / np.pi, "deg"),
    "r_i": ("rate setpoint", 180 / np.pi, "deg/s"),
    "u_bar": ("injected torque", 1.0, ""),
    "r_bar": ("injected rate setpoint", 180 / np.pi, "deg/s"),
}
#: Changes of parameters that are marked in the timeline.
MOST_CHANGES = 8
#: Width of a phase's bar, px.
BAR = 12


def timeline(flights: Sequence[ReportedFlight], number: int) -> Chart | None:
    """The phases of one flight above its angles and motors; None if the log holds no signal."""
    flight = flights[number]
    length = flight.span[1] - flight.span[0]
    if length <= 0:
        return None
    names = [name for name, parts in flight.phases.items() if parts]
    bars = []
    for place, name in enumerate(reversed(names)):
        parts = flight.phases[name]
        x = np.concatenate([[a, b, np.nan] for a, b in parts])
        bars.append(Line(x, np.full(len(x), float(place)), colour=PHASES[name], width=BAR, label=_seconds(name, parts)))
    marks = []
    for time, name, value in flight.recording.changes:
        at = time - flight.span[0]
        if 0 < at < length and flight.recording.parameters_during(flight.span[0], flight.span[1])[1]:
            marks.append(LimitLine(at, f"{name} {value:.4g}", colour="#666666", upright=True, dash=":"))
    span = (0.0, length)
    panels = []
    if bars:
        panels.append(
            Panel(
                "Phases",
                "time [s]",
                "",
                bars[::-1],
                marks[:MOST_CHANGES],
                x_range=span,
                y_names=names[::-1],
                height=110 + 24 * len(names),
            )
        )
    angles, thrust = flight.signal("y_o"), flight.further.thrust
    if angles is not None:
        panels.append(Panel("Angles", "time [s]", "[deg]", _by_axis(angles, flight), x_range=span, height=220))
    elif flight.further.gyro is not None:
        lines = _by_axis(flight.since_begin(flight.further.gyro), flight)
        panels.append(Panel("Gyro", "time [s]", "[deg/s]", lines, x_range=span, height=220))
    lines = []
    if flight.further.motors is not None:
        motors = flight.since_begin(flight.further.motors)
        for column in range(motors.values.shape[1]):
            shade = ("#bbbbbb", "#999999", "#777777", "#555555")[column % 4]
            x, y = flight.drawn(motors.time, motors.values[:, column], 0.5)
            lines.append(Line(x, y, f"motor {column + 1}", shade, width=0.8))
    if thrust is not None and thrust.values.any():  # a column of zeros is no signal
        thrust = flight.since_begin(thrust)
        lines.append(Line(*flight.drawn(thrust.time, thrust.values[:, 0]), "thrust", "#1a1a1a", width=1.4))
    if lines:
        panels.append(Panel("Thrust and motors", "time [s]", "share of the largest", lines, x_range=span, height=220))
    if not panels:
        return None
    named = f" of {flight.label}" if len(flights) > 1 else ""
    return Chart(
        f"timeline-{number + 1}",
        f"Time{named} from the beginning of the log. Used: what gains are tuned from. Saturated: a torque or a motor "
        "at its limit in the air. Gaps: pauses of more than five periods in torque, rates or angles.",
        panels,
        columns=1,
    )


def _by_axis(series: Series, flight: ReportedFlight) -> list[Line]:
    """A line for each axis of angles or rates, in degrees."""
    looks = zip(axis_names(3), AXIS_COLOURS, series.values.T, strict=False)
    return [
        Line(*flight.drawn(series.time, np.degrees(values)), name, colour, width=1.0) for name, colour, values in looks
    ]


def timeline_section(flights: Sequence[ReportedFlight]) -> Section:
    """The timelines of all flights."""
    charts = [chart for number in range(len(flights)) if (chart := timeline(flights, number))]
    text = "" if charts else "The log holds none of the signals that this report draws."
    points = [f"{flight.label}: {warning}" for flight in flights for warning in flight.found.warnings]
    return Section("Timeline", text, charts=charts, points=points)


def contents_section(flights: Sequence[ReportedFlight]) -> Section:
    """What the logs hold: signals, rates, gaps."""
    tables = []
    for flight in flights:
        rows = []
        for name, (title, factor, unit) in SIGNALS.items():
            found = flight.found.signals.get(name)
            if found is None:
                rows.append([title, "not logged", "", "", "", ""])
                continue
            held = f", held for {found.held}" if found.held > 1 else ""
            ends = zip(found.minimum, found.maximum, strict=True)
            spans = [f"{factor * low:.3g} to {factor * high:.3g} {unit}".rstrip() for low, high in ends]
            gaps = f"{found.gaps} (longest {found.longest_gap_s * 1e3:.0f} ms)" if found.gaps else "none"
            rows.append([title, found.source, f"{found.rate_hz:.0f} Hz{held}", gaps, *spans])
        rows += [_further(title, series) for title, series in _beside(flight) if series is not None]
        caption = f"{flight.label}: {flight.recording.format}, {flight.span[1] - flight.span[0]:.1f} s"
        tables.append(ReportTable(caption, ("signal", "from", "rate", "gaps", "roll", "pitch"), rows))
    points = [f"{flight.label}: {note}" for flight in flights for note in flight.recording.notes]
    return Section("What the log holds", "", tables=tables, points=points)


def _beside(flight: ReportedFlight) -> Sequence[tuple[str, Series | None]]:
    """Signals that gains are not tuned from."""
    further = flight.further
    return (("gyro", further.gyro), ("thrust", further.thrust), ("motors", further.motors))


def _further(title: str, series: Series) -> list[str]:
    period = sampling_period(series.time)
    rate = f"{1 / period:.0f} Hz" if period > 0 else ""
    return [title, series.topic, rate]


def _seconds(name: str, parts: Sequence[tuple[float, float]]) -> str:
    return f"{name} {sum(b - a for a, b in parts):.1f} s"
