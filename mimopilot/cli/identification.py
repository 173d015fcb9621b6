"""Commands that examine a log without tuning: what it holds, and the plant identified from it."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from mimopilot.cli.options import ColumnsOption, JsonOption, LogArgument
from mimopilot.common.console import print_json, print_table, print_text
from mimopilot.common.progress import step
from mimopilot.common.verbosity import warn

if TYPE_CHECKING:
    from mimopilot.tuning.experiment import Experiment


def register(app: typer.Typer) -> None:
    """Add these commands to the command line."""
    app.command(epilog="Example: mimopilot inspect flight.ulg")(inspect)
    app.command(epilog="Example: mimopilot identify flight.ulg --order 4 --out plant.toml")(identify)


def inspect(
    log: LogArgument,
    columns: ColumnsOption = None,
    as_json: JsonOption = False,
) -> None:
    """Show what is in a flight log, and whether gains can be tuned from it."""
    import mimopilot as mp
    from mimopilot.tuning.logs.inspection_report import as_mapping, print_inspection

    with step(f"reading {log.name}"):
        found = mp.inspect(log, columns)
    warn(log, found.warnings)
    if as_json:
        print_json(as_mapping(found))
    else:
        print_inspection(found)


def identify(
    log: LogArgument,
    order: Annotated[int | None, typer.Option(help="States; by default those that fit the measured response.")] = None,
    past: Annotated[int, typer.Option(help="Past window, samples.")] = 20,
    future: Annotated[int | None, typer.Option(help="Future window, samples; the past window by default.")] = None,
    out: Annotated[
        Path | None, typer.Option(dir_okay=False, help="Where the state space is written: FILE.toml.")
    ] = None,
    columns: ColumnsOption = None,
    as_json: JsonOption = False,
) -> None:
    """Identify the plant from torque to body rates (PBSID, closed loop)."""
    from mimopilot.common.files import write_atomically
    from mimopilot.tuning.plant.frequency_response import measured_plant
    from mimopilot.tuning.plant.rates_model import identify_rates, model_toml

    experiment = read_warned(log, columns)
    with step("identifying the plant"):
        found = identify_rates(experiment, measured_plant(experiment), order=order, past=past, future=future)
    model, fits = found.model, found.one_step_percent
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
                "response_fit_percent": found.response_percent,
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
    print_text(f"one-step fit of the rates: roll {fits[0]:.1f} %, pitch {fits[1]:.1f} %")
    print_text(f"fit to the measured frequency response: {found.response_percent:.1f} %")
    if out is not None:
        print_text(f"written to {out}")


def read_warned(log: Path, columns: Path | None) -> Experiment:
    """The experiment in a log; warnings about it go to standard error."""
    import mimopilot as mp

    with step(f"reading {log.name}"):
        experiment = mp.read_log(log, columns)
    warn(log, experiment.warnings)
    return experiment
