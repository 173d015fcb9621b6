"""Commands of code generation."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from mimopilot.cli.options import GainsArgument, JsonOption, UncertifiedOption
from mimopilot.codegen.targets import targets
from mimopilot.common.verbosity import warn


def _known_options() -> str:
    """The options of all targets with their values."""
    named = [
        f"{option.replace('_', '-')} ({name}): {', '.join(values)}"
        for name, target in targets().items()
        for option, values in target.options.items()
    ]
    return "; ".join(named)


def register(app: typer.Typer) -> None:
    """Add these commands to the command line."""
    app.command(epilog="Example: mimopilot generate my.gains.toml --target native --out firmware")(generate)
    app.command(epilog="Example: mimopilot pil my.gains.toml --rows 10000 --json")(pil)


def generate(
    gains: GainsArgument,
    out: Annotated[
        Path,
        typer.Option(
            file_okay=False,
            help="Folder to write to; changed files are replaced, nothing is deleted, no link followed.",
        ),
    ],
    target: Annotated[
        str,
        typer.Option(help="; ".join(f"{name}: {target.help}" for name, target in targets().items()) + "."),
    ] = "native",
    px4_api: Annotated[
        str, typer.Option(help="PX4's module interface: crtp, up to v1.17, or descriptor, later.")
    ] = "crtp",
    option: Annotated[
        list[str] | None, typer.Option("--option", help=f"Option of a target, NAME=VALUE: {_known_options()}.")
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Overwrite files that mimopilot did not generate.")] = False,
    uncertified: UncertifiedOption = False,
) -> None:
    """Emit the C++ controller with its gains, parameter table, build files and tests."""
    import mimopilot as mp
    from mimopilot.codegen.errors import CodegenError

    options = {"px4_api": px4_api}
    for text in option or ():
        name, equals, value = text.partition("=")
        if not equals:
            raise CodegenError(f"--option {text}: expected NAME=VALUE")
        options[name.replace("-", "_")] = value
    tree = mp.generate(gains, out, target=target, force=force, uncertified=uncertified, **options)
    warn(gains, tree.warnings)
    count, written = len(tree.files), len(tree.written)
    print(f"{out}: {count} files, {written} written, {count - written} unchanged")


def pil(
    gains: GainsArgument,
    rows: Annotated[int, typer.Option(min=1, max=1_000_000, help="Control periods to run.")] = 10_000,
    emulator: Annotated[str, typer.Option(help="unicorn (the processor) or qemu (a board, from reset).")] = "unicorn",
    as_json: JsonOption = False,
) -> None:
    """Run the controller on an emulated Cortex-M4F and on the host, compare every bit, and print what a step costs."""
    from mimopilot.codegen.budget import processor_in_the_loop
    from mimopilot.codegen.errors import CodegenError
    from mimopilot.common.console import print_json, print_table
    from mimopilot.tuning.gains_file import load_gains

    figures = processor_in_the_loop(load_gains(gains), rows, emulator)
    failed = [figure.name for figure in figures if not figure.passed]
    if as_json:
        print_json({figure.name: figure.value for figure in figures} | {"emulator": emulator, "failed": failed})
    else:
        lines = []
        for figure in figures:
            value = f"{figure.value:.4g}" if isinstance(figure.value, float) else str(figure.value)
            verdict = ("", "") if figure.limit is None else (f"{figure.limit:g}", "pass" if figure.passed else "FAIL")
            lines.append([figure.text, value, *verdict])
        print_table(f"controller on a Cortex-M4F, {emulator}", ["what", "figure", "at most", ""], lines)
    if failed:
        raise CodegenError(f"over its budget: {', '.join(failed)}", exit_code=1)
