"""What a log holds beside the signals that gains are tuned from: thrust, motor commands, gyro of all axes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mimopilot.tuning.logs.dataflash_file import open_dataflash
from mimopilot.tuning.logs.formats import log_format
from mimopilot.tuning.logs.recording import RANGES, Recording
from mimopilot.tuning.logs.resample import Series, monotone
from mimopilot.tuning.logs.ulog import THRUSTS
from mimopilot.tuning.logs.ulog_file import open_ulog

#: Pulse lengths of stopped and full motors, us: both autopilots' defaults (PWM_MAIN_MIN/MAX, MOT_PWM_MIN/MAX).
PULSES = (1000.0, 2000.0)
#: Largest plausible values: of rates (rad/s) and shares, and of a pulse (us).
LARGEST, LONGEST_PULSE = RANGES["y_i"], 1e4
#: Outputs that may be motors.
OUTPUTS = 8
#: Least share of their range that an output's command must cover in a flight: others are not motors, or not connected.
LEAST_MOVE = 0.02


@dataclass(frozen=True, eq=False)
class FurtherSignals:
    """Signals that only the report needs; None: not logged.

    Attributes
    ----------
    thrust : Series
        Collective thrust command, 0 to 1, (N, 1).
    motors : Series
        Motor commands, 0 to 1, (N, n).
    gyro : Series
        Body rates about roll, pitch and yaw, rad/s, (N, 3).
    """

    thrust: Series | None = None
    motors: Series | None = None
    gyro: Series | None = None


def further_signals(recording: Recording) -> FurtherSignals:
    """Read them from the log that a recording is of."""
    path = recording.path
    found, _ = log_format(path)
    if found is not None and found.name == "PX4 ULog":
        return _of_ulog(path, recording.commands)
    if found is not None and found.name == "ArduPilot dataflash":
        return _of_dataflash(path)
    rates = recording.signals.get("y_i")
    return FurtherSignals(motors=recording.commands, gyro=rates)


def _of_ulog(path: Path, commands: Series | None) -> FurtherSignals:
    file = open_ulog(path)

    def series(topic: str, names: Sequence[str], factor: float = 1.0, largest: float = LARGEST) -> Series | None:
        fields = file.fields(topic)
        if "timestamp" not in fields or not all(name in fields for name in names):
            return None
        stamps = fields["timestamp"].astype(np.float64) * 1e-6
        samples = fields.get("timestamp_sample", np.zeros(1)).astype(np.float64) * 1e-6
        time = np.where(samples > 0, samples, stamps) if len(samples) == len(stamps) else stamps
        return _clean(time, np.column_stack([fields[name] for name in names]) * factor, topic, largest)

    thrust = next((one for topic, field, sign in THRUSTS if (one := series(topic, (field,), sign))), None)
    if commands is None:
        outputs = tuple(f"output[{i}]" for i in range(OUTPUTS))
        commands = _moving(_of_pulses(series("actuator_outputs", outputs, largest=LONGEST_PULSE)))
    gyro = None
    for topic, name in (("vehicle_angular_velocity", "xyz"), ("sensor_combined", "gyro_rad")):
        gyro = gyro or series(topic, tuple(f"{name}[{i}]" for i in range(3)))
    return FurtherSignals(thrust, commands, gyro)


def _of_dataflash(path: Path) -> FurtherSignals:
    file = open_dataflash(path)

    def series(message: str, names: Sequence[str], factor: float = 1.0, largest: float = LARGEST) -> Series | None:
        columns = file.fields(message, ("TimeUS", *names))
        if columns is None or any(column.dtype.kind == "S" for column in columns) or len(columns[0]) < 2:
            return None
        time, *values = (np.asarray(column, np.float64) for column in columns)
        instance = file.fields(message, ("I",))
        first = np.ones(len(time), bool) if instance is None else np.asarray(instance[0]) == 0
        return _clean(time[first] * 1e-6, np.column_stack(values)[first] * factor, message, largest)

    thrust = series("RATE", ("AOut",)) or series("CTUN", ("ThO",))
    motors = _moving(_of_pulses(series("RCOU", tuple(f"C{i + 1}" for i in range(OUTPUTS)), largest=LONGEST_PULSE)))
    gyro = series("RATE", ("R", "P", "Y"), np.pi / 180) or series("IMU", ("GyrX", "GyrY", "GyrZ"))
    return FurtherSignals(thrust, motors, gyro)


def _of_pulses(series: Series | None) -> Series | None:
    if series is None:
        return None
    low, high = PULSES
    return Series(series.time, np.clip((series.values - low) / (high - low), 0.0, 1.0), series.topic)


def _moving(series: Series | None) -> Series | None:
    """The outputs that move; None if there are fewer than the three motors that a multirotor has."""
    if series is None:
        return None
    moving = np.ptp(series.values, axis=0) > LEAST_MOVE
    return Series(series.time, series.values[:, moving], series.topic) if np.count_nonzero(moving) >= 3 else None


def _clean(time: NDArray[np.float64], values: NDArray[np.float64], topic: str, largest: float) -> Series | None:
    """The rows that are finite, in range and in order; None if fewer than two are."""
    good = np.isfinite(values).all(axis=1) & np.isfinite(time) & (np.abs(values).max(axis=1) <= largest)
    if np.count_nonzero(good) < 2:
        return None
    ordered = monotone(Series(time[good], values[good].astype(np.float64), topic))
    return ordered if len(ordered.time) > 1 else None
