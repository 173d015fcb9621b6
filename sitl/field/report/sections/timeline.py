"""Timeline: the phases of each flight, its angles and its motors; and what its log holds."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mimopilot.common.charts import FLOWN, SISO
from mimopilot.common.figures import Chart, LimitLine, Line, Panel, thinned
from mimopilot.common.html_report import ReportTable, Section
from mimopilot.sitl.field.report.analysis.flight_data import PHASES, ReportedFlight
from mimopilot.tuning.logs.inspection import AXES

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
        lines = []
        for axis, colour in enumerate((FLOWN, SISO)):
            x, y = thinned(angles.time, np.degrees(angles.values[:, axis]), flight.samples)
            lines.append(Line(x, y, AXES[axis], colour, width=1.0))
        panels.append(Panel("Angles", "time [s]", "[deg]", lines, x_range=span, height=220))
    lines = []
    if flight.further.motors is not None:
        motors = flight.since_begin(flight.further.motors)
        for column in range(motors.values.shape[1]):
            shade = ("#bbbbbb", "#999999", "#777777", "#555555")[column % 4]
            x, y = thinned(motors.time, motors.values[:, column], flight.samples // 2)
            lines.append(Line(x, y, f"motor {column + 1}", shade, width=0.8))
    if thrust is not None:
        thrust = flight.since_begin(thrust)
        lines.append(Line(*thinned(thrust.time, thrust.values[:, 0], flight.samples), "thrust", "#1a1a1a", width=1.4))
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
        caption = f"{flight.label}: {flight.recording.format}, {flight.found.seconds:.1f} s"
        tables.append(ReportTable(caption, ("signal", "from", "rate", "gaps", "roll", "pitch"), rows))
    points = [f"{flight.label}: {note}" for flight in flights for note in flight.recording.notes]
    return Section("What the log holds", "", tables=tables, points=points)


def _seconds(name: str, parts: Sequence[tuple[float, float]]) -> str:
    return f"{name} {sum(b - a for a, b in parts):.1f} s"
