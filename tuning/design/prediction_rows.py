"""Predicted figures of gain sets as rows of a table: the same in `tune`, `advise` and `autotune`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from mimopilot.tuning.design.prediction import giving_way
from mimopilot.tuning.gains import Gains

#: Columns of `predicted_rows`; without the first one, those of `prediction_cells`.
PREDICTED = ("", "tracking [deg]", "off-axis [deg]", "disturbance [deg]", "torque noise", "Ms")
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


def softer(predicted: Mapping[str, Any]) -> list[str]:
    """Where a step of torque moves the vehicle farther than with the flown gains, on each log; empty: nowhere.

    Of the predicted figures of roll and pitch, or of those of yaw.
    """
    found = []
    for new, flown in zip(predicted.get("tuned", ()), predicted.get("flown", ()), strict=False):
        after, before = (tuple(np.atleast_1d(one["disturbance_deg"]).tolist()) for one in (new, flown))
        if gives := giving_way(after, before):
            found.append(f"but a step of torque moves it farther ({gives}, at Ms {flown['Ms']:.2f})")
    return found


def prediction_cells(figures: Mapping[str, Any]) -> list[str]:
    """Cells of a row: the figures of `tuning.design.prediction.Prediction`, roll / pitch."""
    pairs = [figures[name] for name in ("follow_deg", "offaxis_deg", "disturbance_deg")]
    return [
        *(f"{roll:.2f} / {pitch:.2f}" for roll, pitch in pairs),
        "{:.4f} / {:.4f}".format(*figures["noise"]),
        f"{figures['Ms']:.2f}",
    ]
