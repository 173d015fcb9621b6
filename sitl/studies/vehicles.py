"""`mimopilot reproduce vehicles`: many random vehicles, each tuned from one experiment with no option."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

from mimopilot.common.files import inside
from mimopilot.common.html_report import Section, write_report
from mimopilot.common.long_work import Piece, run_pieces
from mimopilot.common.parallel import cores
from mimopilot.sitl.studies.reproduction import Reproduction
from mimopilot.sitl.studies.vehicle_bars import bars, bars_table, failures_table, outcomes_table
from mimopilot.sitl.studies.vehicle_run import run_vehicle

VEHICLES = "vehicles"
RUNS = 500

LEAD = (
    "Random vehicles fly one experiment each under diagonal gains with a random true Ms of 1.2 to 2.0, are tuned from "
    "it with no option, and fly doublets of five kinds. True figures come from the exact linear model, following and "
    "cross axis from the flights. A run is repeated with --runs 1 --first SEED."
)


def reproduce_vehicles(out: Path, runs: int = RUNS, first: int = 0, workers: int | None = None) -> Reproduction:
    """Run the study and write its report.

    Parameters
    ----------
    out : Path
        Folder of the report, vehicles.html. Each finished run is kept in it.
    runs : int
        Number of vehicles.
    first : int
        Seed of the first one; the others follow.
    workers : int, optional
        Processes; by default one per core. The result does not depend on it.

    Raises
    ------
    Error
        When the folder is in use; exit code 130 after Ctrl-C.
    """
    report = inside(out, f"{VEHICLES}.html")
    pieces = [Piece(f"vehicle-{seed:06d}", run_vehicle, seed, "") for seed in range(first, first + runs)]
    results = list(run_pieces(pieces, out, workers or cores(), f"mimopilot reproduce {VEHICLES}").values())
    found = bars(results)
    tables = [outcomes_table(results), bars_table(found), failures_table(found)]
    write_report(report, f"mimopilot reproduce {VEHICLES}", LEAD, [Section("Vehicles", "", tables)])
    figures = {"bars": [{**asdict(bar), "met": bar.met} for bar in found], "runs": results}
    return Reproduction(figures, tuple(tables), report)
