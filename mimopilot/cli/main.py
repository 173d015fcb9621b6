"""The command line: one command, assembled from the groups of this folder."""

from __future__ import annotations

import os
import sys

# Before numpy is loaded: worker processes whose BLAS threads wait for those of the others take six times as long, and
# results to the last bit must not depend on the number of cores.
os.environ["OPENBLAS_NUM_THREADS"] = os.environ["OMP_NUM_THREADS"] = os.environ["MKL_NUM_THREADS"] = "1"

import typer

from mimopilot.cli import bench, campaign, codegen, studies, tuning, vehicle
from mimopilot.common.errors import Error

app = typer.Typer(
    name="mimopilot",
    help="From one flight to tuned, tested C++ for a multirotor's roll and pitch.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)
for group in (studies, bench, campaign, tuning, codegen, vehicle):
    group.register(app)


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
