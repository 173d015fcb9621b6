"""Commands of campaigns."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from mimopilot.cli.options import (
    AirframeArgument,
    AmplitudeOption,
    FaultOption,
    JsonOption,
    LogOutOption,
    PeriodOption,
    ScenarioOption,
    SeedOption,
    TailOption,
    WorkersOption,
)
from mimopilot.common.console import json_text, print_json, print_table, print_text
from mimopilot.common.errors import check_choice, check_not_given
from mimopilot.common.extras import CAMPAIGN, REPORT


def register(app: typer.Typer) -> None:
    """Add these commands to the command line."""
    app.command(
        epilog="Example: mimopilot campaign adam0 --gains siso.gains.toml mimo.gains.toml --runs 10000 "
        "--vary vary.toml --out campaign"
    )(campaign)
    app.command(epilog="Example: mimopilot replay campaign --run 4711 --out worst.ulg")(replay)


def campaign(
    airframe: AirframeArgument,
    out: Annotated[
        Path, typer.Option(file_okay=False, help="Folder for the results; what is done is kept when it is interrupted.")
    ],
    more_gains: Annotated[list[Path] | None, typer.Argument(hidden=True)] = None,
    gains: Annotated[
        list[Path] | None, typer.Option(help="Gains files: --gains FILE [FILE...]; by default the airframe's own.")
    ] = None,
    runs: Annotated[
        int, typer.Option(min=1, help="Number of runs; each is flown with every gain set on every axis.")
    ] = 1000,
    vary: Annotated[Path | None, typer.Option(help="What varies: see docs/campaigns.md; else the noise.")] = None,
    scenario: ScenarioOption = "doublet",
    axis: Annotated[str | None, typer.Option(help="roll, pitch or both.", show_default="both")] = None,
    amplitude_deg: AmplitudeOption = None,
    period_s: PeriodOption = None,
    tail_s: TailOption = None,
    fault: FaultOption = None,
    seed: SeedOption = 0,
    workers: WorkersOption = None,
    scheduler: Annotated[
        str | None, typer.Option(help="Address of a dask scheduler, tcp://HOST:PORT: its workers fly instead.")
    ] = None,
    survival_map: Annotated[
        str | None, typer.Option("--map", help="The two quantities of the survival map: NAME,NAME.")
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Fly many varied vehicles; report survival and tracking of each gain set."""
    CAMPAIGN.need()
    REPORT.need()
    from mimopilot.common.files import inside, write_atomically
    from mimopilot.common.parallel import cores
    from mimopilot.sitl.campaign.campaign_figures import parse_map
    from mimopilot.sitl.campaign.execution import run_campaign
    from mimopilot.sitl.campaign.pairs import PAIR_COLUMNS, pair_rows
    from mimopilot.sitl.campaign.plan import SUMMARY, make_plan
    from mimopilot.sitl.campaign.report import INTERVALS, PAIRS, VARIED, write_campaign_report
    from mimopilot.sitl.campaign.results import CampaignResults
    from mimopilot.sitl.campaign.summary import (
        FIGURE_COLUMNS,
        SURVIVAL_COLUMNS,
        WORST_COLUMNS,
        figure_rows,
        summarise,
        survival_rows,
        worst_rows,
    )
    from mimopilot.sitl.campaign.variation import read_variation
    from mimopilot.sitl.campaign.varied import VARIED_COLUMNS, varied_rows
    from mimopilot.sitl.physics.airframe import load_airframe

    vehicle = load_airframe(airframe)
    plan = make_plan(
        vehicle,
        vehicle.gain_sets([*(gains or ()), *(more_gains or ())]),
        runs=runs,
        seed=seed,
        **_task(scenario, axis, {"amplitude_deg": amplitude_deg, "period_s": period_s, "tail_s": tail_s}, fault),
        vary=read_variation(vary) if vary else {},
    )
    over = parse_map(plan, survival_map) if survival_map else None
    results = CampaignResults(plan, run_campaign(plan, out, workers or cores(), scheduler))
    summary = summarise(results)
    write_atomically(inside(out, SUMMARY), json_text(summary.as_json(".")))
    report = write_campaign_report(results, summary, over)
    if as_json:
        print_json({"results": str(results.path), "report": str(report), **summary.as_json(str(out))})
        return
    print_text(INTERVALS)
    if summary.rejected:
        print_text(f"{summary.rejected} impossible draws were repeated")
    if summary.varied:
        print_table(VARIED, VARIED_COLUMNS, varied_rows(summary.varied))
    print_table("Survived", SURVIVAL_COLUMNS, survival_rows(summary))
    print_table("Figures", FIGURE_COLUMNS, figure_rows(summary))
    if summary.pairs:
        print_table(PAIRS, PAIR_COLUMNS, pair_rows(summary.pairs))
    print_table("Worst flights", WORST_COLUMNS, worst_rows(summary, str(out)))
    print_text(f"results {results.path}\nreport  {report}")


def _task(scenario: str, axis: str | None, sizes: dict[str, float | None], faults: list[str] | None) -> dict[str, Any]:
    """Entries of the plan from the options that say what is flown."""
    from mimopilot.sitl.faults.kinds import parse_fault
    from mimopilot.sitl.flight.scenario import AMPLITUDE_DEG, AXES, PERIOD_S, TAIL_S, read_scenario

    named = [str(parse_fault(text)) for text in faults or ()]
    given: dict[str, Any] = {name: value for name, value in sizes.items() if value is not None}
    if scenario.endswith(".toml"):
        check_not_given(f"defined in {scenario}; change it there", axis=axis, **sizes)
        task, own = read_scenario(Path(scenario))
        given = {name: getattr(task, name) for name in sizes}
        scenario, axis, named = task.manoeuvre, task.axis, [*map(str, own), *named]
    if axis is not None:
        check_choice("--axis", axis, (*AXES, "both"))
    usual = {"amplitude_deg": AMPLITUDE_DEG, "period_s": PERIOD_S, "tail_s": TAIL_S}
    axes = [axis] if axis in AXES else list(AXES)
    return {"manoeuvre": scenario, "axes": axes, **usual, **given, "faults": named}


def replay(
    folder: Annotated[Path, typer.Argument(help="Folder of a campaign.")],
    run: Annotated[int, typer.Option(min=0, help="Which run.")],
    gains: Annotated[str | None, typer.Option(help="Name of the gain set; by default the first.")] = None,
    axis: Annotated[str | None, typer.Option(help="roll or pitch; by default the first.")] = None,
    out: LogOutOption = None,
    as_json: JsonOption = False,
) -> None:
    """Fly one run of a campaign again: the same flight, bit for bit. Exit code 1: it differs on this machine."""
    CAMPAIGN.need()
    from mimopilot.sitl.campaign.replay import replay_flight
    from mimopilot.sitl.flight.flight_log import save_flight
    from mimopilot.sitl.flight.metrics import FIGURE_LABELS

    again = replay_flight(folder, run, gains, axis)
    if out is not None:
        save_flight(out, again.flight, again.plan.airframe, again.plan.gains[again.row["gains"]])
    if as_json:
        print_json(again.row)
    else:
        rows = [[FIGURE_LABELS.get(name, name), _text(value)] for name, value in again.row.items()]
        print_table(f"{again.plan.airframe.name}, run {run} of {folder}", ["figure", "value"], rows)
    again.compare()


def _text(value: object) -> str:
    """A figure in a table; not a number: none."""
    if isinstance(value, float):
        return "-" if value != value else f"{value:.5g}"
    return str(value)
