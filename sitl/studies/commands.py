"""The commands that use every room."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer


class Study(StrEnum):
    """What can be reproduced."""

    NUMERICAL_EXAMPLE = "numerical-example"
    LV100 = "lv100"


def register(app: typer.Typer) -> None:
    """Add the studies' commands to the front door."""
    app.command(epilog="Example: mimopilot demo --out demo --seed 0")(demo)
    app.command(epilog="Example: mimopilot reproduce lv100 --out reproduction")(reproduce)


def demo(
    out: Annotated[Path, typer.Option(help="Folder for the log, the gains, the C++ and the report.")] = Path("demo"),
    seed: Annotated[int, typer.Option(min=0, help="Seed of all randomness.")] = 0,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
) -> None:
    """The whole way, once: excitation flight, tuning, generated C++, doublets, report."""
    from sitl.studies.demo import print_summary, run_demo
    from tuning.output import print_json

    summary = run_demo(out, seed)
    if as_json:
        print_json(summary.as_json())
    else:
        print_summary(summary)


def reproduce(
    study: Annotated[Study, typer.Argument(help="Which benchmark of the thesis.")],
    out: Annotated[Path, typer.Option(help="Folder for the report.")] = Path("reproduction"),
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
) -> None:
    """Compute a benchmark of the thesis again and print it beside the thesis' figures."""
    from sitl.studies.reproduce import print_reproduction, reproduce_lv100, reproduce_numerical_example
    from tuning.output import print_json

    found = reproduce_lv100(out) if study is Study.LV100 else reproduce_numerical_example(out)
    if as_json:
        print_json(found.as_json())
    else:
        print_reproduction(found)
