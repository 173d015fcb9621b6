"""Reader of ArduPilot dataflash logs (.bin): signals, time in flight, vehicle type and parameters."""

from __future__ import annotations

import itertools
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mimopilot.tuning.errors import TuningError
from mimopilot.tuning.logs.dataflash_custom import CUSTOM_NOTE, IDLE_NOTE, custom_flight, our_parameters
from mimopilot.tuning.logs.dataflash_file import DataflashFile, open_dataflash
from mimopilot.tuning.logs.flight_phase import intervals
from mimopilot.tuning.logs.recording import MAX_OUTLIERS, RANGES, Recording
from mimopilot.tuning.logs.resample import MAX_GAP, MIN_RATE, Interval, Series, monotone, sampling_period
from mimopilot.tuning.logs.vehicle_type import ardupilot_vehicle
from mimopilot.tuning.parameter_row import AXES

DEGREE = np.pi / 180

#: Signal -> (message, fields, factor to SI), best first. Since 4.6 ANG holds fast angles and ATT is slow.
LAYOUTS = {
    "u": (("RATE", ("ROut", "POut"), 1.0),),
    "y_i": (("RATE", ("R", "P"), DEGREE),),
    "y_o": (("ANG", ("Roll", "Pitch"), DEGREE), ("ATT", ("Roll", "Pitch"), DEGREE)),
    "r_o": (("ANG", ("DesRoll", "DesPitch"), DEGREE), ("ATT", ("DesRoll", "DesPitch"), DEGREE)),
    "r_i": (("RATE", ("RDes", "PDes"), DEGREE),),
}
#: The same of yaw.
YAW_LAYOUTS = {
    "u": (("RATE", ("YOut",), 1.0),),
    "y_i": (("RATE", ("Y",), DEGREE),),
    "y_o": (("ANG", ("Yaw",), DEGREE), ("ATT", ("Yaw",), DEGREE)),
    "r_o": (("ANG", ("DesYaw",), DEGREE), ("ATT", ("DesYaw",), DEGREE)),
    "r_i": (("RATE", ("YDes",), DEGREE),),
}
#: Factors for RATE of ArduCopter 3.3 and older (Log_Write_Rate): motor inputs of +-4500, rates in 0.01 deg/s.
OLD_FACTORS = {"u": 1 / 4500, "y_i": 0.01, "r_i": 0.01}
MILLISECOND = 1e-3  # s
#: Field with the time -> its unit, s. ArduCopter 3.3 and older log TimeMS.
CLOCKS = {"TimeUS": 1e-6, "TimeMS": MILLISECOND}

#: Axes of the system identification mode (SIDS.Ax) that add the waveform to the torque, or in deg/s to the rate
#: setpoint: signal -> (factor to SI, axis -> its column: roll, pitch, yaw).
INJECTED_AXES = {"u_bar": (1.0, {10: 0, 11: 1, 12: 2}), "r_bar": (DEGREE, {7: 0, 8: 1, 9: 2})}
#: Those that move the attitude setpoint, and the rest.
SETPOINT_AXES = {1: "roll", 2: "pitch", 3: "yaw", 4: "roll", 5: "pitch", 6: "yaw"}

#: Event numbers of message EV (AP_Logger, LogEvent).
EV_DISARMED, EV_LANDED, EV_NOT_LANDED = 11, 18, 28
#: Name and version of the firmware in message MSG or VER; group 1 is the major version.
_RELEASE = re.compile(r"[A-Za-z:]{2,16}[ -]*[Vv](\d+)\.\d+\S*")
SDLOG2_MESSAGES = {"TIME", "ATT"}  # ArduPilot logs have no message TIME
SDLOG2 = (
    "an old PX4 log (sdlog2, .px4log), not an ArduPilot log: fly with PX4 1.8 or later, which writes ULog, or "
    "convert it to CSV with PX4's sdlog2_dump.py and name its columns with --columns"
)
NOTE = (
    "the flown gains are ArduPilot's: it also filters the rate setpoint (FLTT) and the error of yaw (FLTE), which this "
    "controller does not, and its D acts on the error"
)


def record_dataflash(path: Path) -> Recording:
    """Read an ArduPilot dataflash log.

    Parameters
    ----------
    path : Path
        The log.

    Returns
    -------
    Recording
        The excitation is that of our custom controller, else the waveform of the system identification mode, if added
        to the torque (SID_AXIS 10 and 11, mixer).

    Raises
    ------
    TuningError
        When the file is an sdlog2 log.
    """
    log = _DataflashLog(open_dataflash(path))
    if SDLOG2_MESSAGES.issubset(log.file.names()):
        raise TuningError(f"{path}: {SDLOG2}")
    old = log.in_old_units()
    signals, yaw = _signals(log, LAYOUTS, old), _signals(log, YAW_LAYOUTS, old)
    custom, excitations = custom_flight(log.file), _excitation(log)
    note = NOTE if custom is None else CUSTOM_NOTE
    if custom is not None and excitations and not custom.excitation.any():
        custom, note = None, f"{NOTE}; {IDLE_NOTE}"
    if custom is not None:
        excitations |= custom.injected(signals.get("u"))
        for found, axes in ((signals, slice(0, 2)), (yaw, slice(2, 3))):
            flown = custom.merged(found.get("r_i"), axes)
            found |= {} if flown is None else {"r_i": flown}
    for name, excitation in excitations.items():
        for found, axes in ((signals, slice(0, 2)), (yaw, slice(2, 3))):
            excited = excitation.values[:, axes].any(axis=0)
            # A rate injected on one axis only leaves the attitude setpoints as the signal that excites both.
            if excited.all() or (excited.any() and name == "u_bar"):
                found[name] = Series(excitation.time, excitation.values[:, axes], excitation.topic)
    wanted = {
        signal: " or ".join(_wanted(log, message, fields) for message, fields, _ in layouts)
        for signal, layouts in LAYOUTS.items()
    }
    parameters, changes = _parameters(log) if custom is None else our_parameters(*_parameters(log))
    now = parameters | {name: value for _, name, value in changes}
    texts = [*log.file.texts("MSG", "Message"), *log.file.texts("VER", "FWS")]
    modes = log.timed("MODE", ("ModeNum",))
    vehicle = ardupilot_vehicle(texts, now, (modes[0], modes[1]) if modes else None)
    airborne = _airborne(log)
    damage = log.file.damage
    return Recording(
        path=path,
        format=_format_name(texts, old),
        signals=signals,
        wanted=wanted,
        contents=log.file.names(),
        advice=_advice(log, now, texts),
        airborne=vehicle.airborne(airborne),
        evidence="message EV (18 landed, 28 not landed)" if airborne else "message MODE",
        parameters=parameters,
        changes=changes,
        faults=(f"not a multirotor: {vehicle.fault}; gains are tuned for multirotors only",) if vehicle.fault else (),
        warnings=(*((damage,) if damage else ()), *vehicle.warnings),
        notes=(note, *_identification_notes(log)),
        yaw=yaw,
        span=_span(log),
    )


def _signals(log: _DataflashLog, layouts: Mapping[str, Any], old: bool) -> dict[str, Series]:
    """The first layout of each signal that the log holds."""
    signals = {}
    for signal, places in layouts.items():
        for message, fields, factor in places:
            series = log.series(message, fields, factor * (OLD_FACTORS.get(signal, 1.0) if old else 1.0))
            if series is not None:
                signals[signal] = series
                break
    return signals


@dataclass(frozen=True, eq=False)
class _DataflashLog:
    file: DataflashFile

    def timed(self, message: str, names: Sequence[str]) -> list[NDArray[Any]] | None:
        """Time (s) and fields of a message, one row a message; None when it is not logged with them.

        Events of ArduCopter 3.3 and older have no time: the time of the last RATE or ATT before them is used.
        """
        values = self.file.fields(message, names)
        time = self._clock(message)
        if values is None:
            return None
        if time is not None:
            return [time, *values]
        for other in ("RATE", "ATT"):
            time = self._clock(other)
            if time is not None and len(time):
                before = np.searchsorted(self.file.offsets[other], self.file.offsets[message]) - 1
                return [time[np.maximum(before, 0)], *values]
        return None

    def _clock(self, message: str) -> NDArray[np.float64] | None:
        for clock, unit in CLOCKS.items():
            columns = self.file.fields(message, (clock,))
            if columns is not None:
                return columns[0].astype(np.float64) * unit
        return None

    def series(self, message: str, names: Sequence[str], factor: float) -> Series | None:
        columns = self.timed(message, names)
        if columns is None or any(column.dtype.kind == "S" for column in columns) or len(columns[0]) < 2:
            return None
        with np.errstate(invalid="ignore"):  # a damaged float may be a signalling NaN
            time, *values = (column.astype(np.float64) for column in columns)
        if self.file.fields(message, ("TimeMS",)) is not None:
            time = _unrounded(time)
        return Series(time, np.column_stack(values) * factor, message)

    def in_old_units(self) -> bool:
        """Whether RATE is in the units of `OLD_FACTORS`: a normalised torque never exceeds its range."""
        outputs = self.series("RATE", ("ROut", "POut"), 1.0)
        return outputs is not None and bool(np.mean(np.abs(outputs.values) > RANGES["u"]) > MAX_OUTLIERS)


def _unrounded(time: NDArray[np.float64]) -> NDArray[np.float64]:
    """Time stamps (s) of a uniform loop from stamps rounded to milliseconds: a line fit through each segment."""
    steps = np.diff(time)
    usual = np.median(steps)
    near = np.abs(steps - usual) <= max(usual / 2, MILLISECOND) + 1e-6
    smooth = time.copy()
    if usual <= 0 or not near.any():
        return smooth
    cycles = np.round(steps / np.mean(steps[near]))  # counts neighbours as 1 even if the loop takes 2.5 ms
    bounds = [0, *(np.flatnonzero((cycles < 1) | (cycles > MAX_GAP)) + 1).tolist(), len(time)]
    for a, b in itertools.pairwise(bounds):
        if b - a > 2:
            index = np.append(0, np.cumsum(cycles[a : b - 1]))
            smooth[a:b] = np.polyval(np.polyfit(index, time[a:b], 1), index)
    return smooth


def _wanted(log: _DataflashLog, message: str, fields: Sequence[str]) -> str:
    """Where a signal should be; and the fields that the message has instead."""
    wanted = f"message {message} ({', '.join(fields)})"
    return (
        f"{wanted}, which has {', '.join(log.file.formats[message].letters)}" if message in log.file.names() else wanted
    )


def _advice(log: _DataflashLog, parameters: dict[str, float], texts: Sequence[str]) -> str:
    """What to change so that RATE and the angles are logged in every loop; names no setting that is right already."""
    bits, limit = parameters.get("LOG_BITMASK"), parameters.get("LOG_FILE_RATEMAX", 0)
    release = next((found for text in texts if (found := _RELEASE.match(text))), None)
    if bits is None or not 0 <= bits < 2**31:
        advice = "set bit 0 (fast attitude) of LOG_BITMASK and fly again"
    elif not int(bits) & 1:
        advice = f"set bit 0 (fast attitude) of LOG_BITMASK (it is {int(bits)}, so {int(bits) | 1}) and fly again"
    elif limit > 0:
        advice = f"set LOG_FILE_RATEMAX to 0 (no limit; it is {limit:g} Hz) and fly again"
    elif release and int(release[1]) < 4:
        advice = (
            f"messages RATE and ATT are needed at {MIN_RATE:g} Hz or more and bit 0 of LOG_BITMASK is set already: fly "
            f"with ArduCopter 4.0 or later, which logs them in every loop (this is {release[0]})"
        )
    else:
        advice = (
            f"messages RATE and ANG (ATT before 4.6) are needed at {MIN_RATE:g} Hz or more and bit 0 of LOG_BITMASK is "
            "set already: clear its other bits or use a faster card, so that the logger keeps up, and fly again"
        )
    slow = log.series("PIDR", ("Act",), 1.0)
    if "RATE" not in log.file.names() and slow is not None:
        advice += f"; PIDR, at {1 / np.median(np.diff(slow.time)):.1f} Hz here, does not replace it"
    return advice


def _identification_notes(log: _DataflashLog) -> tuple[str, ...]:
    """What each run of the system identification mode excited, for `mimopilot inspect`."""
    runs = log.timed("SIDS", ("Ax",))
    found = []
    for axis in [] if runs is None else runs[1].astype(np.int64).tolist():
        kinds = {"u_bar": "injected torque", "r_bar": "injected rate setpoint"}
        text = next(
            (f"{kinds[name]} on {AXES[axes[axis]]}" for name, (_, axes) in INJECTED_AXES.items() if axis in axes),
            f"attitude setpoint of {SETPOINT_AXES[axis]}" if axis in SETPOINT_AXES else "not used",
        )
        found.append(f"SID_AXIS {axis}: {text}")
    return (f"system identification: {'; '.join(found)}",) if found else ()


def _excitation(log: _DataflashLog) -> dict[str, Series]:
    """The waveforms that the system identification mode injected, roll, pitch, yaw; zero when that mode was off."""
    waveform = log.series("SIDD", ("Targ",), 1.0)
    runs = log.timed("SIDS", ("Ax",))
    if waveform is None or runs is None or not len(runs[0]):
        return {}
    waveform = monotone(waveform)
    if len(waveform.time) < 3:
        return {}
    Ts = sampling_period(waveform.time)
    ends = np.flatnonzero(np.append(np.diff(waveform.time) > MAX_GAP * Ts, True))
    started, axes = runs[0], runs[1].astype(np.int64)
    # SIDS is stamped just before or after the first sample of its run: the nearest one counts.
    begins = np.concatenate([[0], ends[:-1] + 1])
    run = np.searchsorted(begins, np.arange(len(waveform.time)), side="right") - 1
    axis = np.array([axes[np.argmin(np.abs(started - waveform.time[begin]))] for begin in begins])[run]
    # Zero between the runs, and before and after them: a response needs the time in which the last run fades.
    zeros = waveform.time[ends] + Ts
    torque = log.series(*LAYOUTS["u"][0])
    if torque is not None:
        zeros = np.concatenate([zeros, [min(torque.time[0], waveform.time[0] - Ts), max(torque.time[-1], zeros[-1])]])
    time = np.concatenate([waveform.time, zeros])
    order = np.argsort(time, kind="stable")
    found = {}
    for name, (factor, columns) in INJECTED_AXES.items():
        values = np.zeros((len(time), len(AXES)))
        for code, column in columns.items():
            values[: len(axis)][axis == code, column] = factor * waveform.values[axis == code, 0]
        if values.any():
            found[name] = Series(time[order], values[order], "SIDD")
    return found


def _airborne(log: _DataflashLog) -> tuple[Interval, ...] | None:
    events = log.timed("EV", ("Id",))
    if events is None:
        return None
    time, code = events
    known = np.isin(
        code,
        (  #: Event numbers of message EV (AP_Logger, LogEvent).
            EV_DISARMED,
            EV_LANDED,
            EV_NOT_LANDED,
        ),
    )
    if not np.isin(code, (EV_LANDED, EV_NOT_LANDED)).any():
        return None
    time, flying = time[known], code[known] == EV_NOT_LANDED
    order = np.argsort(time, kind="stable")
    time, flying = time[order], flying[order]
    # Before the first event the state was the opposite.
    return intervals(np.append(time[0] - 1.0, time), np.append(not flying[0], flying))


def _parameters(log: _DataflashLog) -> tuple[dict[str, float], list[tuple[float, str, float]]]:
    """First value of each parameter, and later changes as (time s, name, value)."""
    columns = log.timed("PARM", ("Name", "Value"))
    if columns is None:
        return {}, []
    first: dict[str, float] = {}
    now: dict[str, float] = {}
    changes = []
    for time, label, number in zip(*(column.tolist() for column in columns), strict=True):
        name, value = label.decode("ascii", "replace"), float(number)
        if name not in now:
            first[name] = value
        elif now[name] != value:
            changes.append((float(time), name, value))
        now[name] = value
    return first, changes


def _span(log: _DataflashLog) -> Interval | None:
    """First and last time (s) of the most frequent message."""
    most = max(log.file.offsets, key=lambda name: len(log.file.offsets[name]), default="")
    columns = log.timed(most, ())
    return (float(columns[0].min()), float(columns[0].max())) if columns and len(columns[0]) else None


def _format_name(texts: Sequence[str], old: bool) -> str:
    vehicle = next((text for text in texts if _RELEASE.match(text)), "ArduPilot")
    return f"dataflash, {vehicle}{', RATE in the units of 3.3 and older' if old else ''}"
