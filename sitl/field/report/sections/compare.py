"""Two flights, or two gain sets, in figures: before, after, and the difference."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from mimopilot.common.figures import Chart, Line, Panel
from mimopilot.common.html_report import ReportTable, Section
from mimopilot.common.text_table import plain_zero, plus_minus
from mimopilot.sitl.field.report.analysis.filters_advice import torque_rms
from mimopilot.sitl.field.report.analysis.flight_data import GainCase
from mimopilot.sitl.field.report.analysis.predicted_motion import BOTH
from mimopilot.sitl.field.report.sections.prediction import PREDICTED, YAW, attitude_model, predicted
from mimopilot.sitl.field.report.sections.spectra import FlightSpectra
from mimopilot.sitl.field.report.sections.steps import step_estimates
from mimopilot.sitl.field.report.sections.tracking import tracking_error
from mimopilot.tuning.axes import axis_names
from mimopilot.tuning.logs.inspection import AXES

HEADING = "Before and after"


@dataclass(frozen=True)
class Compared:
    """A figure before and after: its values, and the error of each and of their difference; NaN: not known."""

    before: float
    after: float
    errors: tuple[float, float] = (float("nan"), float("nan"))
    doubt: float = float("nan")

    def row(self, name: str) -> list[str]:
        """Both, the difference with as many digits as its error justifies, and the difference in percent.

        Without errors, three digits of the larger value, and as many decimals of all.
        """
        change = self.after - self.before
        if np.isfinite(self.doubt) and self.doubt > 0:
            values = zip((self.before, self.after), self.errors, strict=True)
            cells = [*(plus_minus(value, error) for value, error in values), plus_minus(change, self.doubt)]
        else:
            size = max(abs(self.before), abs(self.after), 1e-9)
            decimals = max(0, 2 - int(np.floor(np.log10(size))))
            cells = [plain_zero(f"{value:.{decimals}f}") for value in (self.before, self.after, change)]
        share = f"{100 * change / self.before:+.0f} %" if self.before else "-"
        cells[2] = cells[2] if cells[2].startswith("-") else f"+{cells[2]}"
        return [name, *cells, plain_zero(share)]


def compare_section(found: Sequence[FlightSpectra], cases: Sequence[GainCase]) -> Section | None:
    """The comparison of the first two flights, and of two gain sets; None if there is one of each."""
    texts, tables, charts = list[str](), list[ReportTable](), list[Chart]()
    if len(found) > 1:
        before, after = found[:2]
        labels = (before.flight.label, after.flight.label)
        texts.append(
            f"Before: {labels[0]}. After: {labels[1]}. Both flights on the same axes; their step responses are below."
        )
        figures = [_flight_figures(one) for one in (before, after)]
        flown = {name: Compared(value, figures[1][name]) for name, value in figures[0].items() if name in figures[1]}
        tables.append(difference_table("The flights", labels, flown))
        charts = _overlaid(before, after)
    pair = _pair(cases)
    if pair is not None:
        names = (pair[0].label, pair[1].label)
        texts.append(f"Gain sets: before: {names[0]}; after: {names[1]}.")
        tables.append(difference_table("The gain sets (+- two standard deviations)", names, _set_figures(*pair)))
    if not texts:
        return None
    tables = [table for table in tables if table.rows]
    if not tables:
        texts.append("They share no figure that could be compared.")
    return Section(HEADING, " ".join(texts), tables=tables, charts=charts)


def _pair(cases: Sequence[GainCase]) -> tuple[GainCase, GainCase] | None:
    """The flown gains of the first flight and the newest set, if those have a certificate each."""
    if len(cases) < 2:
        return None
    judged = [case for case in cases if not case.problem and case.gains.certificate and case.gains.certificate.figures]
    return (judged[0], judged[-1]) if len(judged) > 1 else None


def difference_table(caption: str, labels: tuple[str, str], figures: Mapping[str, Compared]) -> ReportTable:
    """Figures that both have, their difference and its share."""
    rows = [one.row(name) for name, one in figures.items() if np.isfinite(one.before) and np.isfinite(one.after)]
    return ReportTable(caption, ("", *labels, "difference", "in percent"), rows)


def _flight_figures(one: FlightSpectra) -> dict[str, float]:
    flight, figures = one.flight, {}
    for what, unit, setpoint, answer in (("angle", "deg", "r_o", "y_o"), ("rate", "deg/s", "r_i", "y_i")):
        error = tracking_error(flight.signal(setpoint), flight.signal(answer), flight.airborne)
        if error is not None:
            for axis, rms in zip(AXES, np.sqrt(np.mean(error**2, axis=0)), strict=True):
                figures[f"{axis}: RMS of the {what}'s error [{unit}]"] = float(rms)
    for axis, estimate in step_estimates(flight)[0].items():
        figures[f"{axis}: rise of the step response [s]"] = estimate.rise()
        figures[f"{axis}: overshoot of the step response [%]"] = 100 * estimate.overshoot()
    if one.gyro is not None:
        above = one.gyro.hertz >= 30.0
        power = one.gyro.density[above].sum(axis=0) * one.gyro.hertz[0]
        if above.any():
            figures["gyro above 30 Hz, RMS, largest axis [deg/s]"] = float(np.degrees(np.sqrt(power.max())))
    figures["torque above 30 Hz, RMS, larger axis"] = torque_rms(one.own_torque)
    return figures


def _set_figures(before: GainCase, after: GainCase) -> dict[str, Compared]:
    """Margins by the certificates and predicted figures of two sets, of roll and pitch, and of yaw."""
    found = dict[str, Compared]()
    certificates = [case.gains.certificate for case in (before, after)]
    tables = [certificate.figures for certificate in certificates if certificate]
    if not (before.unknown or after.unknown):  # else the figures are bounds
        # The errors of the margins are not known in pairs: their difference is at most as uncertain as if independent.
        found["Ms"] = _apart([(one["Ms"], one["Ms_error"]) for one in tables])
        for axis in AXES:
            found[f"{axis}: phase margin [deg]"] = _apart(
                [(one["phase_margin_deg"][axis], one["phase_margin_error_deg"][axis]) for one in tables]
            )
        for axis in AXES:
            found[f"{axis}: delay margin [ms]"] = Compared(*(one["delay_margin_ms"][axis] for one in tables))
    yaws = [one.get("yaw", {}) for one in tables]
    if all("Ms" in yaw for yaw in yaws):
        found["yaw: Ms"] = _apart([(yaw["Ms"], yaw["Ms_error"]) for yaw in yaws])
        found["yaw: phase margin [deg]"] = _apart(
            [(yaw["phase_margin_deg"], yaw["phase_margin_error_deg"]) for yaw in yaws]
        )
    for axes in (BOTH, YAW):
        found |= _predicted(before, after, axes)
    return found


def _predicted(before: GainCase, after: GainCase, axes: int) -> dict[str, Compared]:
    """Predicted figures of two sets against one attitude model; empty: they cannot be had."""
    asked = attitude_model([before, after], axes)
    first, second = (predicted(case, asked[0], axes) if asked else None for case in (before, after))
    found: dict[str, Compared] = {}
    if first is None or second is None:
        return found
    for name, title in PREDICTED.items():
        for number, axis in enumerate(axis_names(axes) if axes == BOTH or name != "offaxis_deg" else ()):
            compared = _apart([(one.value(name, number), one.error(name, number)) for one in (first, second)])
            if before.flight is after.flight:  # around the same drawn plants
                compared = replace(compared, doubt=second.error(name, number, first))
            found[f"{axis}: {title}"] = compared
    return found


def _apart(values: Sequence[tuple[float, float]]) -> Compared:
    """Two values with independent errors."""
    (before, error), (after, other) = values
    return Compared(before, after, (error, other), float(np.hypot(error, other)))


def _overlaid(before: FlightSpectra, after: FlightSpectra) -> list[Chart]:
    panels = []
    for title, unit, name, factor in (
        ("gyro, all axes", "[(deg/s)^2/Hz]", "gyro", (180 / np.pi) ** 2),
        ("torque, both axes", "[1/Hz]", "torque", 1.0),
    ):
        lines = []
        for one in (before, after):
            found = getattr(one, name)
            if found is not None:
                density = np.maximum(factor * found.density.sum(axis=1), 1e-30)
                lines.append(Line(found.hertz, density, one.flight.label, one.flight.colour, width=1.2))
        if len(lines) == 2:
            panels.append(Panel(title, "frequency [Hz]", unit, lines, log_x=True, log_y=True))
    return [Chart("compared-spectra", "Spectra of both flights in the air.", panels)] if panels else []
