"""The command line: one command, assembled from the groups of this folder."""

from __future__ import annotations

import os
import sys
from typing import Annotated

# Before numpy is loaded: worker processes whose BLAS threads wait for those of the others take six times as long.
os.environ["OPENBLAS_NUM_THREADS"] = os.environ["OMP_NUM_THREADS"] = os.environ["MKL_NUM_THREADS"] = "1"

import typer

from mimopilot.cli import campaign, codegen, field, simulation, sitl, studies, tuning, vehicle
from mimopilot.common.errors import Error

app = typer.Typer(
    name="mimopilot",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    context_settings={"help_option_names": ["-h", "--help"]},
)
for group in (studies, simulation, sitl, campaign, tuning, codegen, vehicle, field):
    group.register(app)


def _print_version(wanted: bool) -> None:
    if wanted:
        from importlib.metadata import version

        print(f"mimopilot {version('mimopilot')}")
        raise typer.Exit


@app.callback(help="From one flight to tuned, tested C++ for a multirotor's roll and pitch.")
def options(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version and end.")
    ] = False,
) -> None:
    """Options of the command itself."""


def main() -> None:
    """Run the command line; a user's mistake is one clear message and exit code 2, never a traceback."""
    try:
        app()
    except Error as error:
        print(f"mimopilot: {error}", file=sys.stderr)
        sys.exit(error.exit_code)
    except OSError as error:
        where = f"{error.filename}: " if error.filename else ""
        print(f"mimopilot: {where}{error.strerror or error}", file=sys.stderr)
        sys.exit(2)
