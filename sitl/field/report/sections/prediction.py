"""The motion that each gain set will give the vehicle of a log, and the figures that sets are compared by."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mimopilot.common.charts import MODEL_COLOUR, SETPOINT_COLOUR
from mimopilot.common.figures import Chart, Line, Panel, Spread
from mimopilot.common.html_report import ReportTable, Section
from mimopilot.common.text_table import plus_minus
from mimopilot.sitl.field.report.analysis.flight_data import GainCase
from mimopilot.sitl.field.report.analysis.predicted_motion import (
    BOTH,
    PredictedMotion,
    doublet_setpoint,
    drawn_plants,
    period_of,
    predicted_motion,
)
from mimopilot.sitl.field.report.sections.tracking import MODEL_UNITS
from mimopilot.tuning.analysis.manoeuvres import AMPLITUDE, family_of, manoeuvres
from mimopilot.tuning.axes import axis_names, law_of
from mimopilot.tuning.design.prediction import Prediction, predict
from mimopilot.tuning.design.yaw_design import yaw_model
from mimopilot.tuning.plant.frequency_response import SAME_PERIOD
from mimopilot.tuning.plant.wide_response import WideResponse
from mimopilot.tuning.reference_model import ReferenceModel

HEADING = "Predicted motion"
#: Predicted figures -> what they are, with the unit.
PREDICTED = {
    "follow_deg": "tracking error in doublets [deg]",
    "offaxis_deg": "off-axis motion in doublets [deg]",
    "disturbance_deg": "angle after the torque step [deg]",
    "noise": "torque noise at hover",
}
#: Number of axes of yaw.
YAW = 1

#: Gain sets with their motion.
Motions = Sequence[tuple[GainCase, PredictedMotion]]


@dataclass(frozen=True)
class PredictedFigures:
    """Figures of a set around the measured plant, and around plants within its error, in the order of these."""

    figures: Prediction
    drawn: tuple[Prediction, ...]

    def value(self, name: str, axis: int) -> float:
        """A figure of an axis."""
        return float(getattr(self.figures, name)[axis])

    def error(self, name: str, axis: int, other: PredictedFigures | None = None) -> float:
        """Two standard deviations of a figure, or of its difference from that of another set on the same plants."""
        values = np.array([getattr(one, name)[axis] for one in self.drawn])
        if other is not None:
            values = values - np.array([getattr(one, name)[axis] for one in other.drawn])
        return float(2 * np.std(values))


def prediction_section(cases: Sequence[GainCase]) -> Section:
    """Doublet and step of torque on each axis, predicted for all gain sets around the vehicle of the log."""
    motions = {axes: _motions(cases, axes) for axes in (BOTH, YAW)}
    shown = [one for one, _ in motions[BOTH]]
    reasons = [f"{case.label}: not predicted: {case.problem or _why_not(case)}." for case in cases if case not in shown]
    if not shown:
        return Section(HEADING, "Not shown: it needs gains and a frequency response of the vehicle.", points=reasons)
    panels = [_doublet_panel(motions[BOTH], moved, angle) for moved in range(2) for angle in (moved, 1 - moved)]
    panels += [_torque_panel(motions[BOTH], axis) for axis in range(2)]
    caption = (
        f"Predicted from the measured response: a doublet of {_size(BOTH)} on roll, then on pitch, with the answer of "
        f"the axis that is moved and of the other one (off-axis); and {_push(BOTH)}. Bands: two standard deviations, "
        "from the error of the response."
    )
    charts = [Chart("predicted-motion", caption, panels)]
    if motions[YAW]:
        text = f"The same of yaw: a doublet of the heading of {_size(YAW)}, and {_push(YAW)}."
        panels = [_doublet_panel(motions[YAW], 0, 0), _torque_panel(motions[YAW], 0)]
        charts.append(Chart("predicted-motion-yaw", text, panels))
    tables = [table for axes in (BOTH, YAW) if motions[axes] and (table := _figures(motions[axes], axes))]
    return Section(HEADING, charts=charts, tables=tables, points=reasons)


def predicted(case: GainCase, model: ReferenceModel, axes: int = BOTH) -> PredictedFigures | None:
    """The figures that `tune` compares sets by, against an attitude model; None: they cannot be had."""
    plant = _plant(case, axes)
    if plant is None or abs(case.gains.Ts / plant.Ts - 1) > SAME_PERIOD:
        return None
    law = law_of(case.gains, axes)
    task = manoeuvres(plant, model, law.filters)
    return PredictedFigures(predict(law, plant, task), tuple(predict(law, one, task) for one in drawn_plants(plant)))


def attitude_model(cases: Sequence[GainCase], axes: int) -> tuple[ReferenceModel, str] | None:
    """The model that all sets are compared with, and its name: the newest set's own; None: yaw has none."""
    sets = [case.gains for case in cases]
    if axes == YAW:
        found = next((model for gains in reversed(sets) if (model := yaw_model(gains))), None)
        return (found, found.label) if found else None
    gains = next((one for one in reversed(sets) if one.provenance.outer_model), sets[0])
    model = gains.reference_models(0)[1]
    return model, model.label


def _plant(case: GainCase, axes: int) -> WideResponse | None:
    """The response that a set is predicted around; None: the set is not stable on it, or it is not known."""
    figures = case.gains.certificate.figures if case.gains.certificate and not case.problem else {}
    if axes == YAW:
        return case.flight.wide_yaw if "Ms" in figures.get("yaw", {}) else None
    return case.flight.wide if figures else None


def _motions(cases: Sequence[GainCase], axes: int) -> Motions:
    found = []
    for case in cases:
        plant = _plant(case, axes)
        motion = predicted_motion(law_of(case.gains, axes), plant) if plant is not None else None
        if motion is not None:
            found.append((case, motion))
    return found


def _why_not(case: GainCase) -> str:
    certificate = case.gains.certificate
    if case.flight.wide is None:
        return "the response is known at too few frequencies"
    if certificate is None or not certificate.figures:
        return f"{certificate.verdict}: {certificate.reason}" if certificate else "it has no certificate"
    return f"its control rate, {1 / case.gains.Ts:g} Hz, is not that of the log, {1 / case.flight.wide.Ts:g} Hz"


def _size(axes: int) -> str:
    return f"{np.degrees(AMPLITUDE):g} degrees and {period_of(axes):g} s"


def _push(axes: int) -> str:
    return f"a step of torque that would accelerate by {family_of(axes).acceleration:g} rad/s^2"


def _doublet_panel(motions: Motions, moved: int, angle: int) -> Panel:
    first = motions[0][1]
    axes = first.doublet.shape[1]
    names, time = axis_names(axes), first.time
    lines: list[Line | Spread] = []
    if angle == moved:
        lines.append(Line(time, first.setpoint, "setpoint", SETPOINT_COLOUR, width=1.0, step=True))
        lines += _reference([case for case, _ in motions], axes, moved, first)
    for case, motion in motions:
        lines += _with_band(case, motion, motion.doublet[:, angle, moved], motion.doublet_band[:, angle, moved])
    off = "" if angle == moved else " (off-axis)"
    return Panel(f"{names[moved]} doublet: {names[angle]}{off}", "time [s]", "[deg]", lines)


def _reference(cases: Sequence[GainCase], axes: int, moved: int, motion: PredictedMotion) -> list[Line]:
    """What the newest set with a model of its own should do in the doublet."""
    if axes == YAW:
        model = next((found for case in reversed(cases) if (found := yaw_model(case.gains))), None)
    else:
        sets = (case.gains for case in reversed(cases))
        model = next((one.reference_models(moved)[1] for one in sets if one.provenance.outer_model), None)
    if model is None:
        return []
    grid = np.arange(0.0, motion.time[-1], model.Ts)
    answer = model.response(doublet_setpoint(grid, period_of(axes))[:, None])[:, 0]
    reference = np.interp(motion.time, grid, answer, left=0.0)
    return [Line(motion.time, reference, "reference", MODEL_COLOUR, width=3.0, opacity=0.6)]


def _torque_panel(motions: Motions, axis: int) -> Panel:
    lines: list[Line | Spread] = []
    for case, motion in motions:
        lines += _with_band(case, motion, motion.torque[:, axis, axis], motion.torque_band[:, axis, axis])
    name = axis_names(motions[0][1].torque.shape[1])[axis]
    return Panel(f"step of torque on {name}: {name}", "time [s]", "[deg]", lines)


def _with_band(case: GainCase, motion: PredictedMotion, value: np.ndarray, band: np.ndarray) -> list[Line | Spread]:  # type: ignore[type-arg]
    return [
        Spread(motion.time, value - band, value + band, colour=case.colour),
        Line(motion.time, value, width=2.0, **case.look),  # type: ignore[arg-type]
    ]


def _figures(motions: Motions, axes: int) -> ReportTable | None:
    """The predicted figures of all sets, against one attitude model."""
    cases = [case for case, _ in motions]
    asked = attitude_model(cases, axes)
    if asked is None:
        return None
    model, label = asked
    found = [(case, one) for case in cases if (one := predicted(case, model, axes)) is not None]
    rows = []
    for name, title in PREDICTED.items():
        if axes == YAW and name == "offaxis_deg":
            continue
        for axis, text in enumerate(axis_names(axes)):
            rows.append(
                [f"{text}: {title}", *(plus_minus(one.value(name, axis), one.error(name, axis)) for _, one in found)]
            )
    what = "yaw, RMS" if axes == YAW else "RMS"
    caption = f"Predicted figures, {what} (+- two standard deviations); the model is {label} {MODEL_UNITS}"
    return ReportTable(caption, ("", *(case.label for case, _ in found)), rows)
