"""PX4 ULog files, genuine or written by our bench: signals by the names that each PX4 release gave them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tuning.errors import TuningError
from tuning.experiment import Experiment
from tuning.files import sha256
from tuning.flown import flown_gains
from tuning.logs.resample import Series, on_common_grid

#: Signal -> the (topic, fields) that hold it, newest PX4 first.
LAYOUTS = {
    "u": (("vehicle_torque_setpoint", ("xyz[0]", "xyz[1]")), ("actuator_controls_0", ("control[0]", "control[1]"))),
    "y_i": (("vehicle_angular_velocity", ("xyz[0]", "xyz[1]")), ("vehicle_attitude", ("rollspeed", "pitchspeed"))),
    "y_o": (("vehicle_attitude", ("q[0]", "q[1]", "q[2]", "q[3]")),),
    "r_o": (
        ("vehicle_attitude_setpoint", ("q_d[0]", "q_d[1]", "q_d[2]", "q_d[3]")),
        ("vehicle_attitude_setpoint", ("roll_body", "pitch_body")),
    ),
    "r_i": (("vehicle_rates_setpoint", ("roll", "pitch")),),
}
REQUIRED = ("u", "y_i", "y_o")
HELD = ("u", "r_o", "r_i", "u_bar")
EXCITATION_TOPIC, EXCITATION_NAME = "debug_vect", "MIMO_EXC"


@dataclass(frozen=True, eq=False)
class _Log:
    path: Path
    ulog: Any

    def topics(self) -> dict[str, list[str]]:
        return {d.name: sorted(d.data) for d in self.ulog.data_list if d.multi_id == 0}

    def series(self, topic: str, fields: tuple[str, ...]) -> Series | None:
        for dataset in self.ulog.data_list:
            if dataset.name == topic and dataset.multi_id == 0 and all(field in dataset.data for field in fields):
                stamps = dataset.data.get("timestamp_sample", dataset.data["timestamp"])
                if not np.any(stamps):
                    stamps = dataset.data["timestamp"]
                values = np.column_stack([dataset.data[field] for field in fields]).astype(np.float64)
                return Series(stamps.astype(np.float64) * 1e-6, values, topic)
        return None


def read_ulog(path: Path) -> Experiment:
    """Read an experiment from a ULog file.

    Torque and rates are paired by ``timestamp_sample``. Where our excitation topic is logged, only the
    part of the flight between its first and last injected sample is used.

    Parameters
    ----------
    path : Path
        The log.

    Returns
    -------
    Experiment

    Raises
    ------
    TuningError
        When the file is not a ULog, lacks a topic (naming it and the log's own), or is too slow or too short.
    """
    log = _Log(path, _open(path))
    series: dict[str, Series] = {}
    for signal, layouts in LAYOUTS.items():
        found = next((s for s in (log.series(topic, fields) for topic, fields in layouts) if s is not None), None)
        if found is not None:
            series[signal] = found
    missing = [signal for signal in REQUIRED if signal not in series]
    if missing:
        wanted = "; ".join(" or ".join(f"{t} ({', '.join(f)})" for t, f in LAYOUTS[signal]) for signal in missing)
        raise TuningError(
            f"{path}: lacks {wanted}; set SDLOG_PROFILE to 17 and fly again. "
            f"Topics in this log: {', '.join(sorted(log.topics())) or 'none'}"
        )
    series["y_o"] = _angles(series["y_o"])
    if "r_o" in series:
        series["r_o"] = _angles(series["r_o"])
    excitation = _excitation(log)
    if excitation is not None:
        series["u_bar"], begin, end = excitation
    else:
        begin, end = -np.inf, np.inf
    grid = on_common_grid(series, HELD, begin, end, str(path), primary="u")
    parameters = {**log.ulog.initial_parameters}
    return Experiment(
        Ts=grid.Ts,
        segments=grid.segments,
        source=path.name,
        sha256=sha256(path.read_bytes()),
        flown=flown_gains(parameters, grid.Ts),
        **grid.signals,
    )


def _open(path: Path) -> Any:
    from pyulog import ULog

    if not path.is_file():
        raise TuningError(f"{path}: no such file; give the path of a ULog (.ulg)")
    try:
        with path.open("rb") as stream:
            if stream.read(4) != b"ULog":
                raise TuningError(f"{path}: not a ULog file: it does not start with 'ULog'")
        return ULog(str(path))
    except TuningError:
        raise
    except Exception as error:  # pyulog raises whatever a damaged file makes of its parser
        raise TuningError(f"{path}: damaged ULog file: {error or type(error).__name__}; download it again") from error


def _angles(series: Series) -> Series:
    """Roll and pitch (rad) from quaternions w, x, y, z; passed on where they are angles already."""
    if series.values.shape[1] == 2:
        return series
    w, x, y, z = series.values.T
    roll = np.arctan2(2 * (w * x + y * z), 1 - 2 * (x**2 + y**2))
    pitch = np.arcsin(np.clip(2 * (w * y - z * x), -1, 1))
    return Series(series.time, np.column_stack([roll, pitch]), series.topic)


def _excitation(log: _Log) -> tuple[Series, float, float] | None:
    """The injected moment, and the time (s) of its first and last sample that is not zero."""
    series = log.series(EXCITATION_TOPIC, ("x", "y", *(f"name[{i}]" for i in range(len(EXCITATION_NAME)))))
    if series is None:
        return None
    ours = (series.values[:, 2:] == np.frombuffer(EXCITATION_NAME.encode(), np.uint8)).all(axis=1)
    series = Series(series.time[ours], series.values[ours, :2], series.topic)
    active: NDArray[np.intp] = np.flatnonzero(series.values.any(axis=1))
    if not len(active):
        return None
    return series, float(series.time[active[0]]), float(series.time[active[-1]])
