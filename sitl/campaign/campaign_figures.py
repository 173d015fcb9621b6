"""Plots of a campaign: response envelopes, distributions of the figures, map of survival."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import rankdata

from mimopilot.common.charts import LIMIT, SETPOINT_COLOUR, looks
from mimopilot.common.figures import Chart, HeatMap, Line, Panel, Spread
from mimopilot.sitl.campaign.flights import FlightRunner
from mimopilot.sitl.campaign.plan import CampaignPlan
from mimopilot.sitl.campaign.results import CampaignResults
from mimopilot.sitl.campaign.varied import label, varied
from mimopilot.sitl.errors import SitlError
from mimopilot.sitl.flight.metrics import FIGURE_LABELS
from mimopilot.sitl.flight.scenario import AXES

ENVELOPE_RUNS = 400  # first runs, repeated for the envelopes
CELLS = 16  # largest number of cells on each side of the map
FLIGHTS_PER_CELL = 8  # least average number of flights per cell of the map
POINTS = 300  # points of a distribution curve
CROSSES = 200  # largest number of lost flights marked in the map
LARGEST = 75.0  # deg: limit of the angle axis of the envelopes
BEFORE = 0.1  # s before the manoeuvre that is shown


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


def envelope_chart(runner: FlightRunner, sample: EnvelopeSample, results: CampaignResults, index: int) -> Chart:
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
    scenario, axis = runner.plan.scenarios[index], runner.plan.scenarios[index].axis
    time = (np.arange(len(scenario.setpoint)) - scenario.window[0]) * scenario.Ts
    inside = time >= -BEFORE
    panels = []
    for name, look in set_looks(runner.plan).items():
        angles, survived = sample.angles[name, index], sample.survived[name, index]
        bad = results.worst(name, AXES[axis], 1)[0].run
        worst = np.degrees(runner.fly(runner.draw(bad), name, index).truth["attitude"][:, :2])
        for shown in (axis, 1 - axis):
            lines: list[Line | Spread] = []
            if shown == axis:
                setpoint = np.degrees(scenario.setpoint[:, axis])
                lines.append(Line(time[inside], setpoint[inside], "setpoint", SETPOINT_COLOUR, width=1.0, step=True))
            if survived.any():
                low, median, high = np.percentile(angles[survived, :, shown], (5, 50, 95), axis=0)[:, inside]
                lines.append(Spread(time[inside], low, high, "5 to 95 %", look[0]))
                lines.append(Line(time[inside], median, "median", look[0], width=2.0))
            fallen = worst[inside, shown]
            lines.append(Line(time[inside], fallen, f"worst: run {bad}", SETPOINT_COLOUR, ":", width=1.2))
            lost = "" if survived.all() else f"; {int((~survived).sum())} of {len(survived)} lost: not shown"
            title = f"{name}: {AXES[shown]}" + (lost if shown == axis else ", off-axis")
            panels.append(Panel(title, "time from the start of the manoeuvre [s]", "[deg]", lines))
    # One range for all sets, so that they compare; a tumbling vehicle must not flatten the other curves.
    panels = [replace(panel, y_range=_range(panels[place % 2 :: 2])) for place, panel in enumerate(panels)]
    return Chart(f"responses-{AXES[axis]}", f"{AXES[axis].capitalize()} {scenario.name}.", panels)


def _range(panels: Sequence[Panel]) -> tuple[float, float]:
    """Range of the angles in some panels, deg, with a little room, at most `LARGEST`."""
    values = [
        edge
        for panel in panels
        for one in panel.lines
        for edge in ((one.low, one.high) if isinstance(one, Spread) else (one.y,))  # type: ignore[union-attr]
    ]
    low, high = min(float(np.nanmin(one)) for one in values), max(float(np.nanmax(one)) for one in values)
    room = 0.05 * (high - low) + 1e-3
    return max(low - room, -LARGEST), min(high + room, LARGEST)


def distribution_chart(results: CampaignResults, axis: str) -> Chart:
    """Cumulative distribution of each figure, one curve per gain set; lost flights count as infinite."""
    plan, names = results.plan, ("J_M_o", "offaxis_peak_deg", "peak_deg", "effort_rms")
    panels = []
    for name in names:
        lines = []
        for gains, (colour, style) in set_looks(plan).items():
            survived = results.column("survived", gains, axis)
            ordered = np.sort(results.column(name, gains, axis)[survived])
            if len(ordered):
                at = np.unique(np.linspace(0, len(ordered) - 1, POINTS).astype(int))
                share = (at + 1) / len(survived)
                lines.append(Line(ordered[at], share, gains, colour, style, width=2.0, step=True))
        label = FIGURE_LABELS[name]
        log = name == "J_M_o" and bool(lines)
        panels.append(Panel(f"{axis}: {label}", label, "fraction of flights", lines, log_x=log, y_range=(0.0, 1.02)))
    return Chart(f"distributions-{axis}", f"Distributions of the figures on {axis}.", panels, linked=False)


def parse_map(plan: CampaignPlan, text: str) -> tuple[str, str]:
    """The two quantities of a survival map, from NAME,NAME.

    Raises
    ------
    SitlError
        When these are not two different quantities that vary.
    """
    known = varied(plan)
    if len(known) < 2:
        raise SitlError(f"--map: needs two quantities that vary, got {', '.join(known) or 'none'}; give more in --vary")
    first, _, second = text.partition(",")
    if first == second or not {first, second} <= set(known):
        raise SitlError(f"--map: got {text!r}, expected two varied quantities: {', '.join(known)}")
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


def survival_chart(results: CampaignResults, axis: str, names: tuple[str, str]) -> Chart:
    """Share of surviving flights over two varied quantities; one panel per gain set."""
    plan, panels = results.plan, []
    for gains in plan.gains:
        x, y, survived = (results.column(name, gains, axis) for name in (*names, "survived"))
        cells = int(np.clip(np.sqrt(len(x) / FLIGHTS_PER_CELL), 4, CELLS))
        edges = [_edges(x, cells), _edges(y, cells)]
        flown, _, _ = np.histogram2d(x, y, edges)
        good, _, _ = np.histogram2d(x[survived], y[survived], edges)
        share = np.divide(100.0 * good, flown, out=np.full_like(good, np.nan), where=flown > 0)
        across, along = ((one[1:] + one[:-1]) / 2 for one in edges)
        lost = np.flatnonzero(~survived)[:CROSSES]
        marks = Line(x[lost], y[lost], "lost", LIMIT, width=0, marker="x")
        lines: list[HeatMap | Line | Spread] = [HeatMap(across, along, share.T, "% survived", (0.0, 100.0))]
        lines += [marks] if len(lost) else []
        title = f"{gains}: {int(survived.sum())} of {len(survived)} survived"
        panels.append(Panel(title, label(plan, names[0]), label(plan, names[1]), lines, height=320))
    caption = f"Share of the flights on {axis} that survived; white: not flown. Crosses: lost flights."
    return Chart(f"survival-{axis}", caption, panels, columns=min(len(panels), 3), linked=False)


def _edges(value: NDArray[Any], cells: int) -> NDArray[np.float64]:
    """Edges of the cells over a quantity; one cell per value when there are few values."""
    few = np.unique(value)
    if len(few) <= CELLS:
        middle = (few[1:] + few[:-1]) / 2
        step = np.diff(few).min() if len(few) > 1 else 1.0
        return np.concatenate([[few[0] - step / 2], middle, [few[-1] + step / 2]])
    return np.linspace(value.min(), value.max(), cells + 1)
