"""Replay of one flight of a campaign from the files in its folder."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.compute as pc
import pyarrow.parquet as pq

from mimopilot.sitl.campaign.flights import FlightRunner
from mimopilot.sitl.campaign.plan import RESULTS, SPEC, CampaignPlan, plan_from_files, read_files, reading_results
from mimopilot.sitl.errors import SitlError
from mimopilot.sitl.flight.simulator import Flight


@dataclass(frozen=True, eq=False)
class Replay:
    """A repeated flight, its row of figures, and its row in the results (None before the parts are merged)."""

    plan: CampaignPlan
    flight: Flight
    row: dict[str, Any]
    flown: dict[str, Any] | None

    def compare(self) -> None:
        """Check that the flight equals the one in the results, bit for bit.

        Raises
        ------
        SitlError
            When a figure differs from the results.
        """
        for name, value in (self.flown or {}).items():
            if not _same(value, self.row.get(name)):
                raise SitlError(
                    f"{name} is {self.row.get(name)!r}, in the results {value!r}: the campaign was flown with another "
                    "version, compiler or processor; replay it with the same",
                    exit_code=1,
                )


def replay_flight(folder: Path, run: int, gains: str | None, axis: str | None) -> Replay:
    """Repeat one flight of a campaign.

    Parameters
    ----------
    folder : Path
        Folder of the campaign.
    run : int
        Number of the run, from 0.
    gains, axis : str or None
        Gain set and axis; None: the first of the campaign.

    Raises
    ------
    SitlError
        When the folder holds no campaign, or the campaign no such flight.
    """
    files = read_files(folder)
    if not files:
        raise SitlError(f"{folder}: not the folder of a campaign: {SPEC} is missing")
    plan = plan_from_files(files, str(folder))
    d = plan.description
    gains, axis = gains or d.gains[0], axis or d.axes[0]
    if run >= d.runs or gains not in d.gains or axis not in d.axes:
        raise SitlError(
            f"--run {run} --gains {gains} --axis {axis}: the campaign has runs 0 to {d.runs - 1}, gains "
            f"{', '.join(d.gains)} and axes {', '.join(d.axes)}"
        )
    runner = FlightRunner(plan)
    draw = runner.draw(run)
    flight = runner.fly(draw, gains, d.axes.index(axis))
    return Replay(
        plan, flight, runner.row(run, draw, gains, axis, flight), _row_in_results(folder / RESULTS, run, gains, axis)
    )


def _row_in_results(results: Path, run: int, gains: str, axis: str) -> dict[str, Any] | None:
    if not results.is_file():
        return None
    chosen = (pc.field("run") == run) & (pc.field("gains") == gains) & (pc.field("axis") == axis)
    with reading_results(results):
        (row,) = pq.read_table(results, filters=chosen, page_checksum_verification=True).to_pylist()
    return dict(row)


def _same(a: Any, b: Any) -> bool:
    if isinstance(a, float) and isinstance(b, float):
        return np.float64(a).tobytes() == np.float64(b).tobytes() or (a != a and b != b)
    return bool(a == b)
