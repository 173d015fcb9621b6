"""Commands of whole experiments: demo, table of faults, reproduction of the thesis."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from mimopilot.cli.options import AirframeArgument, AxisOption, FaultOption, JsonOption, SeedOption, WorkersOption


class Study(StrEnum):
    """What can be reproduced: the thesis' benchmarks and vehicles, and ours; three are not part of all."""

    NUMERICAL_EXAMPLE = "numerical-example"
    LV100 = "lv100"
    ADAM0_SIM = "adam0-sim"
    ADAM0 = "adam0"
    ADAM0_PERTURBED = "adam0-perturbed"
    ANTR = "antr"
    ADAM0_SMALL = "adam0-small"
    COUPLED = "coupled"
    ADAM0_SIM_THESIS = "adam0-sim-thesis"
    ADAM0_THESIS = "adam0-thesis"
    ADAM0_PERTURBED_THESIS = "adam0-perturbed-thesis"
    ANTR_THESIS = "antr-thesis"
    ALL = "all"
    VEHICLES = "vehicles"
    GAINS = "gains"
    MANOEUVRES = "manoeuvres"


def register(app: typer.Typer) -> None:
    """Add these commands to the command line."""
    app.command(epilog="Example: mimopilot demo --out demo --seed 0")(demo)
    app.command(epilog="Example: mimopilot faults adam0 --gains siso.gains.toml --gains mimo.gains.toml --runs 50")(
        faults
    )
    app.command(epilog="Example: mimopilot reproduce lv100 --out reproduction")(reproduce)


def demo(
    out: Annotated[
        Path, typer.Option(file_okay=False, help="Folder for the log, the gains, the C++ and the report.")
    ] = Path("demo"),
    seed: SeedOption = 0,
    as_json: JsonOption = False,
) -> None:
    """Run the whole workflow once: excitation flight, tuning, generated C++, doublets, report."""
    from mimopilot.common.console import print_json
    from mimopilot.sitl.studies.demo import print_summary, run_demo

    summary = run_demo(out, seed)
    if as_json:
        print_json(summary.as_json())
    else:
        print_summary(summary)


def _print_kinds(wanted: bool) -> None:
    if wanted:
        from mimopilot.sitl.faults.kinds import fault_help

        print(fault_help())
        raise typer.Exit


def faults(
    airframe: AirframeArgument,
    gains: Annotated[
        list[Path] | None, typer.Option(help="Gains file; may be repeated. By default the airframe's own.")
    ] = None,
    runs: Annotated[int, typer.Option(min=1, max=1_000_000, help="Seeds of each fault.")] = 20,
    fault: FaultOption = None,
    axis: AxisOption = None,
    amplitude_deg: Annotated[float, typer.Option(help="Of the doublet, degrees.")] = 15.0,
    period_s: Annotated[float, typer.Option(help="Length of the whole doublet, s.")] = 0.42,
    seed: SeedOption = 0,
    workers: WorkersOption = None,
    kinds: Annotated[
        bool, typer.Option("--kinds", callback=_print_kinds, is_eager=True, help="List all kinds of faults and end.")
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Fly a doublet with each of the standard faults (or those given), many seeds, gain sets side by side."""
    from mimopilot.common.console import print_json
    from mimopilot.common.parallel import cores
    from mimopilot.sitl.errors import SitlError
    from mimopilot.sitl.faults.kinds import parse_fault
    from mimopilot.sitl.studies.fault_table import FaultTableRequest, fault_table
    from mimopilot.sitl.studies.fault_table_report import print_fault_table

    wanted = tuple(map(parse_fault, fault or ()))
    request = FaultTableRequest(airframe, tuple(gains or ()), axis or "roll", amplitude_deg, period_s, wanted)
    table = fault_table(request, range(seed, seed + runs), workers or cores())
    if as_json:
        print_json(table.as_json())
    else:
        print_fault_table(table)
    if table.nonfinite:
        raise SitlError(f"{table.nonfinite} outputs of the controller were not finite", exit_code=1)


def reproduce(
    study: Annotated[Study, typer.Argument(help="Which study, or all of them.")],
    out: Annotated[Path, typer.Option(file_okay=False, help="Folder for the report.")] = Path("reproduction"),
    seeds: Annotated[
        int | None, typer.Option(min=1, help="Experiments of each vehicle, with other noise; 50 by default, gains: 5.")
    ] = None,
    runs: Annotated[int | None, typer.Option(min=1, max=1_000_000, help="vehicles: how many; 500 by default.")] = None,
    first: Annotated[int | None, typer.Option(min=0, help="vehicles: seed of the first one; 0 by default.")] = None,
    workers: WorkersOption = None,
    as_json: JsonOption = False,
) -> None:
    """Compute the thesis' tables and figures again, beside its own figures.

    vehicles: tune many random vehicles. gains: all gain sets of four vehicles, from the flown ones to the optimum.
    manoeuvres: turns, flips, recovery and heading steps, beside a law on Euler angles.
    """
    from mimopilot.common.console import print_json
    from mimopilot.common.errors import check_not_given
    from mimopilot.sitl.studies.reproduction import print_reproduction

    if study is Study.VEHICLES:
        from mimopilot.sitl.studies.vehicles import RUNS, reproduce_vehicles

        check_not_given("only for experiments of the same vehicle; give --runs", seeds=seeds)
        found = reproduce_vehicles(out, runs or RUNS, first or 0, workers)
    else:
        check_not_given("only for the study vehicles", runs=runs, first=first)
        if study is Study.MANOEUVRES:
            from mimopilot.sitl.studies.manoeuvres import reproduce_manoeuvres

            check_not_given("the manoeuvres are flown once, without noise", seeds=seeds, workers=workers)
            found = reproduce_manoeuvres(out)
        elif study is Study.GAINS:
            from mimopilot.sitl.studies.gains_study import SEEDS as GAINS_SEEDS
            from mimopilot.sitl.studies.gains_study import reproduce_gains

            found = reproduce_gains(out, seeds or GAINS_SEEDS, workers)
        else:
            from mimopilot.sitl.studies.reproduce import SEEDS
            from mimopilot.sitl.studies.reproduce import reproduce as compute

            found = compute(study.value, out, seeds or SEEDS, workers)
    if as_json:
        print_json(found.as_json())
    else:
        print_reproduction(found)
