"""The commands of this room."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer


def register(app: typer.Typer) -> None:
    """Add this room's commands to the front door."""
    app.command(epilog="Example: mimopilot identify flight.ulg --order 4 --out plant.toml")(identify)
    app.command(epilog="Example: mimopilot tune flight.ulg --inner 20,0.4,0 --outer 10,0.7,0 --out my.gains.toml")(tune)


def tune(
    log: Annotated[Path, typer.Argument(help="Flight log (PX4 ULog) with an injected moment.")],
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
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
) -> None:
    """Find the gains of the attitude cascade from one flight."""
    from tuning.cascade import tune as tune_cascade
    from tuning.gains import MATRICES
    from tuning.logs.ulog import read_ulog
    from tuning.output import print_json
    from tuning.spec import load_spec, parse_model

    task = load_spec(
        spec,
        method=method,
        inner=parse_model(inner) if inner else None,
        outer=parse_model(outer) if outer else None,
        window=window,
    )
    gains = tune_cascade(read_ulog(log), task)
    gains.save(out)
    deviations = gains.provenance["standard_deviation"]
    if as_json:
        matrices: dict[str, Any] = {name: getattr(gains, name).tolist() for name in MATRICES}
        print_json({"out": str(out), "method": task.method, **matrices, "standard_deviation": deviations})
        return
    print_gains(f"{task.method.upper()} gains from {log.name} (standard deviation)", gains, deviations)
    print(f"written to {out}")


def identify(
    log: Annotated[Path, typer.Argument(help="Flight log (PX4 ULog) with an injected moment.")],
    order: Annotated[int | None, typer.Option(help="States; by default from the singular values.")] = None,
    past: Annotated[int, typer.Option(help="Past window, samples.")] = 20,
    future: Annotated[int | None, typer.Option(help="Future window, samples; the past window by default.")] = None,
    out: Annotated[Path | None, typer.Option(help="Where the state space is written: FILE.toml.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
) -> None:
    """Identify the plant from control moment to body rates (PBSID, closed loop)."""
    from tuning.files import write_atomically
    from tuning.identification import identify_rates, model_toml
    from tuning.logs.ulog import read_ulog
    from tuning.output import print_json, print_table

    experiment = read_ulog(log)
    model, fits = identify_rates(experiment, order=order, past=past, future=future)
    if out is not None:
        write_atomically(out, model_toml(model, experiment.sha256))
    shown = model.singular_values[: max(10, model.order + 3)].tolist()
    poles = [(value.real, value.imag) for value in model.plant.poles.tolist()]
    if as_json:
        matrices = {name: getattr(model.plant, name).tolist() for name in "ABCD"}
        print_json(
            {
                "order": model.order,
                "past": model.past,
                "future": model.future,
                "samples": model.samples,
                "singular_values": shown,
                "poles": [list(pole) for pole in poles],
                "fit_percent": fits.tolist(),
                "Ts": model.plant.Ts,
                **matrices,
                "K": model.K.tolist(),
                "out": None if out is None else str(out),
            }
        )
        return
    print_table(
        f"Order {model.order} from {log.name} (past {model.past}, future {model.future}, {model.samples} samples)",
        ["state", "singular value", "pole (real)", "pole (imaginary)"],
        [
            [str(i + 1), f"{value:.4g}", *(f"{part:.5f}" for part in (poles[i] if i < len(poles) else ()))]
            for i, value in enumerate(shown)
        ],
    )
    print(f"one-step fit of the rates: roll {fits[0]:.1f} %, pitch {fits[1]:.1f} %")
    if out is not None:
        print(f"written to {out}")


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
