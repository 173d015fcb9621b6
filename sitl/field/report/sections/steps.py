"""Step response of every flight whose setpoint moves, and how it differs between flights."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mimopilot.common.charts import MODEL_COLOUR
from mimopilot.common.figures import Chart, LimitLine, Line, Panel, Spread
from mimopilot.common.html_report import ReportTable, Section
from mimopilot.sitl.field.report.analysis.flight_data import ReportedFlight
from mimopilot.sitl.field.report.analysis.step_response import StepEstimate, estimate_step
from mimopilot.tuning.logs.flight_phase import BEFORE_TUMBLE, intersection
from mimopilot.tuning.logs.inspection import AXES
from mimopilot.tuning.logs.resample import Interval

HEADING = "Step response"


def usable(flight: ReportedFlight) -> tuple[Interval, ...]:
    """The time in the air before the vehicle tumbled, s."""
    if not flight.phases["crash"]:
        return flight.airborne
    return intersection(flight.airborne, ((0.0, flight.phases["crash"][0][0] - BEFORE_TUMBLE),))


def step_estimates(flight: ReportedFlight) -> tuple[dict[str, StepEstimate], list[str]]:
    """Axis -> estimate from attitude (else rate) setpoint to answer; and why an axis has none.

    Where an attitude setpoint is logged, the rate setpoint answers to the vehicle: it is no input to estimate from.
    """
    for setpoint, answer, what in (("r_o", "y_o", "attitude"), ("r_i", "y_i", "rate")):
        r, y = flight.signal(setpoint), flight.signal(answer)
        if r is None or y is None:
            continue
        found, reasons = dict[str, StepEstimate](), dict[str, list[str]]()
        for axis, name in enumerate(AXES):
            estimate, why = estimate_step(r, y, usable(flight), axis)
            if estimate is not None:
                found[name] = estimate
            else:
                reasons.setdefault(why, []).append(name)
        return found, [f"{flight.label}, {what} of {' and '.join(n)}: not shown: {why}." for why, n in reasons.items()]
    return {}, [f"{flight.label}: not shown: the log lacks a setpoint, or the angles or rates that respond to it."]


def step_section(flights: Sequence[ReportedFlight]) -> Section:
    """The step responses of all flights on the same axes."""
    found = [step_estimates(flight) for flight in flights]
    reasons = [reason for _, some in found for reason in some]
    if not any(estimates for estimates, _ in found):
        return Section(HEADING, "Not shown.", points=reasons)
    panels, rows = [], []
    for name in AXES:
        lines: list[Line | Spread] = []
        for flight, (estimates, _) in zip(flights, found, strict=True):
            one = estimates.get(name)
            if one is None:
                continue
            label = f"{flight.label}, {one.stretches} stretches"
            lines.append(Spread(one.time, one.step - one.band, one.step + one.band, colour=flight.colour))
            lines.append(Line(one.time, one.step, label, flight.colour, width=2.0))
            rows.append(
                [
                    f"{name}, {flight.label}",
                    _or_dash(one.rise(), "{:.2f} s"),
                    _or_dash(100 * one.overshoot(), "{:.0f} %"),
                    f"{one.step[-max(1, len(one.step) // 5) :].mean():.2f}",
                    f"{one.width:.2f}",
                    str(one.stretches),
                    f"{one.explained:.0%}",
                ]
            )
        if lines:
            marks = [LimitLine(1.0, colour=MODEL_COLOUR)]
            title = f"{name}: response to a unit step"
            panels.append(Panel(title, "time after the step [s]", "angle over setpoint", lines, marks, height=280))
    caption = (
        "Estimated from the whole flight by deconvolution, with its band of two standard deviations: the spread over "
        "the stretches of flight, and what the setpoint does not excite. An estimate whose band is wider than the "
        "response is not shown."
    )
    columns = ("", "rise 10 to 90 %", "overshoot", "last value", "width of the band", "stretches", "explained")
    return Section(
        HEADING,
        charts=[Chart("step-response", caption, panels)],
        tables=[ReportTable("Step response", columns, rows)],
        points=reasons,
    )


def _or_dash(value: float, text: str) -> str:
    return text.format(value) if np.isfinite(value) else "-"
