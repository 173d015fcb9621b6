"""Reader of blackbox logs of Betaflight and INDIflight that were decoded to CSV.

Betaflight's axes are forward, left, up: pitch and yaw have the opposite sign of ours. Torque is the sum of the PID's
terms, as it limits it, divided by the mixer's scale (PID_MIXER_SCALING in pid.h); rates are in deg/s.
INDIflight has no PID: its torque is the difference of the motor commands, and its attitude is forward, right, down.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mimopilot.tuning.errors import TuningError
from mimopilot.tuning.logs.blackbox_excitation import chirp, sticks
from mimopilot.tuning.logs.blackbox_file import ONE_LOG, BlackboxTable, read_blackbox
from mimopilot.tuning.logs.blackbox_settings import differences, parameters
from mimopilot.tuning.logs.columns import TIME_UNITS
from mimopilot.tuning.logs.recording import Recording
from mimopilot.tuning.logs.resample import Series

Signal = NDArray[np.float64]

DEGREE = np.pi / 180
#: Units of the PID's sum for a torque of 1 (PID_MIXER_SCALING), and its limits (PIDSUM_LIMIT, PIDSUM_LIMIT_YAW), pid.h.
MIXER_SCALE, LIMITS = 1000.0, (500.0, 500.0, 400.0)
#: Of a quaternion's parts in the log: 2^15 - 1.
QUATERNION = 32767.0
#: Units in the log for each of rates, setpoints and sticks with blackbox_high_resolution.
HIGH_RESOLUTION = 10.0
#: From forward, left, up to forward, right, down: roll, pitch, yaw.
FLU = np.array([1.0, -1.0, -1.0])
#: Motor order of Betaflight's quadrotor X: rear right, front right, rear left, front left; roll and pitch of each.
QUAD_X = np.array([[-1.0, -1.0], [-1.0, 1.0], [1.0, -1.0], [1.0, 1.0]]) / 4
#: Range of motor[] that means 0 to 1: digital protocols, else pulses in us.
DIGITAL, ANALOG = (48.0, 2047.0), (1000.0, 2000.0)
WANTED = re.compile(
    r"time|timeUs|timeS|axis[PIDFS]\[\d\]|setpoint\[\d\]|gyroADC\[\d\]|gyroSp\[\d\]|rcCommand\[\d\]|motor\[\d\]|"
    r"debug\[\d\]|imuQuaternion\[\d\]|quat\[\d\]|quatSp\[\d\]|heading\[\d\]|u\[\d\]|roll|pitch|heading|flightModeFlags"
)
PLACES = {
    "u": "axisP[0], axisI[0] ... (terms of the PID)",
    "y_i": "gyroADC[0], gyroADC[1]",
    "y_o": "the attitude: imuQuaternion[0] ..., roll and pitch, or heading[0] ...",
    "r_i": "setpoint[0], setpoint[1]",
    "r_bar": "debug[0] ... in debug mode CHIRP",
    "r_o": "quatSp[0] ...",
    "u_bar": "nothing: Betaflight injects no torque",
}
ADVICE = (
    "log it with Betaflight 2025.12 or later (blackbox_disable_attitude = OFF, blackbox_disable_pids = OFF, "
    "blackbox_sample_rate = 1/2), or decode an older log with blackbox_decode --simulate-imu"
)


def record_blackbox(path: Path) -> Recording:
    """Read a blackbox log that was decoded to CSV.

    Parameters
    ----------
    path : Path

    Returns
    -------
    Recording
        The excitation is Betaflight's chirp; without one it is the sticks' rate setpoint in acro mode.

    Raises
    ------
    TuningError
        When it has no table, no time, or no samples.
    """
    log = read_blackbox(path, WANTED)
    indi = "u[0]" in log.columns and "quat[0]" in log.columns
    time = _time(log)
    _check_one_log(path, time)
    Ts = float(np.median(np.diff(time))) if len(time) > 1 else 0.0
    if Ts <= 0:
        raise TuningError(f"{path}: the time does not increase; decode the log again")
    resolution = HIGH_RESOLUTION if log.number("blackbox_high_resolution") else 1.0
    angles, angle_name = _angles(log)
    rates, rate_name = _rates(log, "gyroADC", resolution)
    setpoint, setpoint_name = _rates(log, "gyroSp" if indi else "setpoint", resolution)
    torque, torque_name = _motor_torque(log) if indi else _pid_torque(log)
    values = {"u": (torque, torque_name), "y_i": (rates, rate_name), "y_o": (angles, angle_name)}
    values["r_i"] = (setpoint, setpoint_name)
    values["r_o"] = _from_quaternion(log.vector("quatSp", 4)), "quatSp"
    notes, warnings = list[str](), [*log.warnings]
    if indi:
        values["y_i"], values["r_i"] = _indi_rates(rates, setpoint, angles, Ts)
        notes.append(
            "INDIflight has no PID and no gains of ours; yaw is left out: its motors' directions are not known"
        )
    else:
        warnings += _excited(log, setpoint, Ts, resolution, values)
    values = {name: (signal, topic) for name, (signal, topic) in values.items() if signal is not None}
    found = {} if indi else parameters(log)
    notes += () if indi else differences(log, tuple(found))
    signals = {name: Series(time, v[:, :2], topic) for name, (v, topic) in values.items() if v is not None}
    return Recording(
        path=path,
        format=_format_name(log, indi),
        signals=signals,
        wanted=PLACES,
        contents=list(log.units),
        advice=ADVICE,
        parameters=found,
        warnings=warnings,
        notes=notes,
        commands=_commands(log, time),
        span=(float(time[0]), float(time[-1])),
    )


def _time(log: BlackboxTable) -> Signal:
    """Time stamps, s."""
    for name, unit in (("timeS", "s"), ("timeUs", "us"), ("time", log.units.get("time") or "us")):
        if name in log.columns and unit in TIME_UNITS:
            return log.columns[name] * TIME_UNITS[unit]
    raise TuningError(f"{log.path}: no column 'time' in s, ms or us; decode the log again")


def _check_one_log(path: Path, time: Signal) -> None:
    """Refuse a table in which the time begins again; a few wrong time stamps are not that."""
    few = 10
    for i in np.flatnonzero(np.diff(time) < 0) + 1:
        if min(i, len(time) - i) >= few and np.min(time[i - few : i]) > np.max(time[i : i + few]):
            raise TuningError(
                f"{path}: the time begins again at row {i + 1} below the column names: another log; {ONE_LOG}"
            )


def _rates(log: BlackboxTable, name: str, resolution: float) -> tuple[Signal | None, str]:
    """Rates or rate setpoints (N, 3), rad/s, in our axes."""
    values, unit = log.vector(name), log.units.get(f"{name}[0]", "")
    converted = unit == "rad/s" or ("timeS" in log.columns and name.startswith("gyro"))  # bfl2csv.py writes SI units
    factor = 1.0 if converted else DEGREE
    return (None if values is None else values * FLU * factor / resolution), f"{name}[0], {name}[1]"


def _pid_torque(log: BlackboxTable) -> tuple[Signal | None, str]:
    """Torque (N, 3) of Betaflight, in our axes; D and F may not be logged where their gains are 0."""
    if log.vector("axisP") is None or log.vector("axisI") is None:
        return None, ""
    terms = [letter for letter in "PIDFS" if f"axis{letter}[0]" in log.columns or f"axis{letter}[1]" in log.columns]
    none = np.zeros(len(log.columns["axisP[0]"]))
    total = np.column_stack(
        [sum((log.columns.get(f"axis{letter}[{i}]", none) for letter in terms), none) for i in range(3)]
    )
    limit, of_yaw = log.number("pidsum_limit") or LIMITS[0], log.number("pidsum_limit_yaw") or LIMITS[2]
    limits = np.array([limit, limit, of_yaw])
    return np.clip(total, -limits, limits) * FLU / MIXER_SCALE, f"axis{' + axis'.join(terms)} of roll and pitch"


def _motor_torque(log: BlackboxTable) -> tuple[Signal | None, str]:
    """Torque (N, 2) of INDIflight: the difference of its four motor commands."""
    commands = log.vector("u", 4)
    if commands is None:
        return None, ""
    scale = 1.0 if "timeS" in log.columns else QUATERNION
    return commands / scale @ QUAD_X, "u[0] ... u[3] of a quadrotor X"


def _indi_rates(
    rates: Signal | None, setpoint: Signal | None, angles: Signal | None, Ts: float
) -> tuple[tuple[Signal | None, str], tuple[Signal | None, str]]:
    """Rates and their setpoint of INDIflight in our axes; the signs of its gyro's pitch and yaw changed with versions.

    The setpoint is forward, right, down; the gyro's pitch has the sign of the angle's derivative.
    """
    if setpoint is not None:
        setpoint = setpoint * FLU
    if rates is not None and angles is not None:
        step = max(1, round(0.1 / Ts))
        turned = np.nancumsum(rates[:, 1]) * Ts
        change, turn = angles[step:, 1] - angles[:-step, 1], turned[step:] - turned[:-step]
        if np.nansum(change * turn) < 0:
            rates = rates * FLU
    return (rates, "gyroADC[0], gyroADC[1]"), (setpoint, "gyroSp[0], gyroSp[1]")


def _angles(log: BlackboxTable) -> tuple[Signal | None, str]:
    """Roll and pitch (N, 2), rad, in our axes, and where they are."""
    if "quat[0]" in log.columns:
        return _from_quaternion(log.vector("quat", 4)), "quat"
    vector = log.vector("imuQuaternion")
    if vector is not None:
        part = vector / QUATERNION
        w = np.sqrt(np.clip(1 - np.sum(part**2, axis=1), 0.0, None))
        found = _from_quaternion(np.column_stack([w, part]))
        return (None if found is None else found * FLU[:2]), "imuQuaternion"
    heading = log.vector("heading")
    if heading is not None:  # Blackbox Explorer's own estimate from gyro and accelerometer
        return heading[:, :2] * FLU[:2], "heading[0], heading[1]"
    roll, pitch = log.columns.get("roll"), log.columns.get("pitch")
    if roll is None or pitch is None:
        return None, ""
    return np.column_stack([roll, pitch]) * DEGREE * FLU[:2], "roll, pitch"


def _from_quaternion(q: Signal | None) -> Signal | None:
    """Roll and pitch (N, 2), rad, of quaternions w, x, y, z (N, 4), normalised here."""
    if q is None:
        return None
    with np.errstate(invalid="ignore", divide="ignore"):
        w, x, y, z = (q / np.linalg.norm(q, axis=1, keepdims=True)).T
        roll = np.arctan2(2 * (w * x + y * z), 1 - 2 * (x**2 + y**2))
        return np.column_stack([roll, np.arcsin(np.clip(2 * (w * y - x * z), -1.0, 1.0))])


def _excited(
    log: BlackboxTable,
    setpoint: Signal | None,
    Ts: float,
    resolution: float,
    values: dict[str, tuple[Signal | None, str]],
) -> list[str]:
    """Add what excited the flight to the signals; what to tell about it."""
    if setpoint is None:
        return ["no setpoint[0] to setpoint[2], so no excitation is found (blackbox_disable_setpoint = OFF)"]
    own = setpoint * FLU / DEGREE
    injected = chirp(log, own, Ts)
    if injected is not None and injected[:, :2].any(axis=0).all():
        values["r_bar"] = injected * FLU * DEGREE, "debug (CHIRP)"
        return []
    if injected is not None:
        flown = [name for name, column in zip(("roll", "pitch", "yaw"), injected.T, strict=True) if column.any()]
        return [f"the chirp flew on {' and '.join(flown)} only: fly it on roll and on pitch in one log"]
    if sticks(log, own, resolution):
        values["r_bar"] = setpoint, "setpoint of the sticks (acro mode)"
        return []
    return [
        "no chirp in debug[0] to debug[3] (debug_mode = CHIRP), and no sticks that alone move the rate setpoint (acro)"
    ]


def _commands(log: BlackboxTable, time: Signal) -> Series | None:
    """Motor commands, 0 to 1."""
    count = sum(name.startswith("motor[") for name in log.columns)
    values = log.vector("motor", count) if count else None
    if values is None:
        return None
    low, high = DIGITAL if np.nanmin(values) < ANALOG[0] - 1 else ANALOG
    if "timeS" in log.columns:
        low, high = 0.0, 1.0
    elif len(log.numbers("motorOutput")) == 2:
        low, high = log.numbers("motorOutput")
    return Series(time, np.clip((values - low) / (high - low), 0.0, 1.0), "motor")


def _format_name(log: BlackboxTable, indi: bool) -> str:
    firmware = log.settings.get("Firmware revision") or log.settings.get("firmwareRevision", "")
    return f"blackbox CSV, {firmware or ('INDIflight' if indi else 'Betaflight')}"
