"""The command line: one command, assembled from the groups of this folder."""

from __future__ import annotations

import os
import sys
from typing import Annotated

# Before numpy is loaded: worker processes whose BLAS threads wait for those of the others take six times as long.
os.environ["OPENBLAS_NUM_THREADS"] = os.environ["OMP_NUM_THREADS"] = os.environ["MKL_NUM_THREADS"] = "1"

import typer

from mimopilot.cli import (
    campaign,
    codegen,
    doctor,
    field,
    identification,
    report,
    simulation,
    sitl,
    studies,
    tuning,
    vehicle,
)
from mimopilot.cli.checked_command import use_command
from mimopilot.common.errors import Error
from mimopilot.common.verbosity import Verbosity, set_verbosity

app = typer.Typer(
    name="mimopilot",
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    context_settings={"help_option_names": ["-h", "--help"]},
)
for group in (studies, simulation, sitl, campaign, identification, tuning, report, codegen, vehicle, field, doctor):
    group.register(app)
use_command(app)

#: What is wrong with the line itself: an option, a value, a name. Typer has had it from several modules.
UsageError: type[typer.BadParameter] = typer.BadParameter.__bases__[0]


def _print_version(wanted: bool) -> None:
    if wanted:
        from importlib.metadata import version

        print(f"mimopilot {version('mimopilot')}")
        raise typer.Exit


@app.callback(help="From one flight to tuned, tested C++ for a multirotor's roll and pitch.")
def options(
    context: typer.Context,
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version and end.")
    ] = False,
    quiet: Annotated[
        bool, typer.Option("--quiet", help="Only results and errors: no warnings, no progress. Anywhere on the line.")
    ] = False,
    verbose: Annotated[
        bool, typer.Option("--verbose", help="Show each step and its time on standard error. Anywhere on the line.")
    ] = False,
) -> None:
    """Options of the command itself."""
    if quiet and verbose:
        raise Error("--quiet and --verbose exclude each other; leave one out")
    set_verbosity(Verbosity.QUIET if quiet else Verbosity.VERBOSE if verbose else Verbosity.NORMAL)
    context.call_on_close(lambda: set_verbosity(Verbosity.NORMAL))  # a program that runs commands begins each anew


def main() -> None:
    """Run the command line; a user's mistake is one clear message and exit code 2, never a traceback."""
    output, code = sys.stdout, 0
    try:
        # Without standalone mode the parser raises its errors, in place of printing them in lines of its own.
        arguments = _global_options_first(sys.argv[1:]) or ["--help"]
        code = app(arguments, prog_name="mimopilot", standalone_mode=False) or 0
    except SystemExit as end:
        code = end.code if isinstance(end.code, int) else 0
    except UsageError as error:
        print(f"mimopilot: {_usage_message(error)}", file=sys.stderr)
        code = 2
    except typer.Abort:
        print("mimopilot: interrupted", file=sys.stderr)
        code = 1
    except Error as error:
        print(f"mimopilot: {error}", file=sys.stderr)
        code = error.exit_code
    except OSError as error:
        where = f"{error.filename}: " if error.filename else ""
        print(f"mimopilot: {where}{error.strerror or error}", file=sys.stderr)
        code = 2
    if sys.stdout is not output:  # typer replaces it when the reader of a pipe left, as head does: no failure
        sys.stdout, code = output, 0
    try:
        output.flush()
    except BrokenPipeError:
        # Python flushes once more at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), output.fileno())
    sys.exit(code)


def _global_options_first(arguments: list[str]) -> list[str]:
    """The arguments with ``--quiet`` and ``--verbose`` moved before the command's name."""
    end = arguments.index("--") if "--" in arguments else len(arguments)
    moved = [text for text in arguments[:end] if text in ("--quiet", "--verbose")]
    return [*moved, *(text for text in arguments[:end] if text not in moved), *arguments[end:]]


def _usage_message(error: typer.BadParameter) -> str:
    """A mistake on the command line in one line: the command, what is wrong, and where its options are explained."""
    text = (
        " ".join(error.format_message().split())
        .replace("Value error, ", "")
        .replace("Input should be", "expected")
        .removesuffix(".")
    )
    path = error.ctx.command_path if error.ctx else "mimopilot"
    where = path.removeprefix("mimopilot").strip()
    return f"{where}{': ' if where else ''}{text[:1].lower()}{text[1:]}; see {path} --help"
