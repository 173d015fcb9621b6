"""The HTML report of a campaign: tables and plots on one page."""

from __future__ import annotations

from pathlib import Path

from mimopilot.common.files import inside
from mimopilot.common.html_report import ReportTable, Section, write_report
from mimopilot.sitl.campaign import campaign_figures
from mimopilot.sitl.campaign.flights import flight_runner
from mimopilot.sitl.campaign.pairs import PAIR_COLUMNS, pair_rows
from mimopilot.sitl.campaign.plan import REPORT, SPEC
from mimopilot.sitl.campaign.results import CampaignResults
from mimopilot.sitl.campaign.summary import (
    FIGURE_COLUMNS,
    SURVIVAL_COLUMNS,
    WORST_COLUMNS,
    CampaignSummary,
    figure_rows,
    survival_rows,
    worst_rows,
)
from mimopilot.sitl.campaign.varied import VARIED_COLUMNS, varied_rows

INTERVALS = (
    "Survival with Wilson's 95 % interval; quantiles with 95 % intervals between order statistics. A lost flight "
    "counts as worse than any surviving one. Pairs: differences in the same run, over the runs that both sets survive."
)

#: Where no quantity varies.
NOTHING_VARIED = (
    "Nothing varied but the noise of the sensors: name a file with --vary to fly vehicles that differ from one another."
)
#: Captions of tables.
VARIED, PAIRS = "What varied", "Pairs of gain sets, run by run"


def write_campaign_report(
    results: CampaignResults, summary: CampaignSummary, over: tuple[str, str] | None = None
) -> Path:
    """Write `report.html` beside the results.

    Parameters
    ----------
    results : CampaignResults
        Plan and results.
    summary : CampaignSummary
        Summary of the results.
    over : (str, str), optional
        Quantities of the survival map; by default those of `sitl.campaign.campaign_figures.choose_map`.
    """
    plan = results.plan
    d, runner = plan.description, flight_runner(tuple(plan.files.items()))
    what = [f"{d.amplitude_deg:g} degrees", f"{d.period_s:g} s", *d.faults]
    lead = (
        f"{plan.airframe.name}: {d.runs} runs, seed {d.seed}, each a {d.manoeuvre} on {' and '.join(d.axes)} "
        f"({', '.join(what)}) under {', '.join(plan.gains)}. All gain sets fly the same vehicles with the same noise. "
        f"{summary.rejected} impossible draws were repeated."
    )
    tables = [
        ReportTable(VARIED, VARIED_COLUMNS, varied_rows(summary.varied)),
        ReportTable("Survived", SURVIVAL_COLUMNS, survival_rows(summary)),
        ReportTable("Figures", FIGURE_COLUMNS, figure_rows(summary)),
        ReportTable(PAIRS, PAIR_COLUMNS, pair_rows(summary.pairs)),
        ReportTable("Worst flights; run the commands in this folder", WORST_COLUMNS, worst_rows(summary, ".")),
    ]
    tables = [table for table in tables if table.rows]
    nothing = "" if summary.varied else f"{NOTHING_VARIED} "
    sample = campaign_figures.fly_sample(runner)
    envelopes = [campaign_figures.envelope_chart(runner, sample, results, index) for index in range(len(d.axes))]
    sections = [
        Section("Summary", nothing + INTERVALS, tables=tables),
        Section(
            "Responses",
            "True angles of the surviving runs among the first "
            f"{min(d.runs, campaign_figures.ENVELOPE_RUNS)}, and of the worst run of all.",
            charts=envelopes,
        ),
        Section(
            "Distributions",
            "Fraction of all flights whose figure is at most the abscissa. Further left is better. A curve that ends "
            "below 1 has lost the rest of the flights.",
            charts=[campaign_figures.distribution_chart(results, axis) for axis in d.axes],
        ),
    ]
    sections.append(_survival(results, summary, over))
    sections.append(
        Section(
            "What was flown", "", tables=[ReportTable(SPEC, ("",), [[line] for line in plan.files[SPEC].splitlines()])]
        )
    )
    path = inside(results.path.parent, REPORT)
    write_report(path, f"mimopilot campaign: {plan.airframe.name}", lead, sections)
    return path


def _survival(results: CampaignResults, summary: CampaignSummary, over: tuple[str, str] | None) -> Section:
    """Maps of survival over two quantities, for each axis on which some flights are lost; else what happened."""
    heading, names = "Survival", over or campaign_figures.choose_map(results)
    if names is None:
        return Section(heading, "No map: it needs two quantities that vary.")
    points, maps = [], []
    for axis in results.plan.description.axes:
        groups = [group for group in summary.groups if group.axis == axis]
        flights, survived = sum(group.flights for group in groups), sum(group.survived for group in groups)
        if 0 < survived < flights:
            maps.append(campaign_figures.survival_chart(results, axis, names))
        else:
            fate = "survived" if survived else "were lost"
            points.append(f"{axis}: all {flights} flights {fate}: a map of survival would have one colour.")
    return Section(heading, "Over two varied quantities." if maps else "", charts=maps, points=points)
