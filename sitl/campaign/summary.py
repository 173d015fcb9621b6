"""Summary of a campaign: survival and figures with confidence intervals, and the worst flights."""

from __future__ import annotations

import shlex
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
from numpy.typing import NDArray

from mimopilot.common.intervals import quantile, wilson
from mimopilot.sitl.campaign.plan import CampaignPlan, reading_results
from mimopilot.sitl.flight.metrics import FIGURE_LABELS

#: Figures in the summary.
SHOWN = ("J_M_o", "peak_deg", "offaxis_peak_deg", "effort_rms", "saturated")
QUANTILES = (0.5, 0.95)
WORST = 3  # worst flights listed per group
BATCH = 1 << 14  # rows read at a time


@dataclass(frozen=True)
class WorstFlight:
    """One of the worst flights: when the vehicle was lost (s; None: never), and its J_M,o (rad^2)."""

    run: int
    lost_at_s: float | None
    J_M_o: float


@dataclass(frozen=True)
class GroupSummary:
    """Summary of all flights of one gain set on one axis.

    Attributes
    ----------
    gains, axis : str
    flights, survived : int
    survived_share : (low, high)
        Wilson's 95 % interval of the probability of survival.
    quantiles : dict
        Figure -> {"0.5": (value, low, high), ...}, 95 % intervals. A lost flight counts as
        infinite.
    worst : tuple of WorstFlight
        Lost flights first, by time; then by J_M,o.
    """

    gains: str
    axis: str
    flights: int
    survived: int
    survived_share: tuple[float, float]
    quantiles: dict[str, dict[str, tuple[float, float, float]]]
    worst: tuple[WorstFlight, ...]


@dataclass(frozen=True)
class CampaignSummary:
    """Summary of a whole campaign; `rejected` is the number of repeated draws."""

    runs: int
    rejected: int
    groups: tuple[GroupSummary, ...]

    def as_json(self, folder: str) -> dict[str, Any]:
        """The object that ``--json`` prints and `summary.json` holds; replay commands refer to `folder`."""
        table = asdict(self)
        for group in table["groups"]:
            for one in group["worst"]:
                one["replay"] = replay_command(folder, one["run"], group["gains"], group["axis"])
        return table


def replay_command(folder: str, run: int, gains: str, axis: str) -> str:
    """The command that repeats a flight."""
    return shlex.join(["mimopilot", "replay", folder, "--run", str(run), "--gains", gains, "--axis", axis])


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

    def summarise(self) -> CampaignSummary:
        """Summarise all groups."""
        d = self.plan.description
        groups = tuple(self._group(gains, axis) for gains in d.gains for axis in d.axes)
        return CampaignSummary(d.runs, int(self.column("rejected_draws", d.gains[0], d.axes[0]).sum()), groups)

    def _group(self, gains: str, axis: str) -> GroupSummary:
        survived = self.column("survived", gains, axis)
        n, k = len(survived), int(survived.sum())
        quantiles = {}
        for name in SHOWN:
            ordered = np.sort(np.where(survived, self.column(name, gains, axis), np.inf))
            quantiles[name] = {f"{p:g}": quantile(ordered, p) for p in QUANTILES}
        return GroupSummary(gains, axis, n, k, wilson(k, n), quantiles, tuple(self.worst(gains, axis, WORST)))


SURVIVAL_COLUMNS = ("gains, axis", "survived", "95 % interval")
FIGURE_COLUMNS = ("figure", "gains, axis", "median", "95 % interval", "95 % quantile", "95 % interval")
WORST_COLUMNS = ("gains, axis", "run", "lost at [s]", "J_M,o [rad^2]", "replay command")


def survival_rows(summary: CampaignSummary) -> list[list[str]]:
    """One row per gain set and axis."""
    return [
        [f"{g.gains}, {g.axis}", f"{g.survived}/{g.flights}", "{:.2%} to {:.2%}".format(*g.survived_share)]
        for g in summary.groups
    ]


def figure_rows(summary: CampaignSummary) -> list[list[str]]:
    """One row per figure, gain set and axis: quantiles with their intervals."""
    return [
        [
            FIGURE_LABELS[name],
            f"{group.gains}, {group.axis}",
            *(cell for p in QUANTILES for cell in _cells(group, name, p)),
        ]
        for name in SHOWN
        for group in summary.groups
    ]


def _cells(group: GroupSummary, name: str, p: float) -> tuple[str, str]:
    """A quantile and its interval; a dash for a bound that needs more flights."""
    found = group.quantiles[name][f"{p:g}"]
    value, low, high = ("lost" if v == np.inf else "-" if np.isnan(v) else f"{v:.3g}" for v in found)
    return value, f"{low} to {high}"


def worst_rows(summary: CampaignSummary, folder: str) -> list[list[str]]:
    """One row per worst flight."""
    return [
        [
            f"{group.gains}, {group.axis}",
            str(one.run),
            "-" if one.lost_at_s is None else f"{one.lost_at_s:.2f}",
            f"{one.J_M_o:.4g}",
            replay_command(folder, one.run, group.gains, group.axis),
        ]
        for group in summary.groups
        for one in group.worst
    ]
