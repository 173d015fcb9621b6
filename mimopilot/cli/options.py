"""Options and arguments that several commands share."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from mimopilot.common.extras import REPORT


def _page(path: Path | None) -> Path | None:
    """Refuse to begin work whose page could not be written."""
    if path is not None:
        REPORT.need()
    return path


AirframeArgument = Annotated[
    str,
    typer.Argument(
        help="Airframe: adam0, adam0_boom, adam0_flexible, adam0_nominal, adam0_perturbed, adam0_thesis, "
        "adam0_thesis_flown, adam0_thesis_perturbed, antr, antr_thesis, cf2, cf2_brushless, px4_sih; or a TOML file."
    ),
]
LogArgument = Annotated[
    Path,
    typer.Argument(
        help="Flight log: PX4 ULog, ArduPilot dataflash, Betaflight blackbox (CSV), Crazyflie uSD or Crazyflie CSV, "
        "CSV or MATLAB file."
    ),
]
GainsArgument = Annotated[Path, typer.Argument(help="Gains file: FILE.gains.toml.")]

GainsOption = Annotated[Path | None, typer.Option(help="Gains file; by default the airframe's own.")]
ColumnsOption = Annotated[
    Path | None, typer.Option(help="Names, units and signs of the columns of a CSV or MATLAB file (TOML).")
]
FaultOption = Annotated[
    list[str] | None,
    typer.Option("--fault", help="KIND[:TARGET][=SIZE]@AT[+DURATION], seconds; see mimopilot faults --kinds."),
]
ScenarioOption = Annotated[str, typer.Option(help="doublet, step, hover, or a scenario file (TOML).")]
AxisOption = Annotated[str | None, typer.Option(help="roll or pitch.", show_default="roll")]
AmplitudeOption = Annotated[float | None, typer.Option(help="Of the doublet or step, degrees.", show_default="22.5")]
PeriodOption = Annotated[
    float | None, typer.Option(help="Length of the whole doublet, of the step or of the hover, s.", show_default="0.42")
]
TailOption = Annotated[float | None, typer.Option(help="Level flight after a doublet, s.", show_default="1.5")]
SeedOption = Annotated[int, typer.Option(min=0, help="Seed of all randomness.")]
WorkersOption = Annotated[int | None, typer.Option(min=1, max=1024, help="Processes; by default one for each core.")]
SpeedOption = Annotated[str, typer.Option(help="Times real time, or max: as fast as possible.")]
LogOutOption = Annotated[Path | None, typer.Option(dir_okay=False, help="Also write the flight as a log (ULog, .ulg).")]
UncertifiedOption = Annotated[bool, typer.Option("--uncertified", help="Accept gains whose stability is in doubt.")]
ReportOption = Annotated[
    Path | None,
    typer.Option(
        dir_okay=False, callback=_page, help="Also write a page with figures of the log and of these gains (HTML)."
    ),
]
JsonOption = Annotated[bool, typer.Option("--json", help="Print one JSON object.")]
ProfileOption = Annotated[
    str | None,
    typer.Option(
        help="Controller: mimo (our module), px4-stock, ardupilot-stock (the autopilot's own); tune: also betaflight.",
        show_default="mimo",
    ),
]
YesOption = Annotated[bool, typer.Option("--yes", help="Do not ask.")]
TimeoutOption = Annotated[
    float, typer.Option(min=0.5, max=600, help="Abort after this many seconds without a message from the vehicle.")
]
KeyOption = Annotated[Path | None, typer.Option(help="Sign with this key: 32 bytes or 64 hexadecimal digits.")]
SystemOption = Annotated[
    int, typer.Option(min=0, max=255, help="The vehicle's system number; 0: the only one there is.")
]
