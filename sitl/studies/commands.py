"""The commands that use every room."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def register(app: typer.Typer) -> None:
    """Add the studies' commands to the front door."""
    app.command(epilog="Example: mimopilot demo --out demo --seed 0")(demo)


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
