"""Commands of tuning: what a log holds, gains from it, and whether they are stable."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from mimopilot.cli.options import (
    ColumnsOption,
    JsonOption,
    LogArgument,
    OuterOption,
    warn,
)
from mimopilot.common.console import print_json, print_table, progress_console
from mimopilot.common.errors import check_not_given

if TYPE_CHECKING:
    from mimopilot.tuning.design.advise import Candidate
    from mimopilot.tuning.experiment import Experiment
    from mimopilot.tuning.gains import Gains
    from mimopilot.tuning.logs.columns import Columns
    from mimopilot.tuning.spec import TuningSpec

#: Candidates that `advise` prints; ``--json`` has all.
SHOWN = 24


def register(app: typer.Typer) -> None:
    """Add these commands to the command line."""
    app.command(epilog="Example: mimopilot inspect flight.ulg")(inspect)
    app.command(epilog="Example: mimopilot identify flight.ulg --order 4 --out plant.toml")(identify)
    app.command(
        epilog="Example: mimopilot tune flight.ulg --inner 20,0.4,0 --outer 10,0.7,0 --out my.gains.toml; "
        "mimopilot tune logs --campaign --out tuned"
    )(tune)
    app.command(epilog="Example: mimopilot certify flight.ulg --gains my.gains.toml")(certify)
    app.command(epilog="Example: mimopilot advise flight.ulg --outer 10,0.7,0 --out my.gains.toml")(advise)


def tune(
    logs: Annotated[list[Path], typer.Argument(help="Flight log; with --campaign many, or folders of them.")],
    out: Annotated[Path, typer.Option(help="Where the gains are written: FILE.gains.toml; a folder with --campaign.")],
    method: Annotated[
        str | None, typer.Option(help="mimo (full matrices, the default) or siso (each axis by itself).")
    ] = None,
    inner: Annotated[
        str | None, typer.Option(help="Rate loop: OMEGA,ZETA,DELAY (rad/s, damping, samples); 30,0.7,0 by default.")
    ] = None,
    outer: OuterOption = None,
    doublet: Annotated[
        str | None,
        typer.Option(help="Refine all gains for a doublet: DEGREES,SECONDS (whole length), such as 22.5,0.42."),
    ] = None,
    structure: Annotated[
        str | None,
        typer.Option(help="Terms of the rate controller: P, PI, PD or PID (the default), F behind for feed-forward."),
    ] = None,
    instrument: Annotated[
        str | None,
        typer.Option(
            help="external (lags of the injected torque, the default), u (of the total torque), model, repeated."
        ),
    ] = None,
    repeat: Annotated[
        Path | None, typer.Option(help="Log of a second flight of the same experiment: instrument repeated.")
    ] = None,
    window: Annotated[
        int | None, typer.Option(help="Lags of the instrument, samples; by default from the models.")
    ] = None,
    spec: Annotated[
        Path | None, typer.Option(help="Specification (TOML): the above, and what the log lacks.")
    ] = None,
    columns: ColumnsOption = None,
    campaign: Annotated[
        bool, typer.Option("--campaign", help="Tune each of many logs, and show how gains and certificates spread.")
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Find the gains of the attitude cascade from one flight."""
    import mimopilot as mp
    from mimopilot.tuning.errors import TuningError
    from mimopilot.tuning.logs.columns import load_columns
    from mimopilot.tuning.spec import load_spec, parse_doublet, parse_model

    task = load_spec(
        spec,
        method=method,
        inner=parse_model(inner) if inner else None,
        outer=parse_model(outer) if outer else None,
        manoeuvre=parse_doublet(doublet) if doublet else None,
        structure=structure,
        instrument=instrument or ("repeated" if repeat else None),
        window=window,
    )
    if campaign:
        check_not_given("belongs to one log, --campaign tunes many; leave it out", repeat=repeat)
        tune_campaign(logs, task, out, load_columns(columns) if columns else None, as_json)
        return
    if len(logs) > 1:
        raise TuningError(f"{len(logs)} logs: gains are tuned from one; --campaign tunes each by itself")
    log = logs[0]
    experiment = read_warned(log, columns)
    gains = mp.tune(experiment, spec=task, repeat=read_warned(repeat, columns) if repeat else None)
    gains.save(out)
    deviations = gains.provenance.standard_deviation
    warn(log, (warning for warning in gains.provenance.warnings if warning not in experiment.warnings))
    if as_json:
        matrices: dict[str, Any] = {name: matrix.tolist() for name, matrix in gains.matrices.items()}
        found = {"out": str(out), "method": task.method, **matrices, "standard_deviation": deviations}
        certificate = gains.certificate.as_table() if gains.certificate else None
        print_json({**found, "derivative_cutoff_hz": gains.derivative_cutoff_hz, "certificate": certificate})
        return
    print_gains(f"{task.method.upper()} gains from {log.name} (standard deviation)", gains, deviations)
    print_certificate(gains)
    print(f"written to {out}")


def tune_campaign(logs: list[Path], task: TuningSpec, out: Path, columns: Columns | None, as_json: bool) -> None:
    """`tune --campaign`: every log by itself, and the distributions."""
    from mimopilot.common.parallel import cores
    from mimopilot.tuning.design.many_logs import find_logs, tune_all

    found = tune_all(find_logs(logs), task, out, cores(), columns)
    if as_json:
        print_json({"out": str(out), **found.as_json()})
        return
    rows = [
        [f"{e.matrix} {e.pair}", *(f"{v:.4g}" for v in (e.mean, e.deviation, e.predicted, *e.quantiles))]
        for e in found.elements()
    ]
    columns_shown = ["gain", "mean", "deviation", "predicted", "5 %", "median", "95 %"]
    print_table(
        f"{task.method.upper()} gains from {len(found.tuned)} of {len(found.outcomes)} logs", columns_shown, rows
    )
    for verdict, count in found.verdicts.items():
        print(f"{verdict}: {count} of {len(found.tuned)}")
    for name, reason in found.refusals.items():
        print(f"refused: {name}: {reason}")
    print(f"written to {out}")


def certify(
    log: LogArgument,
    gains: Annotated[Path, typer.Option(help="Gains file to examine.")],
    out: Annotated[Path | None, typer.Option(help="Write the gains with their certificate to this file.")] = None,
    spec: Annotated[
        Path | None, typer.Option(help="Specification (TOML) whose [certificate] says what margins are needed.")
    ] = None,
    columns: ColumnsOption = None,
    as_json: JsonOption = False,
) -> None:
    """Check the stability of the closed loop, from a flight with any gains. Exit code 1: not certified."""
    import mimopilot as mp
    from mimopilot.tuning.certificate import ACCEPTED

    examined = mp.certify(read_warned(log, columns), gains, spec=spec)
    if out is not None:
        examined.save(out)
    if as_json:
        print_json(examined.certificate.as_table() if examined.certificate else {})
    else:
        print_certificate(examined)
    if examined.verdict()[0] not in ACCEPTED:
        raise typer.Exit(1)


def advise(
    log: LogArgument,
    outer: OuterOption = None,
    spec: Annotated[Path | None, typer.Option(help="Specification (TOML), as for tune.")] = None,
    out: Annotated[Path | None, typer.Option(help="Write the recommended gains to this file.")] = None,
    columns: ColumnsOption = None,
    as_json: JsonOption = False,
) -> None:
    """Scan bandwidth, damping and delay of the rate loop's model, and derivative filters; recommend one and say why."""
    from rich.progress import track

    import mimopilot as mp
    from mimopilot.tuning.spec import load_spec, parse_model

    task = load_spec(spec, outer=parse_model(outer) if outer else None)
    found = mp.advise(
        read_warned(log, columns),
        spec=task,
        watch=lambda grid: track(list(grid), "tuning", console=progress_console(), transient=True),
    )
    best = found.recommended
    assert best.gains is not None
    if out is not None:
        best.gains.save(out)

    def shown(candidate: Candidate) -> dict[str, Any]:
        return {name: value for name, value in vars(candidate).items() if name != "gains"}

    if as_json:
        print_json(
            {
                "recommended": shown(best),
                "nonminimum_phase_zero_rad_s": found.zero,
                "candidates": [shown(candidate) for candidate in found.candidates],
            }
        )
        return
    rows = []
    ordered = sorted(found.candidates, key=lambda c: (c.verdict != best.verdict, math.hypot(*c.follow_deg)))
    for c in ordered[:SHOWN]:
        pairs = [f"{a:.2f} / {b:.2f}" for a, b in (c.follow_deg, c.offaxis_deg, c.effort)]
        name = "{:g}, {:g}, {}".format(*c.inner)
        delta = "{:.2f} +- {:.2f}".format(*c.delta)
        row = ["* " + name if c is best else name, f"{c.cutoff_hz:g}", f"{c.fit:.2f}", *pairs, delta, c.verdict]
        rows.append(row)
    print("Rate loop: rad/s, damping, delay in samples; predicted RMS of an 18 degree doublet, roll / pitch")
    columns_shown = ["model", "D [Hz]", "fit", "to the model [deg]", "off-axis [deg]", "torque", "delta", "certificate"]
    print_table(f"{len(rows)} of {len(ordered)}, certified ones first, by how they follow", columns_shown, rows)
    zero = "no non-minimum-phase zero" if found.zero is None else f"non-minimum-phase zero at {found.zero:.1f} rad/s"
    print(f"{zero} from torque to rates")
    print(
        "recommended: --inner {:g},{:g},{} with a derivative filter of {:g} Hz: certified, follows within 10 % of the "
        "best of those, with the least torque".format(*best.inner, best.cutoff_hz)
    )


def print_certificate(gains: Gains) -> None:
    """Verdict, reason and margins of a certified set."""
    from mimopilot.tuning.parameter_row import ROLL_PITCH

    certificate = gains.certificate
    assert certificate is not None
    figures = certificate.figures
    print(f"{certificate.verdict}: {certificate.reason}")
    if not figures:
        return
    rows = [
        ["peak of the sensitivity, Ms", f"{figures['Ms']:.2f} +- {figures['Ms_error']:.2f}"],
        ["small gain of the rate loop, delta", f"{figures['delta']:.2f} +- {figures['delta_error']:.2f}"],
        ["disk margin", f"{figures['disk_margin']:.2f}"],
        ["all axes at once", f"{figures['simultaneous_gain_db']:.1f} dB, {figures['simultaneous_phase_deg']:.0f} deg"],
    ]
    for axis in ROLL_PITCH:
        kind = figures["gain_margin"][axis]
        gain = "gain not known" if kind == "not known" else f"{figures['gain_margin_db'][axis]:.1f} dB"
        phase, error = (figures[name][axis] for name in ("phase_margin_deg", "phase_margin_error_deg"))
        rows.append(
            [
                axis,
                f"{'at least ' if kind == 'at least' else ''}{gain}, {phase:.0f} +- {error:.0f} deg, "
                f"{figures['delay_margin_ms'][axis]:.1f} ms",
            ]
        )
    low, high = certificate.band
    print_table(f"Margins, known from {low:.1f} to {high:.0f} rad/s", ["", "value"], rows)


def inspect(
    log: LogArgument,
    columns: ColumnsOption = None,
    as_json: JsonOption = False,
) -> None:
    """Show what is in a flight log, and whether gains can be tuned from it."""
    import mimopilot as mp
    from mimopilot.tuning.logs.inspection_report import as_mapping, print_inspection

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
    out: Annotated[Path | None, typer.Option(help="Where the state space is written: FILE.toml.")] = None,
    columns: ColumnsOption = None,
    as_json: JsonOption = False,
) -> None:
    """Identify the plant from torque to body rates (PBSID, closed loop)."""
    from mimopilot.common.files import write_atomically
    from mimopilot.tuning.plant.frequency_response import measured_plant
    from mimopilot.tuning.plant.rates_model import identify_rates, model_toml

    experiment = read_warned(log, columns)
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
    print(f"one-step fit of the rates: roll {fits[0]:.1f} %, pitch {fits[1]:.1f} %")
    print(f"fit to the measured frequency response: {found.response_percent:.1f} %")
    if out is not None:
        print(f"written to {out}")


def read_warned(log: Path, columns: Path | None) -> Experiment:
    """The experiment in a log; warnings about it go to standard error."""
    import mimopilot as mp

    experiment = mp.read_log(log, columns)
    warn(log, experiment.warnings)
    return experiment


def print_gains(title: str, gains: Gains, deviations: Mapping[str, Any]) -> None:
    """The matrices of a set as a table, with standard deviations where they are known."""
    rows = []
    for name, matrix in gains.matrices.items():
        row = [name]
        for i in range(2):
            for j in range(2):
                text = f"{matrix[i][j]:.4f}"
                row.append(f"{text} ({deviations[name][i][j]:.4f})" if name in deviations else text)
        rows.append(row)
    print_table(title, ["", "roll<-roll", "roll<-pitch", "pitch<-roll", "pitch<-pitch"], rows)
