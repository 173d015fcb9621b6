"""Predicted figures of gain sets as rows of a table: the same in `tune`, `advise` and `autotune`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from mimopilot.tuning.gains import Gains

#: Columns of `predicted_rows`; without the first one, those of `prediction_cells`.
PREDICTED = ("", "follows [deg]", "other axis [deg]", "after torque [deg]", "noise of u", "Ms")
#: Gain set of a design -> its name in the table.
SETS = {"flown": "flown", "siso": "SISO", "tuned": "tuned", "module": "our module"}


def predicted_rows(gains: Gains, logs: Sequence[str]) -> list[list[str]]:
    """Rows of the flown gains, of the new ones and of those that they were compared with, for each log."""
    predicted = gains.provenance.details.get("predicted", {})
    return [
        [f"{shown}, {log}" if len(logs) > 1 else shown, *prediction_cells(predicted[name][place])]
        for place, log in enumerate(logs)
        for name, shown in SETS.items()
        if name in predicted
    ]


def prediction_cells(figures: Mapping[str, Any]) -> list[str]:
    """Cells of a row: the figures of `tuning.design.prediction.Prediction`, roll / pitch."""
    pairs = [figures[name] for name in ("follow_deg", "offaxis_deg", "disturbance_deg")]
    return [
        *(f"{roll:.2f} / {pitch:.2f}" for roll, pitch in pairs),
        "{:.4f} / {:.4f}".format(*figures["noise"]),
        f"{figures['Ms']:.2f}",
    ]
