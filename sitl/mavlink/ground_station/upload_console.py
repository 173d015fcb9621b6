"""What a user of `upload` and `restore` sees: the tables before and after, and the question."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Literal

import typer

from mimopilot.common.console import print_json, print_table, print_text
from mimopilot.sitl.errors import SitlError
from mimopilot.sitl.mavlink.ground_station.events import Heartbeat
from mimopilot.sitl.mavlink.ground_station.profiles import UploadPlan
from mimopilot.sitl.mavlink.ground_station.session import LinkOptions
from mimopilot.sitl.mavlink.ground_station.transaction import STORAGE, Upload, upload_and_verify
from mimopilot.sitl.mavlink.ground_station.upload import SMALLEST_CHANGE
from mimopilot.sitl.mavlink.wire.float32 import shortest
from mimopilot.tuning.gains import Gains, Triple


def parse_scale(text: str | None) -> Triple | Literal["flown"] | None:
    """Parse ``--moment-scale``: three positive numbers (N m), or ``flown``.

    Raises
    ------
    SitlError
        If it is neither.
    """
    if text is None or text == "flown":
        return text  # type: ignore[return-value]
    try:
        r, p, y = (float(part) for part in text.split(","))
    except ValueError:
        r = p = y = 0.0
    if not all(0 < value < float("inf") for value in (r, p, y)):
        raise SitlError(f"--moment-scale: got {text!r}, expected ROLL,PITCH,YAW in N m, or flown")
    return r, p, y


class TerminalDialogue:
    """Tables and a question on the terminal."""

    def show_plan(self, plan: UploadPlan, held: Mapping[str, float], vehicle: Heartbeat) -> None:
        """Print old and new values."""
        _show_plan(plan, held, vehicle)

    def confirm(self, changes: int, system: int) -> None:
        """Ask; ends the command where the answer is no."""
        typer.confirm(f"Write {changes} parameters to vehicle {system}?", abort=True)

    def saved(self, path: Path) -> None:
        """Print where the old values are."""
        print_text(f"old values saved: {path}")


def upload_with_dialogue(
    plan: UploadPlan, options: LinkOptions, gains: Gains | None = None, scale: Triple | Literal["flown"] | None = None
) -> None:
    """An upload, or with ``--dry-run`` a comparison, as the command line shows it; see `upload_and_verify`.

    Raises
    ------
    SitlError
        Unless every value was read back and stored, or it was a dry run.
    """
    if not (options.yes or options.dry_run) and (options.as_json or not sys.stdin.isatty()):
        raise SitlError("no terminal to ask for confirmation: give --yes to write, or --dry-run to compare")
    done = upload_and_verify(plan, options, gains, scale, None if options.as_json else TerminalDialogue())
    if options.as_json:
        _print_json(done)
    elif done.outcome.state == "verified":
        rows = [[s.name, s.unit, shortest(done.outcome.held[s.name][0])] for s in done.plan.settings]
        print_table("read back from the vehicle", ["parameter", "unit", "value"], rows)
        written = sum(s.value != done.held[s.name] for s in done.plan.settings)
        print_text(f"{len(rows)} parameters verified, {written} of them written; {STORAGE[done.outcome.storage]}")
    done.check()


def _show_plan(plan: UploadPlan, held: Mapping[str, float], vehicle: Heartbeat) -> None:
    rows = []
    for setting in plan.settings:
        change = setting.value - held[setting.name]
        rows.append(
            [
                setting.name,
                setting.unit,
                shortest(held[setting.name]),
                shortest(setting.value),
                f"{change:+.6g}" if change else "",
            ]
        )
    title = f"vehicle {vehicle.system}, component {vehicle.component}, {'armed' if vehicle.armed else 'disarmed'}"
    print_table(title, ["parameter", "unit", "on the vehicle", "new", "change"], rows)
    for name in (s.name for s in plan.settings if 0 < abs(s.value - held[s.name]) < SMALLEST_CHANGE):
        print_text(f"note: {name}: PX4 and ArduPilot do not save a change below {SMALLEST_CHANGE:g}")
    for note in plan.notes:
        print_text(f"note: {note}")


def _print_json(done: Upload) -> None:
    outcome = done.outcome
    print_json(
        {
            "vehicle": done.vehicle._asdict(),
            "state": outcome.state,
            "reason": outcome.reason,
            "storage": outcome.storage,
            "armed": outcome.armed,
            "snapshot": str(done.snapshot) if done.snapshot else None,
            "parameters": {
                s.name: {"unit": s.unit, "before": done.held[s.name], "new": s.value, "held": outcome.held[s.name]}
                for s in done.plan.settings
            },
            "notes": done.plan.notes,
        }
    )
