"""What varied in a campaign: each drawn quantity, its distribution and what was drawn; the coupling that results."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mimopilot.sitl.campaign.draws import MOMENTS, PRODUCTS, RunSampler
from mimopilot.sitl.campaign.plan import CampaignPlan
from mimopilot.sitl.campaign.results import CampaignResults
from mimopilot.sitl.campaign.variation import VARIED_UNITS, Distribution
from mimopilot.sitl.faults.kinds import KINDS

#: Quantiles of what was drawn.
RANGE = (0.05, 0.5, 0.95)
#: Name of the coupling between roll and pitch in the table.
COUPLING = "coupling of roll and pitch [-]"
VARIED_COLUMNS = ("quantity", "distribution", "drawn: 5 %", "median", "95 %", "vehicle")

Signal = NDArray[np.float64]


@dataclass(frozen=True)
class VariedSummary:
    """One quantity that varied.

    Attributes
    ----------
    name : str
        Column of the results, with the unit.
    distribution : str
        As specified.
    drawn : tuple of 3 float
        Quantiles `RANGE` of the drawn values.
    own : float
        Value of the airframe itself.
    """

    name: str
    distribution: str
    drawn: tuple[float, float, float]
    own: float


def varied(plan: CampaignPlan) -> list[str]:
    """Columns of the results that vary, in the order in which they are drawn."""
    return [quantity.name for quantity in _sampler(plan).quantities]


def _sampler(plan: CampaignPlan) -> RunSampler:
    return RunSampler(plan.airframe, plan.description.vary, plan.scenarios[0])


def label(plan: CampaignPlan, name: str) -> str:
    """Label of a varied quantity, with its unit."""
    if name.startswith("fault."):
        _, number, field = name.split(".")
        kind = plan.description.vary.fault[int(number) - 1].kind
        unit = {"size": KINDS[kind].unit, "motor": "-"}.get(field, "s")
        return f"{kind}: {field} [{unit}]"
    return f"{name} [{next(unit for start, unit in VARIED_UNITS.items() if name.startswith(start))}]"


def summarise_varied(results: CampaignResults) -> tuple[VariedSummary, ...]:
    """Every varied quantity; then the coupling J_xy / sqrt(J_xx J_yy), if the inertia varies."""
    plan = results.plan
    first = (plan.description.gains[0], plan.description.axes[0])
    columns = {name: results.column(name, *first) for name in varied(plan)}
    found = [
        VariedSummary(label(plan, q.name), _text(q.distribution), _quantiles(columns[q.name]), q.own)
        for q in _sampler(plan).quantities
    ]
    if any(name.startswith(("inertia.", "products.")) for name in columns):
        coupling, own = _coupling(plan, columns)
        text = "as drawn" if "products.xy" in columns else "the vehicle's own, kept"
        found.append(VariedSummary(COUPLING, text, _quantiles(coupling), own))
    return tuple(found)


def _coupling(plan: CampaignPlan, columns: dict[str, Signal]) -> tuple[Signal, float]:
    """J_xy / sqrt(J_xx J_yy) of every run, and of the airframe; see `draws.RunSampler`."""
    inertia = plan.airframe.plant().inertia
    own = {name: inertia["xyz".index(name[0]), "xyz".index(name[1])] for name in (*MOMENTS, *PRODUCTS)}
    runs = len(next(iter(columns.values())))
    xx, yy = (columns.get(f"inertia.{name}", np.full(runs, own[name])) for name in ("xx", "yy"))
    share = own["xy"] / np.sqrt(own["xx"] * own["yy"])
    drawn = columns["products.xy"] / np.sqrt(xx * yy) if "products.xy" in columns else np.full(runs, share)
    return drawn, float(share)


def _quantiles(values: Signal) -> tuple[float, float, float]:
    low, middle, high = np.quantile(values, RANGE)
    return float(low), float(middle), float(high)


def _text(distribution: Distribution) -> str:
    """A distribution as text."""
    kind = next(name for name in ("uniform", "normal", "loguniform") if getattr(distribution, name) is not None)
    first, second = getattr(distribution, kind)
    return f"{kind} {first:g}, {second:g}" + (" x own" if distribution.relative else "")


def varied_rows(found: tuple[VariedSummary, ...]) -> list[list[str]]:
    """One row per quantity."""
    return [[one.name, one.distribution, *(f"{v:.4g}" for v in one.drawn), f"{one.own:.4g}"] for one in found]
