"""`mimopilot report`: one page about a flight, and the same from the commands that examine gains."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from mimopilot.cli.options import ColumnsOption, JsonOption
from mimopilot.common.console import print_json
from mimopilot.common.verbosity import warn

if TYPE_CHECKING:
    from mimopilot.tuning.gains import Gains
    from mimopilot.tuning.spec import TuningSpec


def register(app: typer.Typer) -> None:
    """Add this command to the command line."""
    app.command(
        epilog="Example: mimopilot report flight.ulg --gains my.gains.toml --out flight.html; "
        "mimopilot report before.ulg after.ulg --out compared.html --figures pictures"
    )(report)


def report(
    logs: Annotated[
        list[Path], typer.Argument(help="Any flight log; up to four to compare flights, the one before first.")
    ],
    out: Annotated[Path, typer.Option(dir_okay=False, help="The page to write (HTML).")],
    gains: Annotated[
        list[Path] | None, typer.Option(help="Gains file to show beside the flown gains; may be repeated.")
    ] = None,
    figures: Annotated[
        Path | None,
        typer.Option(file_okay=False, help="Folder for the same figures as PNG and SVG; made if it is missing."),
    ] = None,
    spec: Annotated[
        Path | None, typer.Option(help="Specification (TOML) whose [certificate] says what margins are needed.")
    ] = None,
    columns: ColumnsOption = None,
    as_json: JsonOption = False,
) -> None:
    """Show flights in one page with interactive figures, which needs no network; also logs that cannot be tuned from.

    Phases, tracking, step response, frequency response, stability, gains, predicted motion, spectra, vibration and
    filters: each section appears if the log holds its data, and says in one sentence what is missing if not.
    """
    import mimopilot as mp

    found = mp.report(logs, out, gains=gains or (), figures=figures, spec=spec, columns=columns)
    for flight in found.flights:
        warn(flight.recording.path, flight.found.warnings)
    if as_json:
        charts = [chart.name for chart in found.charts]
        tables = {one.caption: [dict(zip(one.columns, row, strict=False)) for row in one.rows] for one in found.tables}
        head = {"headline": found.headline.sentence, "next": list(found.headline.steps), "tone": found.headline.tone}
        head["notes"] = list(found.headline.notes)
        print_json({"out": str(out), **head, "figures": charts, "tables": tables})
        return
    print(found.headline.sentence)
    for step in found.headline.steps:
        print(f"next: {step}")
    for note in found.headline.notes:
        print(f"note: {note}")
    print(f"written to {out}" + (f", figures to {figures}" if figures else ""))


def write_report_of(
    logs: Sequence[Path], sets: Sequence[tuple[str, Gains]], out: Path, columns: Path | None, spec: TuningSpec
) -> None:
    """``--report``: the page about a command's logs and the gains, by name, that it found or examined."""
    from mimopilot.sitl.field.report.flight_report import make_report
    from mimopilot.tuning.logs.columns import load_columns

    make_report(logs, sets, spec, load_columns(columns) if columns else None).write(out)


def check_count(logs: Sequence[Path]) -> None:
    """Refuse more logs than a page has room for, before the work begins."""
    from mimopilot.sitl.field.report.flight_report import check_count as check

    check(len(logs))
