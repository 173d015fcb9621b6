"""Reader of PX4 ULog files: signals by the topic and field names of each PX4 release."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mimopilot.tuning.logs.flight_phase import bridged, intersection, intervals
from mimopilot.tuning.logs.recording import Recording
from mimopilot.tuning.logs.resample import Interval, Series, sampling_period
from mimopilot.tuning.logs.torque_parts import PARTS_TOPIC, torque_parts
from mimopilot.tuning.logs.ulog_file import UlogFile, open_ulog
from mimopilot.tuning.logs.vehicle_type import px4_vehicle
from mimopilot.tuning.parameters import ENABLE
from mimopilot.tuning.px4_names import LOG_PROFILE, TUNING_PROFILE

#: Signal -> (topic, fields) that hold it, newest PX4 first.
LAYOUTS = {
    "u": (("vehicle_torque_setpoint", ("xyz[0]", "xyz[1]")), ("actuator_controls_0", ("control[0]", "control[1]"))),
    "y_i": (("vehicle_angular_velocity", ("xyz[0]", "xyz[1]")), ("vehicle_attitude", ("rollspeed", "pitchspeed"))),
    "y_o": (("vehicle_attitude", ("q[0]", "q[1]", "q[2]", "q[3]")),),
    "r_o": (
        ("vehicle_attitude_setpoint", ("q_d[0]", "q_d[1]", "q_d[2]", "q_d[3]")),
        ("vehicle_attitude_setpoint", ("roll_body", "pitch_body")),
    ),
    "r_i": (("vehicle_rates_setpoint", ("roll", "pitch")),),
    "r_bar": (("autotune_attitude_control_status", ("rate_sp[0]", "rate_sp[1]")),),
}
#: The same of yaw.
YAW_LAYOUTS = {
    "u": (("vehicle_torque_setpoint", ("xyz[2]",)), ("actuator_controls_0", ("control[2]",))),
    "y_i": (("vehicle_angular_velocity", ("xyz[2]",)), ("vehicle_attitude", ("yawspeed",))),
    "y_o": LAYOUTS["y_o"],
    "r_o": (LAYOUTS["r_o"][0], ("vehicle_attitude_setpoint", ("yaw_body",))),
    "r_i": (("vehicle_rates_setpoint", ("yaw",)),),
    "r_bar": (("autotune_attitude_control_status", ("rate_sp[2]",)),),
}
#: Topic and names of the injected torque: x, y are roll and pitch; x is yaw. Our module publishes one of them a cycle.
EXCITATION_TOPIC, EXCITATION_NAME, YAW_EXCITATION_NAME = "debug_vect", "MIMO_EXC", "MIMO_EXY"
#: Cut-off of PX4's low-pass of the yaw torque, Hz.
YAW_CUTOFF = "MC_YAW_TQ_CUTOFF"
#: Upward thrust, newest PX4 first: (topic, field, sign).
THRUSTS = (("vehicle_thrust_setpoint", "xyz[2]", -1.0), ("actuator_controls_0", "control[3]", 1.0))
QUATERNION = 4  # fields of a quaternion
MIN_THRUST = 0.1  # normalised; above it the vehicle counts as flying when no land detector was logged
MOTORS_TOPIC, MOTORS = "actuator_motors", tuple(f"control[{i}]" for i in range(12))
#: (topic, field, value when armed).
ARMED = (("actuator_armed", "armed", 1), ("vehicle_status", "arming_state", 2))


def record_ulog(path: Path) -> Recording:
    """Read a ULog file of PX4 1.8 to 1.17.

    Parameters
    ----------
    path : Path
        The log.

    Returns
    -------
    Recording
        Measurements and torque have the time of their gyro sample, so that one control cycle has one time.
        Setpoints and excitation have the time of the cycle that used them.

    Raises
    ------
    TuningError
        When the file cannot be read at all.
    """
    log = _UlogLog(open_ulog(path))
    signals, yaw = _signals(log, LAYOUTS, slice(0, 2)), _signals(log, YAW_LAYOUTS, slice(2, 3))
    cutoff = (log.file.parameters | {name: value for _, name, value in log.file.changes}).get(YAW_CUTOFF, 0.0)
    if "u" in yaw and cutoff > 0 and log.file.parameters.get(ENABLE.name, 0.0) > 0:
        yaw["u"] = _before_low_pass(yaw["u"], cutoff)
    excitation = _excitation(log)
    if excitation is not None:
        if "u" in signals:
            excitation = _zero_when_silent(excitation, log.published(signals["u"].topic)[0])
        for found, axes in ((signals, slice(0, 2)), (yaw, slice(2, 3))):
            if excitation.values[:, axes].any():
                found["u_bar"] = Series(excitation.time, excitation.values[:, axes], excitation.topic)
    published: dict[str, NDArray[np.float64]] = {}
    for signal in ("r_o", "r_i", "r_bar", "u_bar"):
        for found in (signals, yaw):
            if signal in found and not log.is_sampled(found[signal].topic) and "u" in signals:
                if found is signals:
                    published[signal] = found[signal].time
                found[signal] = _at_cycle(found[signal], log.published(signals["u"].topic))
    file = log.file
    airborne, evidence = _airborne(log)
    now = file.parameters | {name: value for _, name, value in file.changes}
    vehicle = px4_vehicle(log.fields("vehicle_status"), now)
    wanted = {
        signal: " or ".join(f"{topic} ({', '.join(fields)})" for topic, fields in layouts)
        for signal, layouts in LAYOUTS.items()
    }
    return Recording(
        path=path,
        format=_format_name(file.information),
        signals=signals,
        wanted=wanted,
        contents=file.names(),
        advice=_advice(now.get(LOG_PROFILE)),
        airborne=vehicle.airborne(airborne),
        evidence=evidence or "vehicle_status",
        parameters=file.parameters,
        changes=file.changes,
        faults=(f"not a multirotor: {vehicle.fault}; gains are tuned for multirotors only",) if vehicle.fault else (),
        warnings=(*((file.damage,) if file.damage else ()), *vehicle.warnings),
        notes=_notes(log),
        yaw=yaw,
        commands=_commands(log),
        published=published,
        span=_span(file),
    )


@dataclass(frozen=True, eq=False)
class _UlogLog:
    file: UlogFile

    def fields(self, topic: str) -> dict[str, NDArray[Any]]:
        """Field -> values of the first instance of a topic; empty when not logged."""
        found = self.file.fields(topic)
        return found if "timestamp" in found else {}

    def is_sampled(self, topic: str) -> bool:
        """Whether the messages of a topic carry the time of their gyro sample."""
        return bool(np.any(self.fields(topic).get("timestamp_sample", 0)))

    def published(self, topic: str) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Times (s) at which the messages of a topic were published, and times of their gyro samples."""
        data = self.fields(topic)
        stamps = data["timestamp"]
        samples = data.get("timestamp_sample", stamps)
        return stamps * 1e-6, np.where(samples == 0, stamps, samples) * 1e-6

    def series(self, topic: str, names: tuple[str, ...]) -> Series | None:
        data = self.fields(topic)
        if not all(name in data for name in names):
            return None
        with np.errstate(invalid="ignore"):  # a damaged float may be a signalling NaN
            values = np.column_stack([data[name] for name in names]).astype(np.float64)
        return Series(self.published(topic)[1], values, topic)


def _signals(log: _UlogLog, layouts: Mapping[str, Any], axes: slice) -> dict[str, Series]:
    """The first layout of each signal that the log holds; `axes`: which of roll, pitch, yaw."""
    signals = {}
    for signal, places in layouts.items():
        for topic, fields in places:
            series = log.series(topic, fields)
            if series is not None:
                series = _angles(series, axes) if len(fields) == QUATERNION else series
                if np.count_nonzero(np.isfinite(series.values).all(axis=1)) > 1:
                    signals[signal] = series
                    break
    return signals


def _notes(log: _UlogLog) -> tuple[str, ...]:
    """What our module says about its torque, for `mimopilot inspect`."""
    parts = torque_parts(log.fields(PARTS_TOPIC))
    return () if parts is None else (parts.summary(),)


def _advice(profile: float | None) -> str:
    """What to change so that the signals are logged fast enough; names no setting that is right already."""
    if profile is None or int(profile) & TUNING_PROFILE != TUNING_PROFILE:
        now = f" (default, high rate and debug; it is {profile:.0f})" if profile is not None else ""
        return f"set {LOG_PROFILE} to {TUNING_PROFILE}{now} and fly again"
    return (
        f"{LOG_PROFILE} is {profile:.0f}, which logs every loop, but PX4 reads it at startup: restart the vehicle, "
        "use a faster card if the log has gaps, and fly again"
    )


def _angles(series: Series, axes: slice) -> Series:
    """Some of roll, pitch and yaw (rad) from quaternions w, x, y, z."""
    w, x, y, z = series.values.T
    roll = np.arctan2(2 * (w * x + y * z), 1 - 2 * (x**2 + y**2))
    pitch = np.arcsin(np.clip(2 * (w * y - z * x), -1, 1))
    yaw = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y**2 + z**2))
    # PX4 fills an unused setpoint with zeros.
    unit = np.abs(w**2 + x**2 + y**2 + z**2 - 1) < 0.1
    angles = np.column_stack([roll, pitch, yaw])[:, axes]
    return Series(series.time, np.where(unit[:, None], angles, np.nan), series.topic)


def _excitation(log: _UlogLog) -> Series | None:
    """The injected torque on roll, pitch and yaw, (N, 3); None when not logged."""
    series = log.series(EXCITATION_TOPIC, ("x", "y", *(f"name[{i}]" for i in range(len(EXCITATION_NAME)))))
    if series is None:
        return None
    named, yaw = (
        (series.values[:, 2:] == np.frombuffer(name.encode(), np.uint8)).all(axis=1)
        for name in (EXCITATION_NAME, YAW_EXCITATION_NAME)
    )
    x, y = series.values[:, :2].T
    values = np.column_stack([np.where(named, x, 0.0), np.where(named, y, 0.0), np.where(yaw, x, 0.0)])[named | yaw]
    return Series(series.time[named | yaw], values, series.topic) if values.any() else None


def _before_low_pass(torque: Series, cutoff: float) -> Series:
    """The yaw torque that our law commanded: our module publishes it behind the autopilot's low-pass (Hz).

    The low-pass, first order by backward differences as in PX4, belongs to what the law flies: it acts in front of the
    motors, and the excitation is injected before it. Over a lost sample the commanded torque counts as constant.
    """
    time = 2 * np.pi * cutoff * sampling_period(torque.time)
    steps = np.maximum(np.rint(np.diff(torque.time) / sampling_period(torque.time)), 1.0)
    share = 1 - (1 / (1 + time)) ** steps
    commanded = torque.values.copy()
    commanded[1:] = torque.values[:-1] + np.diff(torque.values, axis=0) / share[:, None]
    return Series(torque.time, commanded, torque.topic)


def _zero_when_silent(excitation: Series, cycles: NDArray[np.float64]) -> Series:
    """The excitation in every control cycle (times in s): it is published only while it runs, and zero last."""
    if len(cycles) < 3 or np.any(np.diff(cycles) < 0) or np.any(np.diff(excitation.time) < 0):
        return excitation
    near = sampling_period(cycles) / 2
    last = np.searchsorted(excitation.time, cycles + near, side="right") - 1
    zero = (last < 0) | ~excitation.values[np.maximum(last, 0)].any(axis=1)
    silent = cycles[zero & ((last < 0) | (np.abs(excitation.time[np.maximum(last, 0)] - cycles) > near))]
    time = np.concatenate([excitation.time, silent])
    values = np.concatenate([excitation.values, np.zeros((len(silent), excitation.values.shape[1]))])
    order = np.argsort(time, kind="stable")
    return Series(time[order], values[order], excitation.topic)


def _commands(log: _UlogLog) -> Series | None:
    """Commands of the existing motors, at the time of their gyro sample."""
    fields = log.fields(MOTORS_TOPIC)
    logged = tuple(name for name in MOTORS if name in fields)
    series = log.series(MOTORS_TOPIC, logged) if logged else None
    if series is None:
        return None
    used = np.isfinite(series.values).any(axis=0)
    values = series.values[:, used]
    complete = np.isfinite(values).all(axis=1)
    return Series(series.time[complete], values[complete], series.topic) if values.size and complete.any() else None


def _at_cycle(series: Series, torque: tuple[NDArray[np.float64], NDArray[np.float64]]) -> Series:
    """A signal without gyro time stamps, moved to the gyro sample of the control cycle that used it.

    That is the first cycle whose torque was published after the signal, or up to a quarter of a period before:
    excitation is published together with the torque of its own cycle.
    """
    published, sampled = torque
    if len(published) < 3 or np.any(np.diff(published) < 0):
        return series
    Ts = sampling_period(published)
    cycle = np.searchsorted(published, series.time - Ts / 4)
    near = np.minimum(cycle, len(published) - 1)
    used = (cycle < len(published)) & (np.abs(published[near] - series.time) <= Ts)
    lag = float(np.median(published - sampled))
    return Series(np.where(used, sampled[near], series.time - lag), series.values, series.topic)


def _airborne(log: _UlogLog) -> tuple[tuple[Interval, ...] | None, str]:
    """When the vehicle was armed and not landed, and the topics that say so; None when not logged."""
    states: list[tuple[str, NDArray[np.float64], NDArray[np.bool_]]] = []
    landed = log.fields("vehicle_land_detected")
    if "landed" in landed:
        states.append(("vehicle_land_detected.landed", landed["timestamp"] * 1e-6, landed["landed"] == 0))
    else:
        for topic, field, sign in THRUSTS:
            data = log.fields(topic)
            if np.isfinite(data.get(field, np.nan)).any():  # a controller that does not run publishes NaN
                states.append((f"{topic}.{field}", data["timestamp"] * 1e-6, sign * data[field] > MIN_THRUST))
                break
    for topic, field, value in ARMED:
        data = log.fields(topic)
        if field in data:
            states.append((f"{topic}.{field}", data["timestamp"] * 1e-6, data[field] == value))
            break
    if not states:
        return None, ""
    airborne: tuple[Interval, ...] = ((-np.inf, np.inf),)
    for _, time, flag in states:
        airborne = intersection(airborne, bridged(intervals(time, flag)))
    return airborne, " with ".join(name for name, _, _ in states)


def _span(file: UlogFile) -> Interval | None:
    """First and last time (s) of the topic with the most messages."""
    most = max((t for t in file.topics.values() if not t.instance), key=lambda t: len(t.offsets), default=None)
    stamps = file.fields(most.name).get("timestamp") if most else None
    return (float(stamps[0]) * 1e-6, float(stamps[-1]) * 1e-6) if stamps is not None and len(stamps) else None


def _format_name(information: Mapping[str, str | int]) -> str:
    release = information.get("ver_sw_release")
    numbers = [release >> shift & 255 for shift in (24, 16, 8)] if isinstance(release, int) else []
    version = f" {'.'.join(str(number) for number in numbers)}" if any(numbers) else ""
    return f"ULog, {information.get('sys_name', 'unknown system')}{version}"
