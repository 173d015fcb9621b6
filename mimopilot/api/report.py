"""The report of a flight."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from mimopilot.api.arguments import given_columns, given_gains, given_spec
from mimopilot.common.blas import reproducible

if TYPE_CHECKING:
    from mimopilot.api.arguments import GainSet, PathLike
    from mimopilot.sitl.field.report.flight_report import FlightReport
    from mimopilot.tuning.spec import TuningSpec


@reproducible
def report(
    logs: PathLike | Sequence[PathLike],
    out: PathLike,
    *,
    gains: GainSet | Sequence[GainSet] = (),
    figures: PathLike | None = None,
    spec: PathLike | TuningSpec | None = None,
    columns: PathLike | None = None,
) -> FlightReport:
    """Write the report of a flight: one page with interactive figures, which needs no network.

    Parameters
    ----------
    logs : str or Path, or a list of them
        Any flight logs, also such that gains cannot be tuned from; the first is the one before.
    out : str or Path
        The page (HTML).
    gains : str, Path or Gains, or a list of them
        Shown beside the flown gains.
    figures : str or Path, optional
        Folder for the same figures as PNG and SVG.
    spec : str, Path or TuningSpec, optional
        Whose ``certificate`` says which margins are needed.
    columns : str or Path, optional
        As in `read_log`.

    Returns
    -------
    FlightReport
        What was written: headline, sections with their tables and figures, gain sets with their certificates.

    Raises
    ------
    Error
        When a file is no flight log or damaged, or the gains cannot be read.
    """
    from mimopilot.sitl.field.report.flight_report import make_report

    paths = [Path(one) for one in ([logs] if isinstance(logs, str | Path) else logs)]
    given: Sequence[GainSet] = [gains] if isinstance(gains, str | Path) or not isinstance(gains, Sequence) else gains
    named = [(_gains_name(one, place, len(given)), given_gains(one)) for place, one in enumerate(given)]
    found = make_report(paths, named, given_spec(spec, {}), given_columns(columns))
    found.write(Path(out), None if figures is None else Path(figures))
    return found


def _gains_name(gains: GainSet, place: int, count: int) -> str:
    """Name of a gain set in a report: that of its file, else new."""
    if isinstance(gains, str | Path):
        from mimopilot.tuning.gains_file import set_name

        return set_name(Path(gains))
    return "new" if count == 1 else f"new {place + 1}"
