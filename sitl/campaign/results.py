"""The results of a campaign, read column by column."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
from numpy.typing import NDArray

from mimopilot.sitl.campaign.plan import CampaignPlan, reading_results

BATCH = 1 << 14  # rows read at a time


@dataclass(frozen=True)
class WorstFlight:
    """One of the worst flights: when the vehicle was lost (s; None: never), and its J_M,o (rad^2)."""

    run: int
    lost_at_s: float | None
    J_M_o: float


class CampaignResults:
    """The results of a campaign, read column by column: 8 bytes per flight are in memory at a time.

    Parameters
    ----------
    plan : CampaignPlan
        The campaign. Rows are ordered by run, gain set and axis.
    path : Path
        Parquet file.
    """

    def __init__(self, plan: CampaignPlan, path: Path) -> None:
        self.plan, self.path = plan, path

    def column(self, name: str, gains: str, axis: str) -> NDArray[Any]:
        """One column for the flights of a gain set on an axis, (runs,)."""
        axes = self.plan.description.axes
        stride = len(self.plan.gains) * len(axes)
        offset = list(self.plan.gains).index(gains) * len(axes) + axes.index(axis)
        parts, start = [], 0
        with reading_results(self.path), pq.ParquetFile(self.path, page_checksum_verification=True) as table:
            for batch in table.iter_batches(BATCH, columns=[name]):
                values = batch.column(0).to_numpy(zero_copy_only=False)
                parts.append(values[(offset - start) % stride :: stride].copy())
                start += len(values)
        return np.concatenate(parts)

    def worst(self, gains: str, axis: str, count: int) -> list[WorstFlight]:
        """The worst flights of a group: lost flights first, by time; then by J_M,o."""
        badness, lost_at = self.column("J_M_o", gains, axis), self.column("lost_at_s", gains, axis)
        lost = np.isfinite(lost_at)
        order = np.lexsort((-np.where(lost, 0.0, badness), np.where(lost, lost_at, np.inf)))[:count]
        return [WorstFlight(int(i), float(lost_at[i]) if lost[i] else None, float(badness[i])) for i in order]
