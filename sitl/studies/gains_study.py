"""`mimopilot reproduce gains`: the table of gain sets, from the flown gains to the optimum on the true plant."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from mimopilot.common.files import inside
from mimopilot.common.html_report import Section, write_report
from mimopilot.common.long_work import Piece, run_pieces
from mimopilot.common.parallel import cores
from mimopilot.sitl.physics.airframe import load_airframe
from mimopilot.sitl.studies.attitude_study import AttitudeStudy, studies
from mimopilot.sitl.studies.gains_report import LEAD, gains_figures, gains_tables
from mimopilot.sitl.studies.gains_run import optima, run_gains
from mimopilot.sitl.studies.reproduction import Reproduction

GAINS = "gains"
SEEDS = 5
#: Studies whose vehicle, experiment and thesis' models are used.
VEHICLES = ("adam0-sim", "coupled", "antr", "adam0-perturbed")


def vehicles() -> list[AttitudeStudy]:
    """The vehicles of the table; SISO is tuned on the vehicle's own log."""
    known = studies()
    return [replace(known[name], siso_airframe=known[name].airframe) for name in VEHICLES]


def reproduce_gains(out: Path, seeds: int = SEEDS, workers: int | None = None) -> Reproduction:
    """Run the study and write its report.

    Parameters
    ----------
    out : Path
        Folder of the report, gains.html. Each finished run is kept in it.
    seeds : int
        Experiments of each vehicle, with other noise and excitation.
    workers : int, optional
        Processes; by default one per core. The result does not depend on it.

    Raises
    ------
    Error
        When the folder is in use, or a vehicle was lost in the experiment; exit code 130 after Ctrl-C.
    """
    report = inside(out, f"{GAINS}.html")
    pieces = []
    for study in vehicles():
        best = Piece(f"gains-{study.airframe}-best", optima, study, repr(study))
        pieces.append(best)
        pieces += [
            Piece(_name(study, seed), run_gains, (study, seed), f"{study!r} {seed}", (best.name,))
            for seed in range(seeds)
        ]
    results = run_pieces(pieces, out, workers or cores(), f"mimopilot reproduce {GAINS}")
    runs = {study.airframe: [results[_name(study, seed)] for seed in range(seeds)] for study in vehicles()}
    tables = {name: gains_tables(name, some) for name, some in runs.items()}
    sections = [Section(name, load_airframe(name).airframe.description, every) for name, every in tables.items()]
    write_report(report, f"mimopilot reproduce {GAINS}", f"{LEAD} {seeds} seeds.", sections)
    figures = {name: gains_figures(some) for name, some in runs.items()}
    return Reproduction(figures, tuple(table for every in tables.values() for table in every), report)


def _name(study: AttitudeStudy, seed: int) -> str:
    return f"gains-{study.airframe}-{seed:04d}"
