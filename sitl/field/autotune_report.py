"""The page of an autotune: what was predicted, what was flown."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.figure import Figure

from mimopilot.common.charts import STYLES, svg
from mimopilot.common.html_report import ReportTable, Section, write_report
from mimopilot.sitl.field.autotune_run import CHECK, FLIGHT, REPORT, AutotuneRun
from mimopilot.sitl.field.check_flight import FIGURES, SHARE, CheckResult
from mimopilot.tuning.gains import Gains

#: Columns of `predicted_rows`, and of `check_rows`.
PREDICTED = ("", "follows [deg]", "other axis [deg]", "after torque [deg]", "noise of u", "Ms")
CHECKED = ("roll / pitch / yaw", "predicted", "flown", "limit")
CHECK_CAPTION = f"Doublets of the check flight; limit: {1 + SHARE:g} times the prediction, and a margin for gusts"


def predicted_rows(gains: Gains) -> list[list[str]]:
    """Predicted figures of the flown and of the new gains, as `tune` shows them."""
    rows = []
    for name, shown in (("flown", "flown"), ("siso", "SISO"), ("tuned", "new")):
        for figures in gains.provenance.details.get("predicted", {}).get(name, []):
            pairs = [figures[key] for key in ("follow_deg", "offaxis_deg", "disturbance_deg")]
            noise = "{:.4f} / {:.4f}".format(*figures["noise"])
            rows.append([shown, *(f"{a:.2f} / {b:.2f}" for a, b in pairs), noise, f"{figures['Ms']:.2f}"])
    return rows


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


def check_figure(result: CheckResult) -> Figure:
    """Setpoints, angles and predicted angles over time."""
    figure = Figure(figsize=(9, 3 * len(result.axes)), layout="constrained")
    panels: Any = figure.subplots(len(result.axes), 1)
    for axis, panel in zip(result.axes, panels, strict=True):
        panel.step(axis.time, np.degrees(axis.setpoint), color="black", linewidth=1, label="setpoint")
        lines = (axis.expected, "predicted"), (axis.angle, "flown")
        for (signal, label), (colour, style) in zip(lines, STYLES[1:], strict=False):
            panel.plot(axis.time, np.degrees(signal), color=colour, linestyle=style, label=label)
        panel.set_ylabel(f"{axis.name} [deg]")
        panel.grid(alpha=0.3)
    panels[0].legend(loc="upper right", fontsize=9, ncols=3)
    panels[-1].set_xlabel("time [s]")
    return figure


def write_autotune_report(run: AutotuneRun, gains: Gains, result: CheckResult) -> None:
    """Write the page to the folder."""
    verdict, reason = gains.verdict()
    outcome = f"Worse than predicted: {'; '.join(result.worse)}." if result.worse else "As predicted."
    caption = "RMS in doublets of 10 degrees, 0.4 to 2 s; after a step of torque; torque at hover. Roll / pitch"
    write_report(
        run.file(REPORT),
        "Autotune",
        f"From {run.log(FLIGHT).name} and {run.log(CHECK).name}. {outcome}",
        [
            Section(
                "Gains", f"Certificate: {verdict}, {reason}.", [ReportTable(caption, PREDICTED, predicted_rows(gains))]
            ),
            Section(
                "Check flight",
                tables=[ReportTable(CHECK_CAPTION, CHECKED, check_rows(result))],
                figures=[svg(check_figure(result), "check flight")],
            ),
        ],
    )
