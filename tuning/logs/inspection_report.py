"""Output of `mimopilot inspect`: tables for people, plain values for ``--json``."""

from __future__ import annotations

import math
from dataclasses import asdict
from typing import Any

from mimopilot.common.console import print_table, print_text
from mimopilot.tuning.experiment import EXTERNAL
from mimopilot.tuning.logs.inspection import Inspection, SignalReport

#: Signal -> its name, its unit in the table, and the factor from SI to that unit.
_NAMES = {
    "u": ("torque u", "", 1.0),
    "y_i": ("rates y_i", "deg/s", 180 / math.pi),
    "y_o": ("angles y_o", "deg", 180 / math.pi),
    "u_bar": ("injected u_bar", "", 1.0),
    "r_bar": ("injected rate r_bar", "deg/s", 180 / math.pi),
    "r_o": ("attitude setpoint r_o", "deg", 180 / math.pi),
    "r_i": ("rate setpoint r_i", "deg/s", 180 / math.pi),
}


def as_mapping(found: Inspection) -> dict[str, Any]:
    """An inspection as plain values in SI units, for `mimopilot.common.console.print_json`."""
    recording, experiment = found.recording, found.experiment
    return {
        "log": str(recording.path),
        "format": recording.format,
        "seconds": found.seconds,
        "signals": {name: asdict(report) for name, report in found.signals.items()},
        "contents": list(recording.contents),
        "airborne_s": None if found.airborne is None else [list(part) for part in found.airborne],
        "usable_s": [list(part) for part in found.parts],
        "experiment": None
        if experiment is None
        else {"Ts": experiment.Ts, "seconds": experiment.seconds, "segments": [list(s) for s in experiment.segments]},
        "excitation": {name: asdict(report) for name, report in found.excitation.items()},
        "excited": found.external,
        "yaw": {
            "signals": {name: asdict(report) for name, report in found.yaw.items()},
            "segments": [list(s) for s in experiment.yaw.segments] if experiment and experiment.yaw else [],
        },
        "flown": None if found.flown is None else {name: m.tolist() for name, m in found.flown.matrices.items()},
        "warnings": list(found.warnings),
        "notes": list(recording.notes),
        "tunable": found.reason is None,
        "reason": found.reason,
    }


def _spans(report: SignalReport, unit: str, factor: float) -> list[str]:
    """Range of each axis of a signal."""
    ends = zip(report.minimum, report.maximum, strict=True)
    return [f"{factor * low:.3g} .. {factor * high:.3g} {unit}".rstrip() for low, high in ends]


def print_inspection(found: Inspection) -> None:
    """Print an inspection as tables on standard output."""
    recording, experiment = found.recording, found.experiment
    rows = []
    for name, (title, unit, factor) in _NAMES.items():
        report = found.signals.get(name)
        if report is None:
            rows.append([title, "not logged", *[""] * 6])
            continue
        held = f" (held for {report.held})" if report.held > 1 else ""
        spans = [*_spans(report, unit, factor), *(_spans(found.yaw[name], unit, factor) if name in found.yaw else [""])]
        gaps = f"{report.gaps} ({report.longest_gap_s * 1e3:.0f} ms)"
        saturated = "" if report.saturated is None else " / ".join(f"{100 * share:.1f} %" for share in report.saturated)
        rows.append([title, report.source, f"{report.rate_hz:.1f} Hz{held}", gaps, *spans, saturated])
    columns = ["signal", "from", "rate", "gaps (longest)", "roll", "pitch", "yaw", "saturated"]
    print_table(f"{recording.path.name}: {recording.format}, {found.seconds:.1f} s", columns, rows)
    if found.airborne is not None:
        print_text(f"airborne: {sum(b - a for a, b in found.airborne):.1f} s by {recording.evidence}")
    if found.parts:
        print_text("used for roll and pitch: " + ", ".join(f"{begin:.1f} to {end:.1f} s" for begin, end in found.parts))
    if experiment is not None:
        count = len(experiment.segments)
        print_text(
            f"experiment: {experiment.seconds:.1f} s at {1 / experiment.Ts:.1f} Hz, {count} segments without a gap"
        )
        if experiment.yaw is not None:
            parts = experiment.yaw.segments
            print_text(f"yaw: {sum(b - a for a, b in parts) * experiment.Ts:.1f} s, {len(parts)} segments")
    if found.external:
        axes = {name: [axis for axis, of_axis in found.external.items() if of_axis == name] for name in EXTERNAL}
        print_text("excited: " + "; ".join(f"{', '.join(on)} by {EXTERNAL[name]}" for name, on in axes.items() if on))
    for name, excitation in found.excitation.items():
        low, high = excitation.band_hz
        print_text(f"excitation {name}: {excitation.rms:.4f} RMS, 90 % of its power from {low:.2f} to {high:.2f} Hz")
    if found.flown is not None:
        diagonals = [f"{name} {m[0, 0]:.4g} / {m[1, 1]:.4g}" for name, m in found.flown.matrices.items()]
        print_text(f"flown (roll / pitch): {', '.join(diagonals)}")
    for note in recording.notes:
        print_text(f"note: {note}")
    print_text(
        "gains can be tuned from it" if found.reason is None else f"gains cannot be tuned from it: {found.reason}"
    )
