"""The gains with their intervals, and the motion that they are predicted to give."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from mimopilot.common.charts import MODEL_COLOUR, SETPOINT_COLOUR
from mimopilot.common.figures import Chart, Line, Panel, Spread
from mimopilot.common.html_report import ReportTable, Section
from mimopilot.sitl.field.report.analysis.flight_data import GainCase
from mimopilot.sitl.field.report.analysis.predicted_motion import (
    PERIOD,
    PredictedMotion,
    doublet_setpoint,
    predicted_motion,
)
from mimopilot.tuning.analysis.manoeuvres import AMPLITUDE, ROLL_PITCH_FAMILY, manoeuvres
from mimopilot.tuning.design.prediction import Prediction, predict
from mimopilot.tuning.gains import Gains
from mimopilot.tuning.logs.inspection import AXES
from mimopilot.tuning.parameter_row import Shape
from mimopilot.tuning.parameters import YAW_GAINS, rows
from mimopilot.tuning.plant.frequency_response import SAME_PERIOD

ELEMENTS = ("roll<-roll", "roll<-pitch", "pitch<-roll", "pitch<-pitch")


def gains_section(cases: Sequence[GainCase]) -> Section:
    """All gain sets beside one another."""
    if not cases:
        return Section(
            "Gains", "The log does not hold the flown gains, and none are given: name a gains file with --gains."
        )
    names = [row.key for row in rows(Shape.MATRIX) if any(_used(case, row.key) for case in cases)]
    units = {row.key: row.unit for row in rows(Shape.MATRIX)}
    panels, table = [], []
    for name in names:
        lines = []
        for place, case in enumerate(cases):
            values = np.ravel(getattr(case.gains, name))
            deviation = np.ravel(case.gains.provenance.standard_deviation.get(name, np.full((2, 2), np.nan)))
            x = np.arange(4) + 0.16 * (place - (len(cases) - 1) / 2)
            error = 2 * deviation if np.isfinite(deviation).all() else None
            marker = ("o", "s", "x")[place % 3]
            lines.append(Line(x, values, case.label, case.colour, width=0, marker=marker, error=error))
            for k, (value, spread) in enumerate(zip(values, 2 * deviation, strict=True)):
                table.append([f"{name} {ELEMENTS[k]}", case.label, _with_error(value, spread)])
        unit = f"[{units[name]}]" if units[name] and units[name] != "norm" else ""
        panels.append(Panel(name, "output<-error", unit, lines, x_names=ELEMENTS, height=240))
    order = [f"{name} {element}" for name in names for element in ELEMENTS]
    columns = ["", *(case.label for case in cases)]
    cells = {(row[0], row[1]): row[2] for row in table}
    body = [[element, *(cells.get((element, case.label), "") for case in cases)] for element in order]
    body += _yaw_rows(cases)
    body.append(["derivative filter", *(_hertz(case.gains.derivative_cutoff_hz) for case in cases)])
    body.append(["control rate", *(f"{1 / case.gains.Ts:g} Hz" for case in cases)])
    caption = (
        "Bars: two standard deviations, the spread to expect if the flight were repeated. A set without bars was not "
        "estimated."
    )
    return Section(
        "Gains",
        charts=[Chart("gains", caption, panels, linked=False)],
        tables=[ReportTable("Gains (+- two standard deviations)", columns, body)],
    )


def _yaw_rows(cases: Sequence[GainCase]) -> list[list[str]]:
    """The gains of yaw that any set uses, with their deviations where they were estimated."""
    found = []
    for name in YAW_GAINS:
        values = [float(getattr(case.gains.yaw, name)) for case in cases]
        deviations = [_yaw_deviation(case, name) for case in cases]
        if any(values):
            pairs = zip(values, deviations, strict=True)
            found.append([f"{name} yaw", *(_with_error(value, 2 * deviation) for value, deviation in pairs)])
    return found


def _yaw_deviation(case: GainCase, name: str) -> float:
    table: Any = case.gains.provenance.standard_deviation.get("yaw", {})
    return float(np.ravel(table[name])[0]) if name in table else float("nan")


def _used(case: GainCase, name: str) -> bool:
    return name in case.gains.matrices and bool(np.any(getattr(case.gains, name)))


def _with_error(value: float, error: float) -> str:
    """A number with the digits that its error justifies."""
    if not np.isfinite(error) or error <= 0:
        return f"{value + 0.0:.4g}"
    digits = max(0, min(8, 1 - int(np.floor(np.log10(error)))))
    return f"{round(value, digits) + 0.0:.{digits}f} +- {error:.{digits}f}"


def _hertz(value: float) -> str:
    return f"{value:g} Hz" if value else "none"


def prediction_section(cases: Sequence[GainCase]) -> Section:
    """Doublet and step of torque, predicted for all gain sets around the vehicle of the log."""
    heading = "Predicted motion"
    possible = [case for case in cases if case.flight.wide is not None and not case.problem]
    motions = [
        (case, motion)
        for case in possible
        if case.flight.wide is not None
        and _is_stable(case)
        and (motion := predicted_motion(case.gains, case.flight.wide))
    ]
    reasons = [
        f"{case.label}: not predicted: {case.problem or _why_not(case)}."
        for case in cases
        if case not in [one for one, _ in motions]
    ]
    if not motions:
        return Section(heading, "Not shown: it needs gains and a frequency response of the vehicle.", points=reasons)
    panels = [_doublet_panel(motions, moved, angle) for moved in range(2) for angle in (moved, 1 - moved)]
    panels += [_torque_panel(motions, axis) for axis in range(2)]
    size = np.degrees(AMPLITUDE)
    caption = (
        f"Predicted from the measured response: a doublet of {size:g} degrees and {PERIOD:g} s on roll, then on pitch "
        "(left: the axis that is moved, right: the other one), and a step of torque that would accelerate by "
        f"{ROLL_PITCH_FAMILY.acceleration:g} rad/s^2. Bands: two standard deviations, from the error of the response."
    )
    return Section(
        heading,
        charts=[Chart("predicted-motion", caption, panels)],
        tables=[_figures(motions)],
        points=reasons,
    )


def _is_stable(case: GainCase) -> bool:
    return bool(case.gains.certificate and case.gains.certificate.figures)


def _why_not(case: GainCase) -> str:
    if case.flight.wide is None:
        return "the response is known at too few frequencies"
    if not _is_stable(case):
        certificate = case.gains.certificate
        return f"{certificate.verdict}: {certificate.reason}" if certificate else "it has no certificate"
    return f"its control rate, {1 / case.gains.Ts:g} Hz, is not that of the log, {1 / case.flight.wide.Ts:g} Hz"


def _doublet_panel(motions: Sequence[tuple[GainCase, PredictedMotion]], moved: int, angle: int) -> Panel:
    time = motions[0][1].time
    lines: list[Line | Spread] = []
    if angle == moved:
        lines.append(Line(time, doublet_setpoint(time), "setpoint", SETPOINT_COLOUR, width=1.0, step=True))
        model = next((c.gains for c, _ in reversed(motions) if c.gains.provenance.outer_model), None)
        if model is not None:
            grid = np.arange(0.0, time[-1], model.Ts)
            answer = model.reference_models(moved)[1].response(doublet_setpoint(grid)[:, None])[:, 0]
            reference = np.interp(time, grid, answer, left=0.0)
            lines.append(Line(time, reference, "reference", MODEL_COLOUR, width=3.0, opacity=0.6))
    for case, motion in motions:
        value, band = motion.doublet[:, angle, moved], motion.doublet_band[:, angle, moved]
        lines.append(Spread(motion.time, value - band, value + band, colour=case.colour))
        lines.append(Line(motion.time, value, width=2.0, **case.look))  # type: ignore[arg-type]
    title = f"{AXES[moved]} doublet: {AXES[angle]}{'' if angle == moved else ' (off-axis)'}"
    return Panel(title, "time [s]", "[deg]", lines)


def _torque_panel(motions: Sequence[tuple[GainCase, PredictedMotion]], axis: int) -> Panel:
    lines: list[Line | Spread] = []
    for case, motion in motions:
        value, band = motion.torque[:, axis, axis], motion.torque_band[:, axis, axis]
        lines.append(Spread(motion.time, value - band, value + band, colour=case.colour))
        lines.append(Line(motion.time, value, width=2.0, **case.look))  # type: ignore[arg-type]
    return Panel(f"step of torque on {AXES[axis]}: {AXES[axis]}", "time [s]", "[deg]", lines)


#: Predicted figures -> what they are.
PREDICTED = {
    "follow_deg": "error to the model in doublets [deg]",
    "offaxis_deg": "other axis in doublets [deg]",
    "disturbance_deg": "after the step of torque [deg]",
    "noise": "torque at hover from noise",
}


def predicted(case: GainCase, model: Gains) -> Prediction | None:
    """The figures that `tune` compares sets by, against the attitude model of `model`; None: they cannot be had."""
    wide = case.flight.wide
    if wide is None or not _is_stable(case) or abs(case.gains.Ts / wide.Ts - 1) > SAME_PERIOD:
        return None
    outer = (model.provenance.outer_model or (None,))[0]
    task = manoeuvres(wide, outer.discretise(wide.Ts) if outer else model.reference_models(0)[1], model.filters)
    return predict(case.gains, wide, task)


def _figures(motions: Sequence[tuple[GainCase, PredictedMotion]]) -> ReportTable:
    """The predicted figures of all sets, against one attitude model."""
    model = next((c.gains for c, _ in reversed(motions) if c.gains.provenance.outer_model), motions[0][0].gains)
    found = [predicted(case, model) for case, _ in motions]
    rows_ = []
    for name, title in PREDICTED.items():
        digits = 4 if name == "noise" else 2
        pairs = [getattr(one, name) for one in found if one is not None]
        rows_.append([title, *(" / ".join(f"{value:.{digits}f}" for value in pair) for pair in pairs)])
    caption = f"Predicted figures, RMS, roll / pitch; the model is {model.reference_models(0)[1].label}"
    return ReportTable(caption, ("", *(case.label for case, _ in motions)), rows_)
