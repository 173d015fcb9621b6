"""The commands of this room."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer


def register(app: typer.Typer) -> None:
    """Add this room's commands to the front door."""
    app.command(epilog="Example: mimopilot generate my.gains.toml --target native --out firmware")(generate)


def generate(
    gains: Annotated[Path, typer.Argument(help="Gains file: FILE.gains.toml.")],
    out: Annotated[Path, typer.Option(help="Folder to write to; changed files are replaced, nothing is deleted.")],
    target: Annotated[
        str,
        typer.Option(help="native: the controller, a C interface and tests for this machine; px4: a PX4 module too."),
    ] = "native",
    px4_api: Annotated[
        str, typer.Option(help="PX4's module interface: crtp, up to v1.17, or descriptor, later.")
    ] = "crtp",
    force: Annotated[bool, typer.Option("--force", help="Write over what mimopilot did not generate, too.")] = False,
    uncertified: Annotated[bool, typer.Option("--uncertified", help="Emit gains whose stability is in doubt.")] = False,
) -> None:
    """Emit the C++ controller with its gains, parameter table, build files and tests."""
    from codegen.parameters import check_verdict
    from codegen.render import render, write_tree
    from tuning.gains import load_gains

    loaded = load_gains(gains)
    warning = check_verdict(loaded, allow=uncertified)
    if warning:
        print(f"mimopilot: warning: {gains}: {warning}", file=sys.stderr)
    files = render(loaded, target, px4_api)
    written = write_tree(files, out, force)
    print(f"{out}: {len(files)} files, {len(written)} written, {len(files) - len(written)} unchanged")
