"""What a user of `upload` and `restore` sees: tables before and after, the question, how it ended."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Literal

import typer
from mimopilot.sitl.errors import SitlError
from mimopilot.sitl.mavlink.ground_station.events import Heartbeat
from mimopilot.sitl.mavlink.ground_station.parameter_protocol import AUTOSAVE_S
from mimopilot.sitl.mavlink.ground_station.profiles import Plan, out_of_range
from mimopilot.sitl.mavlink.ground_station.session import Options, Session, session
from mimopilot.sitl.mavlink.ground_station.upload import SMALLEST_CHANGE, Outcome, apply
from mimopilot.sitl.mavlink.wire.float32 import shortest
from mimopilot.sitl.mavlink.wire.parameter_files import parameter_text, read_parameters
from mimopilot.sitl.physics.moment_scale import check_moment_scale
from mimopilot.tuning.gains import Gains, Triple

from mimopilot.common.console import print_json, print_table
from mimopilot.common.files import write_atomically

STORAGE = {
    "acknowledged": "stored: the vehicle acknowledged it (PREFLIGHT_STORAGE)",
    "autosave": f"storage was not acknowledged: waited {AUTOSAVE_S:g} s, in which PX4 and ArduPilot save by themselves",
    "denied": "not stored: the vehicle refused it (PREFLIGHT_STORAGE: MAV_RESULT_DENIED)",
    "failed": "not stored: the vehicle could not (PREFLIGHT_STORAGE: MAV_RESULT_FAILED)",
    "": "the link was lost before storage was acknowledged",
}
#: Ends of storage that leave the vehicle with values that it loses.
UNSTORED = ("denied", "failed")


def parse_scale(text: str | None) -> Triple | Literal["flown"] | None:
    """``--moment-scale``: three numbers above zero, or ``flown``.

    Raises
    ------
    SitlError
        When it is neither.
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


def transact(
    plan: Plan, options: Options, gains: Gains | None = None, scale: Triple | Literal["flown"] | None = None
) -> None:
    """Read, check, show, ask, save the old values, write and verify; report how it ended.

    Parameters
    ----------
    plan : Plan
        What to write.
    options : Options
        How.
    gains : Gains, optional
        What the plan was made from: then the unit of moment must be the vehicle's.
    scale : tuple of 3 float (N m), or ``flown``, optional
        The vehicle's unit of moment, or the word that the gains were tuned in it; by default the vehicle is asked.

    Raises
    ------
    SitlError
        Unless every value was read back, or it was a dry run.
    """
    if not (options.yes or options.dry_run) and (options.as_json or not sys.stdin.isatty()):
        raise SitlError("there is nobody to ask: give --yes to write, or --dry-run to compare")
    if options.snapshot is not None and options.snapshot.exists():
        raise SitlError(f"{options.snapshot}: exists already, and may be the only copy of older values; name another")
    if gains is not None and isinstance(scale, tuple):
        check_moment_scale(gains, scale, "the vehicle")
    ask_scale = gains is not None and scale is None
    if ask_scale and not plan.scale:
        raise SitlError(
            "a stock vehicle does not say how many N m one unit of its moment stands for; give --moment-scale "
            "ROLL,PITCH,YAW, or --moment-scale flown when the gains come from a log of this very vehicle"
        )
    with session(options) as vehicle:
        held = vehicle.read([*plan.values, *plan.fixed, *(plan.scale if ask_scale else ())], plan.profile)
        _check_vehicle(plan, held, vehicle, options)
        if ask_scale and gains is not None:
            check_moment_scale(gains, [held[name] for name in plan.scale], "the vehicle")
        if not options.as_json:
            _show_plan(plan, held, vehicle.vehicle)
        changes = [name for name, value in plan.values.items() if value != held[name]]
        snapshot = None
        if options.dry_run:
            outcome = Outcome("dry run", "", {name: (held[name],) for name in plan.values})
        else:
            if changes and not options.yes:
                typer.confirm(f"Write {len(changes)} parameters to vehicle {vehicle.vehicle.system}?", abort=True)
                vehicle.link.discard()
                vehicle.talk.resume(vehicle.link.now())
                if vehicle.read(list(held), plan.profile) != held:
                    raise SitlError("the vehicle's values changed while the question stood: run it again", exit_code=1)
            snapshot = _save_snapshot(plan, held, vehicle.vehicle, options) if changes else None
            outcome = vehicle.run(apply(vehicle.talk, plan.values, held))
        _report(plan, held, vehicle.vehicle, outcome, snapshot, options)


def _check_vehicle(plan: Plan, held: Mapping[str, float], vehicle: Session, options: Options) -> None:
    for name, value in plan.fixed.items():
        if held[name] != value:
            raise SitlError(
                f"{name}: the vehicle has {held[name]:.6g}, the gains are for {value:.6g}; generate its firmware "
                "again, or tune for what it has"
            )
    for name in plan.values:
        if not abs(held[name]) < float("inf"):
            raise SitlError(
                f"{name}: the vehicle holds {held[name]}, which could not be put back; set it by hand first"
            )
        expected = out_of_range(name, held[name])
        if expected:
            raise SitlError(
                f"{name}: the vehicle holds {held[name]:.6g}, expected {expected}: restore would not put it back; set "
                "it by hand first"
            )
    if vehicle.vehicle.armed and not (options.force_armed or options.dry_run):
        raise SitlError("the vehicle is armed: nothing was written; disarm it, or give --force-armed", exit_code=1)


def _save_snapshot(plan: Plan, held: Mapping[str, float], vehicle: Heartbeat, options: Options) -> Path:
    """Write the old values to a file of their own: an older snapshot may be the only copy of what is wanted back."""
    path, number = options.snapshot, 0
    while path is None or path.exists():
        number += 1
        path = options.stem.with_name(f"{options.stem.name}.before-{number}.params")
    old = {name: held[name] for name in plan.values}
    write_atomically(path, parameter_text("qgc", old, vehicle.system, vehicle.component))
    if read_parameters(path) != old:
        raise SitlError(f"{path}: does not read back as it was written; nothing was sent to the vehicle", exit_code=1)
    if not options.as_json:
        print(f"old values saved: {path}")
    return path


def _show_plan(plan: Plan, held: Mapping[str, float], vehicle: Heartbeat) -> None:
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
    for code, share in plan.dropped.items():
        print(f"dropped: {code}, {share:.1%} of its diagonal")
    if plan.dropped:
        print("dropped: the certificate, if any, is of the full matrices")
    for name in (s.name for s in plan.settings if 0 < abs(s.value - held[s.name]) < SMALLEST_CHANGE):
        print(f"note: {name}: PX4 and ArduPilot do not save a change below {SMALLEST_CHANGE:g}")
    for note in plan.notes:
        print(f"note: {note}")


def _report(
    plan: Plan,
    held: Mapping[str, float],
    vehicle: Heartbeat,
    outcome: Outcome,
    snapshot: Path | None,
    options: Options,
) -> None:
    """Print how it ended, and raise unless all is well."""
    if options.as_json:
        print_json(
            {
                "vehicle": vehicle._asdict(),
                "state": outcome.state,
                "reason": outcome.reason,
                "storage": outcome.storage,
                "armed": outcome.armed,
                "snapshot": str(snapshot) if snapshot else None,
                "parameters": {
                    s.name: {
                        "unit": s.unit,
                        "before": held[s.name],
                        "new": s.value,
                        "held": outcome.held[s.name],
                    }
                    for s in plan.settings
                },
                "dropped": plan.dropped,
                "notes": plan.notes,
            }
        )
    if outcome.state == "verified":
        if not options.as_json:
            rows = [[s.name, s.unit, shortest(outcome.held[s.name][0])] for s in plan.settings]
            print_table("read back from the vehicle", ["parameter", "unit", "value"], rows)
            written = sum(s.value != held[s.name] for s in plan.settings)
            print(f"{len(rows)} parameters verified, {written} of them written; {STORAGE[outcome.storage]}")
        if outcome.storage in UNSTORED:
            raise SitlError(
                f"all values were read back, but {STORAGE[outcome.storage]}: it loses them when it restarts",
                exit_code=1,
            )
    elif outcome.state != "dry run":
        raise SitlError(_failure(outcome, held, snapshot, options), exit_code=1)


def _failure(outcome: Outcome, held: Mapping[str, float], snapshot: Path | None, options: Options) -> str:
    if outcome.state == "untouched":
        return f"{outcome.reason}; nothing was written"
    armed = ", although the vehicle was armed" if outcome.armed else ""
    stored = f"; {STORAGE[outcome.storage]}" if outcome.storage in UNSTORED else ""
    if outcome.state == "rolled back":
        return f"{outcome.reason}; the old values were put back and read back{armed}{stored}"
    left = [
        f"{name} holds {' or '.join(shortest(value) for value in values)}"
        for name, values in outcome.held.items()
        if values != (held[name],)
    ]
    rest = "the others hold their old values" if left else "the old values were put back, but not all were read back"
    sent = f"old values were sent{armed}" if armed else ""
    again = f"restore with: mimopilot restore {snapshot} --connect {options.connect}"
    return "; ".join(part for part in [outcome.reason, *left, rest, sent, again] if part) + stored
