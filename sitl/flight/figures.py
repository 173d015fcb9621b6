"""Figures of flights: time histories of a manoeuvre and of an experiment."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from mimopilot.common.charts import AXIS_COLOURS, MODEL_COLOUR, SETPOINT_COLOUR
from mimopilot.common.figures import Chart, Line, Panel, SpanMark, thinned
from mimopilot.sitl.flight.metrics import reference_responses
from mimopilot.sitl.flight.scenario import AXES
from mimopilot.sitl.flight.simulator import Flight
from mimopilot.tuning.reference_model import ReferenceModel

ALL_AXES = (*AXES, "yaw")
#: s before the manoeuvre that is shown.
BEFORE = 0.1
#: Length of the detail of an experiment, s: some dozen steps of the excitation.
DETAIL = 3.0
#: Most samples of a line over a whole experiment: there are a dozen, and the detail has every sample.
OVERVIEW_SAMPLES = 800
#: Over the x axis of every time history of a manoeuvre.
FROM_START = "time from the start of the manoeuvre [s]"


def manoeuvre_chart(
    name: str,
    flights: Mapping[str, Flight],
    looks: Mapping[str, tuple[str, str]],
    inner: ReferenceModel,
    outer: ReferenceModel,
) -> Chart:
    """One manoeuvre under several gain sets: angle, off-axis angle, rate and torque over time.

    Parameters
    ----------
    name : str
        Of the figure.
    flights : mapping
        Label -> flight; all of the same scenario.
    looks : mapping
        Label -> colour and line style.
    inner, outer : ReferenceModel
        Of the rate loop and of the attitude loop.
    """
    first = next(iter(flights.values()))
    scenario, axis = first.scenario, first.scenario.axis
    other = 1 - axis
    time = (np.arange(len(first.record)) - scenario.window[0]) * scenario.Ts
    shown = time >= -BEFORE
    time = time[shown]
    model, _ = reference_responses(first, inner, outer)
    setpoint = np.degrees(first.record["setpoint"][shown, axis])
    angle = [
        Line(time, np.degrees(model[shown]), "reference", MODEL_COLOUR, width=3.0, opacity=0.6),
        Line(time, setpoint, "setpoint", SETPOINT_COLOUR, width=1.0, step=True),
    ]
    off_axis: list[Line] = []
    rate: list[Line] = []
    torque: list[Line] = []
    for label, flight in flights.items():
        colour, dash = looks[label]
        truth, moment = flight.truth[shown], flight.record["moment"][shown, axis]
        for lines, values, step in (
            (angle, np.degrees(truth["attitude"][:, axis]), False),
            (off_axis, np.degrees(truth["attitude"][:, other]), False),
            (rate, np.degrees(truth["rates"][:, axis]), False),
            (torque, moment, True),
        ):
            lines.append(Line(time, values, label, colour, dash, step=step))
    window = SpanMark(0.0, (scenario.window[1] - scenario.window[0]) * scenario.Ts, colour="#000000", opacity=0.04)
    moved = AXES[axis]
    what = f"{moved} {scenario.name}"
    panels = [
        Panel(f"{what}: {moved}", FROM_START, "[deg]", angle, [window]),
        Panel(f"{what}: {AXES[other]} (off-axis)", FROM_START, "[deg]", off_axis, [window]),
        Panel(f"{what}: {moved} rate", FROM_START, "[deg/s]", rate, [window]),
        Panel(f"{what}: {moved} torque", FROM_START, "(normalised)", torque, [window]),
    ]
    caption = (
        f"{what.capitalize()}: true angles and rate, and the torque. Reference: {outer.label} (rad/s, "
        "damping, delay in samples). Shaded: window of the performance figures."
    )
    return Chart(name, caption, panels)


def experiment_charts(name: str, flight: Flight) -> list[Chart]:
    """An experiment, whole and in detail: injected and total torque, rates and angles of all axes."""
    time = np.asarray(np.arange(len(flight.record)) * flight.scenario.Ts, np.float64)
    record, excitation = flight.record, flight.scenario.excitation
    axes = [axis for axis in range(3) if axis < 2 or excitation[:, axis].any()]
    middle = time[-1] / 2
    roll = np.flatnonzero(excitation[:, 0])
    if len(roll) and roll[-1] + 1 < len(time):
        middle = time[roll[-1]]
    detail = (float(middle - DETAIL / 2), float(middle + DETAIL / 2))
    near = (time >= detail[0]) & (time <= detail[1])
    whole, part = [], []
    for title, unit, values in (
        ("injected torque", "(normalised)", record["excitation"]),
        ("torque", "(normalised)", record["moment"]),
        ("body rate", "[deg/s]", np.degrees(record["rates"])),
        ("angle", "[deg]", np.degrees(record["attitude"])),
    ):
        thin = [
            Line(*thinned(time, values[:, axis], OVERVIEW_SAMPLES), ALL_AXES[axis], AXIS_COLOURS[axis], width=0.8)
            for axis in axes
        ]
        full = [
            Line(time[near], values[near, axis], ALL_AXES[axis], AXIS_COLOURS[axis], width=1.3, step=True)
            for axis in axes
        ]
        whole.append(Panel(title, "time [s]", unit, thin, x_range=(0.0, float(time[-1])), height=220))
        part.append(Panel(title, "time [s]", unit, full, x_range=detail, height=220))
    return [
        Chart(name, "The closed-loop experiment.", whole),
        Chart(f"{name}-detail", f"The same in detail, where roll ends: {detail[0]:.1f} to {detail[1]:.1f} s.", part),
    ]
