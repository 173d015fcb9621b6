"""The commands of this room."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer


def register(app: typer.Typer) -> None:
    """Add this room's commands to the front door."""
    app.command(epilog="Example: mimopilot inspect flight.ulg")(inspect)
    app.command(epilog="Example: mimopilot tune flight.ulg --inner 20,0.4,0 --outer 10,0.7,0 --out my.gains.toml")(tune)


LOG = Annotated[Path, typer.Argument(help="Flight log: PX4 ULog, ArduPilot dataflash, CSV or MATLAB file.")]
COLUMNS = Annotated[
    Path | None, typer.Option(help="Names, units and signs of the columns of a CSV or MATLAB file (TOML).")
]


def tune(
    log: LOG,
    out: Annotated[Path, typer.Option(help="Where the gains are written: FILE.gains.toml.")],
    method: Annotated[
        str | None, typer.Option(help="mimo (full matrices, the default) or siso (each axis by itself).")
    ] = None,
    inner: Annotated[
        str | None, typer.Option(help="Rate loop: OMEGA,ZETA,DELAY (rad/s, damping, samples); 20,0.4,0.")
    ] = None,
    outer: Annotated[str | None, typer.Option(help="Attitude loop: OMEGA,ZETA,DELAY; 10,0.7,0.")] = None,
    window: Annotated[
        int | None, typer.Option(help="Lags of the instrument, samples; by default from the models.")
    ] = None,
    spec: Annotated[
        Path | None, typer.Option(help="Specification (TOML): the above, and what the log does not say.")
    ] = None,
    columns: COLUMNS = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
) -> None:
    """Find the gains of the attitude cascade from one flight."""
    from tuning.cascade import tune as tune_cascade
    from tuning.gains import MATRICES
    from tuning.logs.columns import load_columns
    from tuning.logs.reader import read_log
    from tuning.output import print_json
    from tuning.spec import load_spec, parse_model

    task = load_spec(
        spec,
        method=method,
        inner=parse_model(inner) if inner else None,
        outer=parse_model(outer) if outer else None,
        window=window,
    )
    gains = tune_cascade(read_log(log, load_columns(columns) if columns else None), task)
    gains.save(out)
    deviations = gains.provenance["standard_deviation"]
    if as_json:
        matrices: dict[str, Any] = {name: getattr(gains, name).tolist() for name in MATRICES}
        print_json({"out": str(out), "method": task.method, **matrices, "standard_deviation": deviations})
        return
    print_gains(f"{task.method.upper()} gains from {log.name} (standard deviation)", gains, deviations)
    print(f"written to {out}")


def inspect(
    log: LOG,
    columns: COLUMNS = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
) -> None:
    """Show what is in a flight log, and whether gains can be tuned from it."""
    from tuning.logs.columns import load_columns
    from tuning.logs.inspection import inspect_log
    from tuning.logs.inspection_report import as_mapping, print_inspection
    from tuning.output import print_json

    found = inspect_log(log, load_columns(columns) if columns else None)
    if as_json:
        print_json(as_mapping(found))
    else:
        print_inspection(found)


def print_gains(title: str, gains: Any, deviations: dict[str, Any]) -> None:
    """The matrices of a set as a table, with standard deviations where they are known."""
    from tuning.gains import MATRICES
    from tuning.output import print_table

    rows = []
    for name in MATRICES:
        row = [name]
        for i in range(2):
            for j in range(2):
                text = f"{getattr(gains, name)[i][j]:.4f}"
                row.append(f"{text} ({deviations[name][i][j]:.4f})" if name in deviations else text)
        rows.append(row)
    print_table(title, ["", "roll<-roll", "roll<-pitch", "pitch<-roll", "pitch<-pitch"], rows)
