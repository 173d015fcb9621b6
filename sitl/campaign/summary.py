"""Summary of a campaign: what varied, survival and figures with intervals, pairs of gain sets, the worst flights."""

from __future__ import annotations

import shlex
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from mimopilot.common.intervals import quantile, wilson
from mimopilot.sitl.campaign.pairs import PairComparison, compare_pairs
from mimopilot.sitl.campaign.results import CampaignResults, WorstFlight
from mimopilot.sitl.campaign.varied import VariedSummary, summarise_varied
from mimopilot.sitl.flight.metrics import FIGURE_LABELS

#: Figures in the summary.
SHOWN = ("J_M_o", "peak_deg", "offaxis_peak_deg", "effort_rms", "saturated")
QUANTILES = (0.5, 0.95)
WORST = 3  # worst flights listed per group


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
    """Summary of a whole campaign.

    Attributes
    ----------
    runs : int
    rejected : int
        Repeated draws.
    varied : tuple of VariedSummary
    groups : tuple of GroupSummary
    pairs : tuple of PairComparison
    """

    runs: int
    rejected: int
    varied: tuple[VariedSummary, ...]
    groups: tuple[GroupSummary, ...]
    pairs: tuple[PairComparison, ...]

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


def summarise(results: CampaignResults) -> CampaignSummary:
    """Summarise a campaign."""
    d = results.plan.description
    groups = tuple(_group(results, gains, axis) for gains in d.gains for axis in d.axes)
    rejected = int(results.column("rejected_draws", d.gains[0], d.axes[0]).sum())
    return CampaignSummary(d.runs, rejected, summarise_varied(results), groups, compare_pairs(results))


def _group(results: CampaignResults, gains: str, axis: str) -> GroupSummary:
    survived = results.column("survived", gains, axis)
    n, k = len(survived), int(survived.sum())
    quantiles = {}
    for name in SHOWN:
        ordered = np.sort(np.where(survived, results.column(name, gains, axis), np.inf))
        quantiles[name] = {f"{p:g}": quantile(ordered, p) for p in QUANTILES}
    return GroupSummary(gains, axis, n, k, wilson(k, n), quantiles, tuple(results.worst(gains, axis, WORST)))


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
