"""Commands in the field: vehicle and tuning together."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from mimopilot.cli.options import JsonOption, KeyOption, ProfileOption, SystemOption, TimeoutOption
from mimopilot.cli.vehicle import ConnectOption


def register(app: typer.Typer) -> None:
    """Add these commands to the command line."""
    app.command(epilog="Example: mimopilot autotune --connect udpin:0.0.0.0:14550 --take-off 5 --out tuned")(autotune)


def autotune(
    connect: ConnectOption,
    out: Annotated[
        Path, typer.Option(file_okay=False, help="Folder of logs, gains, decisions and report; the same one goes on.")
    ],
    profile: ProfileOption = None,
    take_off: Annotated[
        float | None,
        typer.Option(help="Arm, take off to this height, m, and land; by default a pilot takes off, hovers and lands."),
    ] = None,
    yes: Annotated[
        bool,
        typer.Option("--yes", help="Answer every question with yes; that to arm only if the vehicle is simulated."),
    ] = False,
    arm: Annotated[bool, typer.Option("--arm", help="Arm without a question.")] = False,
    seconds_per_axis: Annotated[float, typer.Option(help="Length of the excitation of an axis, s.")] = 20.0,
    amplitude: Annotated[
        float | None, typer.Option(help="Of the excitation, as in experiment; by default the profile's own.")
    ] = None,
    timeout: TimeoutOption = 12.0,
    signing_key: KeyOption = None,
    system: SystemOption = 0,
    as_json: JsonOption = False,
) -> None:
    """Tune a vehicle in one go: experiment, gains, check flight; keep the new gains, or go back to the old ones.

    The check flight flies doublets with the new gains. They are kept if it is not worse than predicted, nothing trips
    and the user agrees; otherwise the old gains are written back. The same command goes on after any interruption.
    Exit code 0: the new gains are kept; 1: the old ones are back, or a step failed.
    """
    from mimopilot.common.console import print_json
    from mimopilot.sitl.field.autotune_console import AutotuneTerminal
    from mimopilot.sitl.field.autotune_run import AutotuneOptions
    from mimopilot.sitl.field.workflow import autotune as run

    terminal = AutotuneTerminal(as_json)
    options = AutotuneOptions(
        connect,
        out,
        profile=profile or "mimo",
        take_off=take_off,
        yes=yes,
        arm=arm,
        seconds_per_axis=seconds_per_axis,
        amplitude=amplitude,
        system=system,
        timeout=timeout,
        signing_key=signing_key,
    )
    done = run(options, terminal)
    if as_json:
        print_json(done.as_table())
