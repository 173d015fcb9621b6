"""Plots of a campaign: response envelopes, distributions of the figures, map of survival."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy.stats import rankdata

from mimopilot.common.charts import LIMIT, looks
from mimopilot.sitl.campaign.flights import FlightRunner
from mimopilot.sitl.campaign.plan import CampaignPlan
from mimopilot.sitl.campaign.results import CampaignResults
from mimopilot.sitl.campaign.varied import label, varied
from mimopilot.sitl.errors import SitlError
from mimopilot.sitl.flight.figures import SETPOINT
from mimopilot.sitl.flight.metrics import FIGURE_LABELS
from mimopilot.sitl.flight.scenario import AXES

ENVELOPE_RUNS = 400  # first runs, repeated for the envelopes
CELLS = 16  # largest number of cells on each side of the map
FLIGHTS_PER_CELL = 8  # least average number of flights per cell of the map
POINTS = 300  # points of a distribution curve
CROSSES = 200  # largest number of lost flights marked in the map
LARGEST = 75.0  # deg: limit of the angle axis of the envelopes


@dataclass(frozen=True, eq=False)
class EnvelopeSample:
    """The first runs of a campaign, flown again for the envelopes.

    Attributes
    ----------
    angles : dict
        (gain set, index of the scenario) -> (runs, N, 2) array: true roll and pitch, deg.
    survived : dict
        The same key -> (runs,) array.
    """

    angles: dict[tuple[str, int], NDArray[np.float32]]
    survived: dict[tuple[str, int], NDArray[np.bool_]]


def set_looks(plan: CampaignPlan) -> dict[str, tuple[str, str]]:
    """Gain set -> its colour and line style: the same as in every other report."""
    return dict(zip(plan.gains, looks([gains.provenance.kind for gains in plan.gains.values()]), strict=True))


def fly_sample(runner: FlightRunner) -> EnvelopeSample:
    """Fly the first `ENVELOPE_RUNS` runs again."""
    plan, runs = runner.plan, min(runner.plan.description.runs, ENVELOPE_RUNS)
    keys = [(name, index) for name in plan.gains for index in range(len(plan.scenarios))]
    angles = {key: np.empty((runs, len(runner.truth), 2), np.float32) for key in keys}
    survived = {key: np.empty(runs, np.bool_) for key in keys}
    for run in range(runs):
        draw = runner.draw(run)
        for key in keys:
            flight = runner.fly(draw, *key)
            angles[key][run] = np.degrees(flight.truth["attitude"][:, :2])
            survived[key][run] = flight.crashed_at is None
    return EnvelopeSample(angles, survived)


def envelope_figure(runner: FlightRunner, sample: EnvelopeSample, results: CampaignResults, index: int) -> Figure:
    """Responses on one axis: median, 5 to 95 %, and the worst flight; one row of panels per gain set.

    Parameters
    ----------
    runner : FlightRunner
        Repeats the worst flight.
    sample : EnvelopeSample
        From `fly_sample`.
    results : CampaignResults
        Names the worst flight.
    index : int
        Index of the scenario.
    """
    plan = runner.plan
    scenario, axis = plan.scenarios[index], plan.scenarios[index].axis
    time = (np.arange(len(scenario.setpoint)) - scenario.window[0]) * scenario.Ts
    figure = Figure(figsize=(9, 0.9 + 2.6 * len(plan.gains)), layout="constrained")
    panels: Any = figure.subplots(len(plan.gains), 2, sharex=True, sharey="col", squeeze=False)
    for row, (name, (colour, _)) in zip(panels, set_looks(plan).items(), strict=True):
        angles, survived = sample.angles[name, index], sample.survived[name, index]
        bad = results.worst(name, AXES[axis], 1)[0].run
        worst = np.degrees(runner.fly(runner.draw(bad), name, index).truth["attitude"][:, :2])
        for panel, shown in zip(row, (axis, 1 - axis), strict=True):
            if shown == axis:
                panel.step(time, np.degrees(scenario.setpoint[:, axis]), where="post", label="setpoint", **SETPOINT)
            if survived.any():
                low, median, high = np.percentile(angles[survived, :, shown], (5, 50, 95), axis=0)
                panel.fill_between(time, low, high, color=colour, alpha=0.3, linewidth=0, label="5 to 95 %")
                panel.plot(time, median, color=colour, linewidth=1.8, label="median")
            panel.plot(time, worst[:, shown], color="black", linestyle=":", linewidth=1.2, label=f"worst: run {bad}")
            panel.grid(alpha=0.3)
            panel.set_title(f"{name}: {AXES[shown]}{'' if shown == axis else ', off-axis'}", loc="left", fontsize=10)
            panel.set_ylabel("angle [deg]")
        row[0].legend(fontsize=8, loc="upper right", ncols=2)
        if not survived.all():
            row[1].set_title(f"{int((~survived).sum())} of {len(survived)} lost: not shown", loc="right", fontsize=8)
    for panel in panels[0]:  # a tumbling vehicle must not flatten the other curves; leave space for the legend
        low, high = panel.get_ylim()
        low, high = max(low, -LARGEST), min(high, LARGEST)
        panel.set_ylim(low, high + 0.3 * (high - low))
    for panel in panels[-1]:
        panel.set_xlabel("time from the start of the manoeuvre [s]")
        panel.set_xlim(max(-0.1, time[0]), time[-1])
    figure.suptitle(f"{AXES[axis].capitalize()} {scenario.name}", x=0.02, ha="left")
    return figure


def distribution_figure(results: CampaignResults, axis: str) -> Figure:
    """Cumulative distribution of each figure, one curve per gain set; lost flights count as infinite."""
    plan, names = results.plan, ("J_M_o", "offaxis_peak_deg", "peak_deg", "effort_rms")
    figure = Figure(figsize=(9, 6), layout="constrained")
    panels: Any = figure.subplots(2, 2, sharey=True)
    for panel, name in zip(panels.flat, names, strict=True):
        for gains, (colour, style) in set_looks(plan).items():
            survived = results.column("survived", gains, axis)
            ordered = np.sort(results.column(name, gains, axis)[survived])
            if not len(ordered):
                continue
            at = np.unique(np.linspace(0, len(ordered) - 1, POINTS).astype(int))
            share = (at + 1) / len(survived)
            panel.step(ordered[at], share, where="post", color=colour, linestyle=style, linewidth=1.8, label=gains)
        if name == "J_M_o":
            panel.set_xscale("log")
        panel.set_xlabel(FIGURE_LABELS[name])
        panel.set_ylim(0, 1.02)
        panel.grid(alpha=0.3, which="both")
    for row in panels:
        row[0].set_ylabel("fraction of flights [-]")
    if panels[0, 0].lines:
        panels[0, 0].legend(fontsize=8, loc="lower right")
    figure.suptitle(f"Distributions, {axis}", x=0.02, ha="left")
    return figure


def parse_map(plan: CampaignPlan, text: str) -> tuple[str, str]:
    """The two quantities of a survival map, from NAME,NAME.

    Raises
    ------
    SitlError
        When these are not two different quantities that vary.
    """
    known = varied(plan)
    first, _, second = text.partition(",")
    if first == second or not {first, second} <= set(known):
        raise SitlError(f"--map: got {text!r}, expected two varied quantities: {', '.join(known) or 'none'}")
    return first, second


def choose_map(results: CampaignResults) -> tuple[str, str] | None:
    """The two quantities with the largest rank correlation with survival, or with J_M,o when all survive.

    None when fewer than two vary.
    """
    plan, known = results.plan, varied(results.plan)
    if len(known) < 2:
        return None
    strength = dict.fromkeys(known, 0.0)
    for gains in plan.gains:
        for axis in plan.description.axes:
            survived = results.column("survived", gains, axis)
            badness = ~survived if not survived.all() else rankdata(results.column("J_M_o", gains, axis))
            for name in known:
                strength[name] = max(strength[name], _correlation(results.column(name, gains, axis), badness))
    first, second = sorted(known, key=lambda name: -strength[name])[:2]
    return first, second


def _correlation(value: NDArray[Any], other: NDArray[Any]) -> float:
    """Absolute rank correlation of a quantity or of its distance from its median, whichever is larger."""
    if np.ptp(value) == 0 or np.ptp(other.astype(float)) == 0:
        return 0.0
    both = (rankdata(value), rankdata(np.abs(value - np.median(value))))
    # Two values have the same distance from their median: those are no quantity that could matter.
    return max(abs(float(np.corrcoef(one, other)[0, 1])) for one in both if np.ptp(one) > 0)


def survival_figure(results: CampaignResults, axis: str, names: tuple[str, str]) -> Figure:
    """Fraction of surviving flights over two varied quantities; one panel per gain set."""
    plan = results.plan
    columns = min(len(plan.gains), 3)
    lines = -(-len(plan.gains) // columns)
    figure = Figure(figsize=(max(3.2 * columns + 0.8, 5), 3.0 * lines + 0.6), layout="constrained")
    panels: Any = figure.subplots(lines, columns, sharex=True, sharey=True, squeeze=False)
    image: Any = None
    for panel, gains in zip(panels.flat, plan.gains, strict=False):
        x, y, survived = (results.column(name, gains, axis) for name in (*names, "survived"))
        cells = int(np.clip(np.sqrt(len(x) / FLIGHTS_PER_CELL), 4, CELLS))
        edges = [_edges(x, cells), _edges(y, cells)]
        all_flights, _, _ = np.histogram2d(x, y, edges)
        good, _, _ = np.histogram2d(x[survived], y[survived], edges)
        share = np.divide(good, all_flights, out=np.full_like(good, np.nan), where=all_flights > 0)
        image = panel.pcolormesh(*edges, share.T, cmap="cividis", vmin=0, vmax=1, rasterized=True)
        lost = np.flatnonzero(~survived)[:CROSSES]
        panel.plot(x[lost], y[lost], "x", color=LIMIT, markersize=3, markeredgewidth=0.8)
        panel.set_title(f"{gains}: {int(survived.sum())} of {len(survived)} survived", loc="left", fontsize=10)
        panel.set_facecolor("white")
    for panel in panels[-1]:
        panel.set_xlabel(label(plan, names[0]))
    for row in panels:
        row[0].set_ylabel(label(plan, names[1]))
    for panel in list(panels.flat)[len(plan.gains) :]:
        panel.set_visible(False)
    figure.colorbar(image, ax=panels, label="fraction survived [-]  (white: not flown; x: lost)")
    figure.suptitle(f"Survived, {axis}", x=0.02, ha="left")
    return figure


def _edges(value: NDArray[Any], cells: int) -> NDArray[np.float64]:
    """Edges of the cells over a quantity; one cell per value when there are few values."""
    few = np.unique(value)
    if len(few) <= CELLS:
        middle = (few[1:] + few[:-1]) / 2
        step = np.diff(few).min() if len(few) > 1 else 1.0
        return np.concatenate([[few[0] - step / 2], middle, [few[-1] + step / 2]])
    return np.linspace(value.min(), value.max(), cells + 1)
