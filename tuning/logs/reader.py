"""The one way from a log of any format to an experiment."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from mimopilot.tuning.errors import TuningError
from mimopilot.tuning.experiment import Experiment
from mimopilot.tuning.logs.columns import Columns
from mimopilot.tuning.logs.flight_phase import flying_parts
from mimopilot.tuning.logs.flown_gains import flown_gains
from mimopilot.tuning.logs.log_checks import check_angles, check_log
from mimopilot.tuning.logs.recording import Recording
from mimopilot.tuning.logs.resample import Interval, on_common_grid
from mimopilot.tuning.motors import Motors, fit_motors, saturation_warnings

from mimopilot.common.files import sha256

ULOG = b"ULog\x01\x12\x35"
DATAFLASH = b"\xa3\x95"
MATLAB = b"MATLAB 5.0 MAT-file"
CHANGED = "parameters were changed during the part that is used, the values before are taken as flown: "
#: Beginnings of logs that are known and not read -> what to do.
REFUSED = {
    b"MATLAB 7.3 MAT-file": "a MATLAB 7.3 (HDF5) file; save it with save(..., '-v7')",
    b"\x89HDF\r\n\x1a\n": "a MATLAB 7.3 (HDF5) file; save it with save(..., '-v7')",
    b"FMT,": "an ArduPilot log as text; give the .bin file that it was made from",
    b"H Product:Blackbox": "a Betaflight log; make a CSV file with blackbox_decode and name its columns with --columns",
}


def read_log(path: Path, columns: Columns | None = None) -> Experiment:
    """Read an experiment from a flight log of any format that is known.

    Parameters
    ----------
    path : Path
        PX4 ULog, ArduPilot dataflash, CSV or MATLAB file; its content decides, not its name.
    columns : Columns, optional
        Names and units in a CSV or MATLAB file; by default those of `tuning.logs.columns`.

    Returns
    -------
    Experiment
        The part of the log with injected excitation, else the part in the air.

    Raises
    ------
    TuningError
        When the file is of no known format, damaged, lacks a signal, never flew, is too slow or too short.
    """
    return experiment_of(open_log(path, columns))


def open_log(path: Path, columns: Columns | None = None) -> Recording:
    """Read the signals of a log as they were logged; see `read_log`.

    Raises
    ------
    TuningError
        When the file is of no known format or damaged.
    """
    if not path.is_file():
        raise TuningError(f"{path}: no such file; give the path of a flight log (.ulg, .bin, .csv or .mat)")
    with path.open("rb") as stream:
        head = stream.read(4096)
    if columns is not None and head.startswith((ULOG, DATAFLASH)):
        raise TuningError(f"{path}: a column file is for CSV and MATLAB files, this log names its signals itself")
    if head.startswith(ULOG):
        from mimopilot.tuning.logs.ulog import record_ulog

        return record_ulog(path)
    if head.startswith(DATAFLASH):
        from mimopilot.tuning.logs.dataflash import record_dataflash

        return record_dataflash(path)
    for beginning, advice in REFUSED.items():
        if head.startswith(beginning):
            raise TuningError(f"{path}: {advice}")
    if head.startswith(MATLAB):
        from mimopilot.tuning.logs.tables import record_matlab

        return record_matlab(path, columns or Columns())
    if b"\0" not in head and any(mark in head.partition(b"\n")[0] for mark in (b",", b";", b"\t")):
        from mimopilot.tuning.logs.tables import record_csv

        return record_csv(path, columns or Columns())
    raise TuningError(
        f"{path}: not a flight log: neither PX4 ULog, ArduPilot dataflash (.bin), MATLAB (version 5 to 7) nor CSV; "
        f"it begins with {head[:8]!r}"
    )


def experiment_of(recording: Recording) -> Experiment:
    """The experiment in a log; see `read_log`.

    Raises
    ------
    TuningError
        When the log lacks a signal, never flew, is too slow or too short.
    """
    experiment = unchecked_experiment(recording)
    try:
        check_log(experiment, recording)
    except TuningError as error:
        raise _with_warnings(error, experiment.warnings) from error
    return experiment


def unchecked_experiment(recording: Recording) -> Experiment:
    """The experiment in a log whose signals may contradict each other; see `experiment_of`."""
    said = [*recording.warnings]
    try:
        return _experiment(recording, said)
    except TuningError as error:
        raise _with_warnings(error, said) from error


def _with_warnings(error: TuningError, said: Sequence[str]) -> TuningError:
    return TuningError(f"{error} (the log: {'; '.join(said)})") if said else error


def _experiment(recording: Recording, said: list[str]) -> Experiment:
    """The experiment; what is wrong with the log although it can be used is added to what is said of it."""
    recording.require_signals()
    check_angles(recording)
    parts, cut = flying_parts(recording)
    said += cut
    grid = on_common_grid(recording.signals, parts, str(recording.path), recording.advice)
    begin = max(parts[0][0], float(recording.signals["u"].time[0]))
    parameters, changed = recording.parameters_during(begin, parts[-1][1])
    said += [CHANGED + "; ".join(changed)] if changed else []
    motors = _motors(recording, parts, said)
    return Experiment(
        Ts=grid.Ts,
        segments=grid.segments,
        source=recording.path.name,
        sha256=sha256(recording.path.read_bytes()),
        flown=flown_gains(parameters, grid.Ts),
        motors=motors,
        warnings=tuple(said),
        **grid.signals,  # type: ignore[arg-type]  # of the names in Experiment
    )


def _motors(recording: Recording, parts: tuple[Interval, ...], said: list[str]) -> Motors | None:
    """How the allocator moved the motors in the usable parts of a log, where it holds their commands."""
    commands, torque = recording.commands, recording.signals["u"]
    if commands is None:
        return None
    made = np.searchsorted(torque.time, commands.time + 1e-6, side="right") - 1
    used = (made >= 0) & np.any([(a <= commands.time) & (commands.time <= b) for a, b in parts], axis=0)
    u, given = torque.values[made[used]], commands.values[used]
    motors = fit_motors(u, given)
    injected = recording.signals.get("u_bar")
    said += saturation_warnings(u, given, motors, float(np.abs(injected.values).max()) if injected else 0.0)
    return motors if recording.linear_thrust else None
