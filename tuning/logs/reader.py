"""Reading a flight log of any known format into an `Experiment`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from importlib import import_module
from pathlib import Path

import numpy as np

from mimopilot.common.files import check_file, sha256
from mimopilot.tuning.errors import TuningError
from mimopilot.tuning.experiment import Experiment, manoeuvre_size
from mimopilot.tuning.logs.columns import Columns
from mimopilot.tuning.logs.flight_phase import flying_parts
from mimopilot.tuning.logs.flown_gains import flown_gains
from mimopilot.tuning.logs.formats import FORMATS, known_formats, log_format
from mimopilot.tuning.logs.log_checks import check_angles, check_log
from mimopilot.tuning.logs.recording import INCOMPLETE, Recording
from mimopilot.tuning.logs.resample import Interval, on_common_grid
from mimopilot.tuning.logs.yaw import yaw_intervals, yaw_signals
from mimopilot.tuning.motors import Motors, fit_motors, saturation_warnings

CHANGED = "parameters changed in the part that is used; the values before the change count as flown: "


def read_log(path: Path, columns: Columns | None = None) -> Experiment:
    """Read the experiment in a flight log.

    Parameters
    ----------
    path : Path
        A log of one of `tuning.logs.formats.FORMATS`; its content decides, not its name.
    columns : Columns, optional
        Names and units in a CSV or MATLAB file; by default those of `tuning.logs.columns`.

    Returns
    -------
    Experiment
        The part of the log with injected excitation, else the part in flight.

    Raises
    ------
    TuningError
        When the format is not known, or the log is damaged, lacks a signal, holds no flight, or is too slow or too
        short.
    """
    return experiment_of(open_log(path, columns))


def open_log(path: Path, columns: Columns | None = None) -> Recording:
    """Read the signals of a log as logged, each with its own time stamps; see `read_log`.

    Raises
    ------
    TuningError
        When the format is not known or the file is damaged.
    """
    check_file(path, f"the path of a flight log: {known_formats()}", TuningError)
    if path.suffix == ".toml":
        raise TuningError(f"{path}: a TOML file (gains, airframe, specification), expected {known_formats()}")
    found, head = log_format(path)
    if found is None:
        content = f"it begins with {head[:8]!r}" if head else "it is empty"
        raise TuningError(f"{path}: not a flight log: {content}; known formats: {known_formats()}")
    module, _, function = found.reader.partition(":")
    read = getattr(import_module(module), function)
    if found.takes_columns:
        recording: Recording = read(path, columns or Columns())
        return recording
    if columns is not None:
        tables = " and ".join(row.name for row in FORMATS if row.takes_columns)
        raise TuningError(f"{path}: --columns is for {tables} files; this log names its signals itself, leave it out")
    recording = read(path)
    return recording


def experiment_of(recording: Recording) -> Experiment:
    """The experiment in a log; see `read_log`.

    Raises
    ------
    TuningError
        When the log lacks a signal, holds no flight, or is too slow or too short.
    """
    experiment = unchecked_experiment(recording)
    try:
        check_log(experiment, recording)
    except TuningError as error:
        raise _with_warnings(error, experiment.warnings) from error
    return experiment


def unchecked_experiment(recording: Recording) -> Experiment:
    """The experiment in a log, without checking the signals against each other; see `experiment_of`."""
    warnings = [*recording.warnings]
    try:
        return _experiment(recording, warnings)
    except TuningError as error:
        raise _with_warnings(error, warnings) from error


def _with_warnings(error: TuningError, warnings: Sequence[str]) -> TuningError:
    """The error with the log's warnings; an incomplete file is the cause, so it comes first."""
    cut = next((warning for warning in warnings if INCOMPLETE in warning), "")
    if cut:
        where, _, reason = str(error).partition(": ")
        return TuningError(f"{where}: {cut}; fetch it again. In what is left: {reason}")
    return TuningError(f"{error} (warnings about the log: {'; '.join(warnings)})") if warnings else error


def _experiment(recording: Recording, warnings: list[str]) -> Experiment:
    """The experiment; appends to `warnings` what is wrong with a log that can still be used."""
    recording.require_signals()
    check_angles(recording)
    parts, cut = flying_parts(recording)
    warnings += cut
    for_yaw, left_out = yaw_intervals(recording, parts)
    warnings += left_out
    grid = on_common_grid(
        recording.signals,
        parts,
        str(recording.path),
        recording.advice,
        recording.yaw if for_yaw else {},
        for_yaw,
    )
    begin = max(parts[0][0], float(recording.signals["u"].time[0]))
    parameters, changed = recording.parameters_during(begin, parts[-1][1])
    warnings += [CHANGED + "; ".join(changed)] if changed else []
    motors = _motors(recording, parts, warnings)
    experiment = Experiment(
        Ts=grid.Ts,
        segments=grid.segments,
        source=recording.path.name,
        sha256=sha256(b"".join(path.read_bytes() for path in (recording.path, *recording.beside))),
        flown=flown_gains(parameters, grid.Ts),
        motors=motors,
        amplitude=_amplitude(recording, for_yaw),
        warnings=tuple(warnings),
        **grid.signals,  # type: ignore[arg-type]  # of the names in Experiment
    )
    yaw, left_out = yaw_signals(grid, experiment, recording)
    return replace(experiment, yaw=yaw, warnings=(*experiment.warnings, *left_out))


def _amplitude(recording: Recording, for_yaw: tuple[Interval, ...]) -> float:
    """Size (rad) of the manoeuvres in the air: of the angles and of their setpoints, but for rare outliers."""
    sizes = []
    for name in ("y_o", "r_o"):
        series = recording.signals.get(name)
        if series is None:
            continue
        flying = np.isfinite(series.values).all(axis=1)
        if "u_bar" in recording.yaw or "r_bar" in recording.yaw:
            # Yaw's excitation is no manoeuvre of these axes.
            quiet = np.any([(a <= series.time) & (series.time <= b) for a, b in for_yaw], axis=0)
            flying &= ~quiet if for_yaw and (flying & ~quiet).any() else True
        if recording.airborne:
            flying &= np.any([(a <= series.time) & (series.time <= b) for a, b in recording.airborne], axis=0)
        if flying.any():
            sizes.append(manoeuvre_size(series.values[flying]))
    return max(sizes, default=0.0)


def _motors(recording: Recording, parts: tuple[Interval, ...], warnings: list[str]) -> Motors | None:
    """The allocation from torque to motor commands in the usable parts; None when the log holds no commands.

    Appends warnings about saturated motors to `warnings`.
    """
    commands, torque = recording.commands, recording.signals["u"]
    if commands is None:
        return None
    made = np.searchsorted(torque.time, commands.time + 1e-6, side="right") - 1
    used = (made >= 0) & np.any([(a <= commands.time) & (commands.time <= b) for a, b in parts], axis=0)
    u, given = torque.values[made[used]], commands.values[used]
    motors = fit_motors(u, given)
    injected = recording.signals.get("u_bar")
    warnings += saturation_warnings(u, given, motors, float(np.abs(injected.values).max()) if injected else 0.0)
    return motors
