"""Two flights, or two gain sets, in figures: before, after, and the difference."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from mimopilot.common.charts import NEW
from mimopilot.common.figures import Chart, Line, Panel
from mimopilot.common.html_report import ReportTable, Section
from mimopilot.sitl.field.report.analysis.filters_advice import least_phase, torque_rms
from mimopilot.sitl.field.report.analysis.flight_data import GainCase
from mimopilot.sitl.field.report.sections.gain_sets import PREDICTED, predicted
from mimopilot.sitl.field.report.sections.spectra import FlightSpectra
from mimopilot.sitl.field.report.sections.steps import step_estimates
from mimopilot.sitl.field.report.sections.tracking import tracking_error
from mimopilot.tuning.gains import Gains
from mimopilot.tuning.logs.inspection import AXES

HEADING = "Before and after"


def compare_section(found: Sequence[FlightSpectra], cases: Sequence[GainCase]) -> Section | None:
    """The comparison of the first two flights, else of the first two gain sets; None if there is one of each."""
    if len(found) > 1:
        before, after = found[:2]
        figures = [_flight_figures(one) for one in (before, after)]
        labels = (before.flight.label, after.flight.label)
        charts = _overlaid(before, after)
        text = (
            f"Before: {labels[0]}. After: {labels[1]}. Both flights on the same axes; their step responses are above."
        )
    elif len(cases) > 1:
        pair = cases[0], cases[-1]
        figures, labels, charts = [_set_figures(one, pair[1].gains) for one in pair], (pair[0].label, pair[1].label), []
        text = f"Before: {labels[0]}. After: {labels[1]}, around the vehicle of {pair[1].flight.label}."
    else:
        return None
    table = difference_table(labels, figures)
    if not table.rows:
        return Section(HEADING, f"{text} They share no figure that could be compared.")
    return Section(HEADING, text, tables=[table], charts=charts)


def difference_table(labels: tuple[str, str], figures: Sequence[Mapping[str, float]]) -> ReportTable:
    """Figures that both have, their difference and its share."""
    rows = []
    for name, before in figures[0].items():
        after = figures[1].get(name, np.nan)
        if np.isfinite(before) and np.isfinite(after):
            share = f"{(after / before - 1):+.0%}" if before else "-"
            rows.append([name, f"{before:.4g}", f"{after:.4g}", f"{after - before + 0.0:+.3g}", share])
    return ReportTable("Figures", ("", *labels, "difference", "in percent"), rows)


def _flight_figures(one: FlightSpectra) -> dict[str, float]:
    flight, figures = one.flight, {}
    for what, unit, setpoint, answer in (("angle", "deg", "r_o", "y_o"), ("rate", "deg/s", "r_i", "y_i")):
        error = tracking_error(flight.signal(setpoint), flight.signal(answer), flight.airborne)
        if error is not None:
            for axis, rms in zip(AXES, np.sqrt(np.mean(error**2, axis=0)), strict=True):
                figures[f"{axis} {what}, RMS of the error [{unit}]"] = float(rms)
    for axis, estimate in step_estimates(flight)[0].items():
        figures[f"{axis}, rise of the step response [s]"] = estimate.rise()
        figures[f"{axis}, overshoot of the step response [%]"] = 100 * estimate.overshoot()
    if one.gyro is not None:
        above = one.gyro.hertz >= 30.0
        power = one.gyro.density[above].sum(axis=0) * one.gyro.hertz[0]
        if above.any():
            figures["gyro above 30 Hz, RMS, largest axis [deg/s]"] = float(np.degrees(np.sqrt(power.max())))
    figures["torque above 30 Hz, RMS, larger axis"] = torque_rms(one.own_torque)
    return figures


def _set_figures(case: GainCase, model: Gains) -> dict[str, float]:
    certificate = case.gains.certificate
    if case.problem or certificate is None or not certificate.figures:
        return {}
    figures = {"Ms": certificate.figures["Ms"], "smallest phase margin [deg]": least_phase(certificate)}
    figures["disk margin"] = certificate.figures["disk_margin"]
    for axis in AXES:
        figures[f"delay margin, {axis} [ms]"] = certificate.figures["delay_margin_ms"][axis]
    found = predicted(case, model)
    for name, title in PREDICTED.items() if found else ():
        for axis, value in zip(AXES, getattr(found, name), strict=True):
            figures[f"{title}, {axis}"] = value
    return figures


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
                colour = one.flight.colour if one is before else NEW
                lines.append(Line(found.hertz, density, one.flight.label, colour, width=1.2))
        if len(lines) == 2:
            panels.append(Panel(title, "frequency [Hz]", unit, lines, log_x=True, log_y=True))
    return [Chart("compared-spectra", "Spectra of both flights in the air.", panels)] if panels else []
