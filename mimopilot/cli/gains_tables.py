"""Tables of a gain set: its gains, its certificate, and its predicted figures beside the flown ones."""

from __future__ import annotations

from collections.abc import Mapping
from math import isfinite
from typing import TYPE_CHECKING, Any

from mimopilot.cli.yaw_tables import print_cross_terms, yaw_cell, yaw_margins
from mimopilot.common.console import print_table, print_text
from mimopilot.common.text_table import with_deviation

if TYPE_CHECKING:
    from mimopilot.tuning.gains import Gains

#: Title of the tables of predicted figures.
PREDICTED_TITLE = (
    "Predicted, roll / pitch. In doublets of 10 degrees, 0.4 to 2 s: RMS error to the\n"
    "model ({model}), RMS off-axis angle; then RMS angle after a torque step,\n"
    "and RMS torque at hover"
)


def print_gains(title: str, gains: Gains, deviations: Mapping[str, Any]) -> None:
    """The matrices and the yaw gains of a set as a table, with standard deviations where they are known."""
    from mimopilot.tuning.parameters import with_unit

    rows = []
    for name, matrix in gains.matrices.items():
        known = deviations.get(name, [[None, None], [None, None]])
        cells = [with_deviation(matrix[i][j], known[i][j]) for i in range(2) for j in range(2)]
        rows.append([with_unit(name), *cells, yaw_cell(gains, name, deviations)])
    print_table(title, ["", "roll<-roll", "roll<-pitch", "pitch<-roll", "pitch<-pitch", "yaw"], rows)


def print_comparison(gains: Gains, logs: list[str]) -> None:
    """Predicted figures of a designed set beside those of the flown gains, and the conclusion."""
    from mimopilot.tuning.design.prediction_rows import PREDICTED, predicted_rows, softer

    details = gains.provenance.details
    if "predicted" not in details or gains.provenance.outer_model is None:
        return
    model = f"{gains.provenance.outer_model[0].bandwidth:g} rad/s"
    print_table(PREDICTED_TITLE.format(model=model), PREDICTED, predicted_rows(gains, logs))
    if details.get("better_than_flown"):
        print_text("better than the gains that flew: tracking and off-axis motion, within the limits of Ms and noise")
        for trade_off in softer(details["predicted"]):
            print_text(trade_off)
    worth = details.get("worth_of_off_diagonals", {})
    for before, after in zip(worth.get("tuned", ()), worth.get("module", ()), strict=True):
        print_text(
            f"off-diagonals would bring: the other axis moves {after[0]:.2f} / {after[1]:.2f} instead of "
            f"{before[0]:.2f} / {before[1]:.2f} degrees with our module"
        )
    for reason in details.get("keep_flown", ()):
        print_text(f"keep what you fly: {reason}")
    if details["limited_by"]:
        print_text(f"limited by: {', '.join(details['limited_by'])}")


def print_certificate(gains: Gains) -> None:
    """Verdict, reason and margins of a certified set."""
    certificate = gains.certificate
    assert certificate is not None
    figures = certificate.figures
    print_text(f"{certificate.verdict}: {certificate.reason}")
    if not figures:
        return
    rows = [
        ["peak of the sensitivity, Ms", f"{figures['Ms']:.2f} +- {figures['Ms_error']:.2f}"],
        ["disk margin", f"{figures['disk_margin']:.2f}"],
        ["all axes at once", f"{figures['simultaneous_gain_db']:.1f} dB, {figures['simultaneous_phase_deg']:.0f} deg"],
    ]
    if "predicted" not in gains.provenance.details:  # asked for a model of the rate loop
        delta = f"{figures['delta']:.2f} +- {figures['delta_error']:.2f}"
        rows.append(["small gain of the rate loop, delta", delta])
    for axis in figures["phase_margin_deg"]:
        kind = figures["gain_margin"][axis]
        gain = "gain not known" if kind == "not known" else f"{figures['gain_margin_db'][axis]:.1f} dB"
        phase, error = (figures[name][axis] for name in ("phase_margin_deg", "phase_margin_error_deg"))
        delay = figures["delay_margin_ms"][axis]
        crossing = f"{phase:.0f} +- {error:.0f} deg, {delay:.1f} ms" if isfinite(phase) else "no crossover in this band"
        rows.append([axis, f"{'at least ' if kind == 'at least' else ''}{gain}, {crossing}"])
    low, high = certificate.band
    rows += yaw_margins(figures)
    print_table(f"Margins, known from {low:.1f} to {high:.0f} rad/s", ["", "value"], rows)
    print_cross_terms(figures)
