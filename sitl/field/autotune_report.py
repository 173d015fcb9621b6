"""The page of an autotune: the check flight beside its prediction, then the report of both flights."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mimopilot.common.charts import MODEL_COLOUR, NEW, SETPOINT_COLOUR
from mimopilot.common.figures import Chart, Line, Panel, thinned
from mimopilot.common.html_report import Headline, ReportTable, Section, write_report
from mimopilot.sitl.field.autotune_run import CHECK, FLIGHT, REPORT, AutotuneRun
from mimopilot.sitl.field.check_flight import FIGURES, SHARE, CheckResult
from mimopilot.sitl.field.report.flight_report import LARGEST_PAGE, make_report
from mimopilot.tuning.gains import Gains

#: Columns of `check_rows`.
CHECKED = ("roll / pitch / yaw", "predicted", "flown", "limit")
CHECK_CAPTION = f"Doublets of the check flight; limit: {1 + SHARE:g} times the prediction, and a margin for gusts"


def check_rows(result: CheckResult) -> list[list[str]]:
    """Figures of the check flight beside the predicted ones and their limits."""
    rows = []
    for name, (text, unit, floor) in FIGURES.items():
        found = [getattr(figures, name) for figures in (result.predicted, result.flown)]
        limits = [(1 + SHARE) * value + floor for value in found[0]]
        form = "{:.2f}" if unit else "{:.4f}"
        cells = (" / ".join(map(form.format, values)) for values in (*found, limits))
        rows.append([f"{text} [{unit}]" if unit else text, *cells])
    return rows


def check_charts(result: CheckResult) -> Sequence[Chart]:
    """Setpoints, angles and predicted angles over time."""
    panels = []
    for axis in result.axes:
        signals = (
            ("setpoint", axis.setpoint, SETPOINT_COLOUR, ":"),
            ("flown", axis.angle, NEW, "-"),
            ("predicted", axis.expected, MODEL_COLOUR, "--"),
        )
        lines = [
            Line(*thinned(axis.time, np.degrees(values)), label, colour, dash)
            for label, values, colour, dash in signals
        ]
        panels.append(Panel(axis.name, "time [s]", "[deg]", lines))
    return [Chart("check-flight", "The doublets of the check flight, and what was predicted for them.", panels, 1)]


def write_autotune_report(run: AutotuneRun, gains: Gains, result: CheckResult) -> None:
    """Write the page to the folder."""
    flights = make_report([run.log(FLIGHT), run.log(CHECK)], [("new", gains)])
    outcome = f"worse than predicted: {'; '.join(result.worse)}" if result.worse else "as predicted"
    check = Section(
        "Check flight",
        tables=[ReportTable(CHECK_CAPTION, CHECKED, check_rows(result))],
        charts=check_charts(result),
    )
    write_report(
        run.file(REPORT),
        "mimopilot autotune",
        flights.lead,
        [check, *flights.sections],
        Headline(
            f"The check flight was {outcome}.",
            tone="bad" if result.worse else "good",
            notes=flights.headline.notes,
        ),
        LARGEST_PAGE,
    )
