"""Gain sets compared run by run: every set flies the same vehicles with the same noise, so differences are paired."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np

from mimopilot.common.intervals import quantile, wilson
from mimopilot.sitl.campaign.results import CampaignResults
from mimopilot.sitl.flight.metrics import FIGURE_LABELS
from mimopilot.sitl.flight.scenario import AXES

#: Figures that are compared; less is better.
COMPARED = ("J_M_o", "offaxis_peak_deg", "offaxis_rms_deg", "effort_rms")
PAIR_COLUMNS = ("figure", "pair, axis", "median difference", "95 % interval", "second lower", "95 % interval")


@dataclass(frozen=True)
class PairComparison:
    """A figure of two gain sets on one axis, over the runs that both survive.

    Attributes
    ----------
    figure, axis : str
    first, second : str
        Gain sets.
    runs : int
        That both survive.
    only_first, only_second : int
        Runs that only one of them survives.
    difference : (value, low, high)
        Median of the second's figure minus the first's in the same run, with its 95 % interval.
    lower : int
        Runs in which the second's figure is lower.
    lower_share : (low, high)
        Wilson's 95 % interval of the probability of that.
    """

    figure: str
    axis: str
    first: str
    second: str
    runs: int
    only_first: int
    only_second: int
    difference: tuple[float, float, float]
    lower: int
    lower_share: tuple[float, float]


def compare_pairs(results: CampaignResults) -> tuple[PairComparison, ...]:
    """Every pair of gain sets, figure by figure.

    J_M,o is left out of a pair whose sets have different attitude models: each is judged by its own.
    """
    plan = results.plan
    return tuple(
        _compare(results, figure, axis, first, second)
        for first, second in combinations(plan.gains, 2)
        for figure in COMPARED
        for axis in plan.description.axes
        if figure != "J_M_o" or _same_model(results, axis, first, second)
    )


def _same_model(results: CampaignResults, axis: str, first: str, second: str) -> bool:
    ours, theirs = (results.plan.gains[name].reference_models(AXES.index(axis))[1] for name in (first, second))
    return (ours.num, ours.den, ours.delay) == (theirs.num, theirs.den, theirs.delay)


def _compare(results: CampaignResults, figure: str, axis: str, first: str, second: str) -> PairComparison:
    lived, lives = (results.column("survived", name, axis) for name in (first, second))
    both = lived & lives
    difference = (results.column(figure, second, axis) - results.column(figure, first, axis))[both]
    lower = int((difference < 0).sum())
    return PairComparison(
        figure=figure,
        axis=axis,
        first=first,
        second=second,
        runs=int(both.sum()),
        only_first=int((lived & ~lives).sum()),
        only_second=int((lives & ~lived).sum()),
        difference=quantile(np.sort(difference), 0.5),
        lower=lower,
        lower_share=wilson(lower, int(both.sum())),
    )


def pair_rows(found: tuple[PairComparison, ...]) -> list[list[str]]:
    """One row per figure, pair and axis."""

    def number(value: float) -> str:
        return "-" if np.isnan(value) else f"{value:+.3g}"

    return [
        [
            FIGURE_LABELS[one.figure],
            f"{one.second} - {one.first}, {one.axis}",
            number(one.difference[0]),
            f"{number(one.difference[1])} to {number(one.difference[2])}",
            f"{one.lower}/{one.runs}",
            "{:.1%} to {:.1%}".format(*one.lower_share),
        ]
        for one in found
    ]
