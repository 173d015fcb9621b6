"""The front door: one command, assembled from the rooms' own commands."""

from __future__ import annotations

import os
import sys

# Before numpy is loaded: results to the last bit must not depend on the number of cores, and worker processes whose
# BLAS threads wait for those of the others take six times as long.
os.environ["OPENBLAS_NUM_THREADS"] = os.environ["OMP_NUM_THREADS"] = os.environ["MKL_NUM_THREADS"] = "1"

import typer

import codegen.commands
import sitl.campaign.commands
import sitl.commands
import sitl.mavlink.commands
import sitl.studies.commands
import tuning.commands
from codegen.errors import CodegenError
from sitl.errors import SitlError
from tuning.errors import TuningError

app = typer.Typer(
    name="mimopilot",
    help="From one flight to tuned, tested C++ for a multirotor's roll and pitch.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)
for commands in (
    sitl.studies.commands,
    sitl.commands,
    sitl.campaign.commands,
    tuning.commands,
    codegen.commands,
    sitl.mavlink.commands,
):
    commands.register(app)


def main() -> None:
    """Run the command line; a user's mistake is one clear message and exit code 2, never a traceback."""
    try:
        app()
    except (TuningError, CodegenError, SitlError) as error:
        print(f"mimopilot: {error}", file=sys.stderr)
        sys.exit(error.exit_code)
    except OSError as error:
        where = f"{error.filename}: " if error.filename else ""
        print(f"mimopilot: {where}{error.strerror or error}", file=sys.stderr)
        sys.exit(2)


if __name__ == "__main__":
    main()
