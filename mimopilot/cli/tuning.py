"""Commands of tuning: gains from a log, and whether they are stable."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from mimopilot.cli.gains_tables import PREDICTED_TITLE, print_certificate, print_comparison, print_gains
from mimopilot.cli.identification import read_warned
from mimopilot.cli.options import ColumnsOption, JsonOption, LogArgument, ProfileOption, ReportOption
from mimopilot.cli.report import check_count, write_report_of
from mimopilot.cli.yaw_tables import print_yaw, yaw_mapping
from mimopilot.common.console import print_json, print_table, print_text, progress_console
from mimopilot.common.errors import Error, check_not_given
from mimopilot.common.progress import step
from mimopilot.common.verbosity import warn

if TYPE_CHECKING:
    from mimopilot.tuning.logs.columns import Columns
    from mimopilot.tuning.spec import TuningSpec

#: Details of a designed set that `tune --json` has, too.
SHARED = ("predicted", "better_than_flown", "keep_flown", "worth_of_off_diagonals")


def register(app: typer.Typer) -> None:
    """Add these commands to the command line."""
    app.command(
        epilog="Example: mimopilot tune flight.ulg --out my.gains.toml; "
        "mimopilot tune light.ulg heavy.ulg --out both.gains.toml; "
        "mimopilot tune stock.ulg --profile px4-stock --out stock.gains.toml; "
        "mimopilot tune flight.ulg --inner 20,0.4,0 --outer 10,0.7,0 --out thesis.gains.toml"
    )(tune)
    app.command(
        epilog="Example: mimopilot certify flight.ulg --gains my.gains.toml; "
        "mimopilot certify flight.ulg --gains my.gains.toml --rate 400 --out my400.gains.toml"
    )(certify)
    app.command(epilog="Example: mimopilot advise flight.ulg")(advise)


def tune(
    logs: Annotated[
        list[Path],
        typer.Argument(help="Flight log, or several of one vehicle; with --campaign many, or folders of them."),
    ],
    out: Annotated[Path, typer.Option(help="Where the gains are written: FILE.gains.toml; a folder with --campaign.")],
    profile: ProfileOption = None,
    method: Annotated[
        str | None, typer.Option(help="mimo (full matrices, the default) or siso (each axis by itself).")
    ] = None,
    inner: Annotated[
        str | None,
        typer.Option(
            help="Rate loop: OMEGA,ZETA,DELAY (rad/s, damping, samples). The thesis' way: VRFT finds the gains for "
            "these models instead of the best ones."
        ),
    ] = None,
    outer: Annotated[str | None, typer.Option(help="Attitude loop, likewise.")] = None,
    follow_model: Annotated[
        bool, typer.Option("--follow-model", help="Run the attitude model in the controller, with feed-forward.")
    ] = False,
    structure: Annotated[
        str | None,
        typer.Option(help="Terms of the rate controller: P, PI, PD or PID (the default), F behind for feed-forward."),
    ] = None,
    instrument: Annotated[
        str | None,
        typer.Option(
            help="Of VRFT, with --inner or --outer: external (lags of the injected torque, the default), u (of the "
            "total torque), model, repeated."
        ),
    ] = None,
    repeat: Annotated[
        Path | None, typer.Option(help="Log of a second flight of the same experiment: instrument repeated of VRFT.")
    ] = None,
    window: Annotated[
        int | None, typer.Option(help="Lags of VRFT's instrument, samples; by default from the models.")
    ] = None,
    spec: Annotated[Path | None, typer.Option(help="Specification (TOML): the above, and what the log lacks.")] = None,
    columns: ColumnsOption = None,
    campaign: Annotated[
        bool, typer.Option("--campaign", help="Tune each of many logs, and show how gains and certificates spread.")
    ] = False,
    require_better: Annotated[
        bool, typer.Option("--require-better", help="Exit code 1 if the flown gains are better.")
    ] = False,
    report: ReportOption = None,
    as_json: JsonOption = False,
) -> None:
    """Find the best gains of the attitude cascade from one flight, and compare them with those that flew."""
    import mimopilot as mp
    from mimopilot.tuning.gains_file import set_name
    from mimopilot.tuning.logs.columns import load_columns
    from mimopilot.tuning.spec import load_spec, parse_model

    task = load_spec(
        spec,
        profile=profile,
        method=method,
        inner=parse_model(inner, "--inner") if inner else None,
        outer=parse_model(outer, "--outer") if outer else None,
        structure=structure,
        follow_model=follow_model or None,
        instrument=instrument or ("repeated" if repeat else None),
        window=window,
    )
    if out.is_dir() and not campaign:
        raise Error(f"--out: {out} is a folder; give the file to write, FILE.gains.toml, or --campaign")
    if campaign:
        check_not_given("belongs to one log, --campaign tunes many; leave it out", repeat=repeat, report=report)
        tune_campaign(logs, task, out, load_columns(columns) if columns else None, as_json)
        return
    if not task.for_models:
        text = "belongs to VRFT for given models; give --inner or --outer, too"
        check_not_given(text, instrument=instrument, repeat=repeat, window=window)
    else:
        check_not_given("belongs to the design; leave out --inner and --outer", follow_model=follow_model or None)
    if report is not None:
        check_count(logs)
    experiments = [read_warned(log, columns) for log in logs]
    second = read_warned(repeat, columns) if repeat else None
    with step("designing the gains"):
        gains = mp.tune(experiments if len(logs) > 1 else experiments[0], spec=task, repeat=second)
    gains.save(out)
    if report is not None:
        write_report_of(logs, [(set_name(out), gains)], report, columns, task)
    known = {warning for experiment in experiments for warning in experiment.warnings}
    warn(logs[0], (warning for warning in gains.provenance.warnings if warning not in known))
    details, deviations = gains.provenance.details, gains.provenance.standard_deviation
    comparison = {name: details[name] for name in SHARED if name in details}
    if as_json:
        matrices: dict[str, Any] = {name: matrix.tolist() for name, matrix in gains.matrices.items()}
        models = gains.provenance.as_table()
        found = {
            "out": str(out),
            "controller": gains.controller,
            "method": task.label,
            **matrices,
            "standard_deviation": deviations,
        }
        certificate = gains.certificate.as_table() if gains.certificate else None
        print_json(
            {
                **found,
                "derivative_cutoff_hz": gains.derivative_cutoff_hz,
                "attitude_model": models["outer_model"][0],
                "yaw": yaw_mapping(gains),
                **comparison,
                "certificate": certificate,
            }
        )
    else:
        names = " and ".join(log.name for log in logs)
        print_gains(f"{task.label.upper()} gains from {names} (standard deviation)", gains, deviations)
        print_comparison(gains, [log.name for log in logs])
        print_yaw(gains)
        print_certificate(gains)
        print_text(f"written to {out}")
    if require_better and not comparison.get("better_than_flown", False):
        raise typer.Exit(1)


def tune_campaign(logs: list[Path], task: TuningSpec, out: Path, columns: Columns | None, as_json: bool) -> None:
    """`tune --campaign`: every log by itself, and the distributions."""
    from mimopilot.common.parallel import cores
    from mimopilot.tuning.design.many_logs import find_logs, tune_all
    from mimopilot.tuning.parameters import with_unit

    found = tune_all(find_logs(logs), task, out, cores(), columns)
    if as_json:
        print_json({"out": str(out), **found.as_json()})
        return
    rows = [
        [f"{with_unit(e.matrix)} {e.pair}", *(f"{v:.4g}" for v in (e.mean, e.deviation, e.predicted, *e.quantiles))]
        for e in found.elements()
    ]
    columns_shown = ["gain", "mean", "deviation", "predicted", "5 %", "median", "95 %"]
    print_table(
        f"{task.method.upper()} gains from {len(found.tuned)} of {len(found.outcomes)} logs", columns_shown, rows
    )
    for verdict, count in found.verdicts.items():
        print_text(f"{verdict}: {count} of {len(found.tuned)}")
    for name, reason in found.refusals.items():
        print_text(f"refused: {name}: {reason}")
    print_text(f"written to {out}")


def certify(
    log: LogArgument,
    gains: Annotated[Path, typer.Option(help="Gains file to examine.")],
    out: Annotated[
        Path | None, typer.Option(dir_okay=False, help="Write the gains with their certificate to this file.")
    ] = None,
    rate: Annotated[
        float | None,
        typer.Option(help="Carry the gains to this control rate, Hz, and examine them there; by default their own."),
    ] = None,
    spec: Annotated[
        Path | None, typer.Option(help="Specification (TOML) whose [certificate] says what margins are needed.")
    ] = None,
    columns: ColumnsOption = None,
    report: ReportOption = None,
    as_json: JsonOption = False,
) -> None:
    """Check the stability of the closed loop, from a flight with any gains. Exit code 1: not certified."""
    import mimopilot as mp
    from mimopilot.tuning.certificate import ACCEPTED
    from mimopilot.tuning.gains_file import set_name
    from mimopilot.tuning.spec import load_spec

    experiment = read_warned(log, columns)
    with step("examining the loop"):
        examined = mp.certify(experiment, gains, rate=rate, spec=spec)
    if report is not None:
        write_report_of([log], [(set_name(gains), examined)], report, columns, load_spec(spec))
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
    spec: Annotated[Path | None, typer.Option(help="Specification (TOML), as for tune.")] = None,
    out: Annotated[Path | None, typer.Option(dir_okay=False, help="Write the recommended gains to this file.")] = None,
    columns: ColumnsOption = None,
    report: ReportOption = None,
    as_json: JsonOption = False,
) -> None:
    """Show the gains that tune finds beside alternatives: slower, faster, quieter, SISO, other derivative filters."""
    from dataclasses import asdict

    from rich.progress import track

    import mimopilot as mp
    from mimopilot.tuning.design.prediction_rows import PREDICTED, prediction_cells
    from mimopilot.tuning.spec import load_spec

    found = mp.advise(
        read_warned(log, columns),
        spec=load_spec(spec),
        watch=lambda grid: track(list(grid), "designing", console=progress_console(), transient=True),
    )
    best = found.recommended
    if out is not None:
        best.gains.save(out)
    if report is not None:
        write_report_of([log], [("recommended", best.gains)], report, columns, load_spec(spec))
    if as_json:
        candidates = [
            {
                "name": one.name,
                "bandwidth": one.bandwidth,
                "derivative_cutoff_hz": one.gains.derivative_cutoff_hz,
                **asdict(one.prediction),
                "verdict": str(one.gains.verdict()[0]),
                "reason": one.gains.verdict()[1],
            }
            for one in found.candidates
        ]
        print_json(
            {
                "recommended": candidates[0],
                "yaw": yaw_mapping(best.gains),
                "nonminimum_phase_zero_rad_s": found.zero,
                "candidates": candidates,
                "refused": found.refused,
            }
        )
        return
    rows = [
        [
            one.name,
            f"{one.bandwidth:g}",
            f"{one.gains.derivative_cutoff_hz:g}",
            *prediction_cells(asdict(one.prediction)),
            str(one.gains.verdict()[0]),
        ]
        for one in found.candidates
    ]
    columns_shown = ["", "model [rad/s]", "D [Hz]", *PREDICTED[1:], "certificate"]
    print_table(PREDICTED_TITLE.format(model="its own; flown: the recommended one's"), columns_shown, rows)
    for name, reason in found.refused.items():
        print_text(f"{name}: {reason}")
    print_yaw(best.gains)
    print_text(
        "no non-minimum-phase zero from torque to rates"
        if found.zero is None
        else f"non-minimum-phase zero at {found.zero:.1f} rad/s from torque to rates"
    )
