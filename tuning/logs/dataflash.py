"""ArduPilot dataflash logs (.bin), with the format definitions and index of pymavlink's DFReader."""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tuning.errors import TuningError
from tuning.logs.flight import intervals
from tuning.logs.recording import Recording
from tuning.logs.resample import MAX_GAP, Interval, Series, monotone, sampling_period

DEGREE = np.pi / 180

#: Signal -> (message, fields, factor to SI), best first. ANG has fast angles since 4.6; ATT is slow from then on.
LAYOUTS = {
    "u": (("RATE", ("ROut", "POut"), 1.0),),
    "y_i": (("RATE", ("R", "P"), DEGREE),),
    "y_o": (("ANG", ("Roll", "Pitch"), DEGREE), ("ATT", ("Roll", "Pitch"), DEGREE)),
    "r_o": (("ANG", ("DesRoll", "DesPitch"), DEGREE), ("ATT", ("DesRoll", "DesPitch"), DEGREE)),
    "r_i": (("RATE", ("RDes", "PDes"), DEGREE),),
}

#: Axis of the system identification mode (SIDS.Ax) whose waveform is added to the moment -> column of u.
MIXER_AXES = {10: 0, 11: 1}

EV_DISARMED, EV_LANDED, EV_NOT_LANDED = 11, 18, 28
NOTE = (
    "flown gains are not taken over: ArduPilot's D acts on the filtered error and its yaw error is filtered, which no "
    "gains of this controller say; give yaw, limits and derivative_cutoff_hz in a --spec file"
)

_NUMBERS = dict(
    zip("bBhHiIqQfdgM", ("i1", "u1", "<i2", "<u2", "<i4", "<u4", "<i8", "<u8", "<f4", "<f8", "<f2", "u1"), strict=True)
)
_NUMBERS |= {"c": "<i2", "C": "<u2", "e": "<i4", "E": "<u4", "L": "<i4"}
_TEXTS = {"n": "S4", "N": "S16", "Z": "S64", "a": "S64"}


def record_dataflash(path: Path) -> Recording:
    """Read an ArduPilot dataflash log.

    Parameters
    ----------
    path : Path
        The log.

    Returns
    -------
    Recording
        The waveform of the system identification mode is the excitation where it was added to the moment
        (SID_AXIS 10 and 11, mixer).

    Raises
    ------
    TuningError
        When the file is damaged.
    """
    log = _open(path)
    signals = {}
    for signal, layouts in LAYOUTS.items():
        for message, fields, factor in layouts:
            series = log.series(message, fields, factor)
            if series is not None:
                signals[signal] = series
                break
    excitation = _excitation(log)
    if excitation is not None:
        signals["u_bar"] = excitation
    wanted = {
        signal: " or ".join(f"message {message} ({', '.join(fields)})" for message, fields, _ in layouts)
        for signal, layouts in LAYOUTS.items()
    }
    evidence = "message EV (18 landed, 28 not landed)"
    parameters = _parameters(log)
    advice = _advice(log, parameters)
    airborne = _airborne(log)
    return Recording(
        path, _firmware(log), signals, wanted, log.names(), advice, airborne, evidence, parameters, (NOTE,)
    )


@dataclass(frozen=True, eq=False)
class _Log:
    content: NDArray[np.uint8]
    formats: dict[str, Any]
    offsets: dict[str, NDArray[np.int64]]

    def names(self) -> list[str]:
        return sorted(name for name, offsets in self.offsets.items() if len(offsets))

    def fields(self, message: str, names: Sequence[str]) -> list[NDArray[Any]] | None:
        """Values of the fields of a message, multipliers applied; None when it is not logged with them."""
        if message not in self.formats or not set(names) <= set(self.formats[message].columns):
            return None
        layout = self.formats[message]
        kinds = [(_NUMBERS | _TEXTS).get(letter) for letter in layout.format]
        if None in kinds or len(kinds) != len(layout.columns) or len(set(layout.columns)) != len(kinds):
            return None
        record = np.dtype(list(zip(layout.columns, kinds, strict=True)))
        if record.itemsize + 3 != layout.len:
            return None
        offsets = self.offsets[message]
        offsets = offsets[offsets + layout.len <= len(self.content)]
        rows = self.content[offsets[:, None] + np.arange(3, layout.len)].view(record)[:, 0]
        factors = dict(zip(layout.columns, layout.msg_mults, strict=True))
        return [rows[name] * factors[name] if factors[name] else rows[name] for name in names]

    def series(self, message: str, names: Sequence[str], factor: float) -> Series | None:
        columns = self.fields(message, ("TimeUS", *names))
        if columns is None or any(column.dtype.kind == "S" for column in columns) or len(columns[0]) < 2:
            return None
        with np.errstate(invalid="ignore"):  # a damaged float may be a signalling NaN
            time, *values = (column.astype(np.float64) for column in columns)
        return Series(time * 1e-6, np.column_stack(values) * factor, message)


@contextlib.contextmanager
def _silence() -> Iterator[None]:
    """Drop what is printed meanwhile: DFReader tells of every damaged byte, its indexer past Python's own streams."""
    sys.stderr.flush()
    saved = os.dup(2)
    try:
        with (
            Path(os.devnull).open("w") as nothing,
            contextlib.redirect_stdout(nothing),
            contextlib.redirect_stderr(nothing),
        ):
            os.dup2(nothing.fileno(), 2)
            yield
    finally:
        os.dup2(saved, 2)
        os.close(saved)


def _open(path: Path) -> _Log:
    from pymavlink.DFReader import DFReader_binary

    try:
        with _silence():
            reader = DFReader_binary(str(path))
        with contextlib.closing(reader):
            offsets = {name: np.array(reader.offsets[kind], np.int64) for name, kind in reader.name_to_id.items()}
            formats = {name: reader.formats[kind] for name, kind in reader.name_to_id.items()}
    except Exception as error:  # DFReader raises whatever a damaged file makes of its parser
        raise TuningError(
            f"{path}: damaged dataflash log: {error or type(error).__name__}; download it again"
        ) from error
    return _Log(np.frombuffer(path.read_bytes(), np.uint8), formats, offsets)


def _advice(log: _Log, parameters: dict[str, float]) -> str:
    """What to change so that RATE and the angles are logged in every loop."""
    bits = parameters.get("LOG_BITMASK")
    now = f" (it is {int(bits)}, so {int(bits) | 1})" if bits is not None and 0 <= bits < 2**31 else ""
    advice = f"set bit 0 (fast attitude) of LOG_BITMASK{now} and fly again"
    slow = log.series("PIDR", ("Act",), 1.0)
    if "RATE" not in log.names() and slow is not None:
        advice += f"; PIDR, at {1 / np.median(np.diff(slow.time)):.1f} Hz here, does not replace it"
    return advice


def _excitation(log: _Log) -> Series | None:
    """The waveform that the system identification mode added to the moment; zero where that mode was off."""
    waveform = log.series("SIDD", ("Targ",), 1.0)
    runs = log.fields("SIDS", ("TimeUS", "Ax"))
    if waveform is None or runs is None or not len(runs[0]):
        return None
    waveform = monotone(waveform)
    if len(waveform.time) < 3:
        return None
    Ts = sampling_period(waveform.time)
    ends = np.flatnonzero(np.append(np.diff(waveform.time) > MAX_GAP * Ts, True))
    started, axes = runs[0] * 1e-6, runs[1].astype(np.int64)
    # The set-up is stamped just after or before the first sample of its run: the nearest start counts.
    begins = np.concatenate([[0], ends[:-1] + 1])
    run = np.searchsorted(begins, np.arange(len(waveform.time)), side="right") - 1
    axis = np.array([axes[np.argmin(np.abs(started - waveform.time[begin]))] for begin in begins])[run]
    values = np.zeros((len(axis), 2))
    for code, column in MIXER_AXES.items():
        values[axis == code, column] = waveform.values[axis == code, 0]
    time = np.concatenate([waveform.time, waveform.time[ends] + Ts])
    order = np.argsort(time, kind="stable")
    values = np.concatenate([values, np.zeros((len(ends), 2))])[order]
    return Series(time[order], values, "SIDD") if values.any() else None


def _airborne(log: _Log) -> tuple[Interval, ...] | None:
    events = log.fields("EV", ("TimeUS", "Id"))
    if events is None:
        return None
    time, code = events[0] * 1e-6, events[1]
    known = np.isin(code, (EV_DISARMED, EV_LANDED, EV_NOT_LANDED))
    if not np.isin(code, (EV_LANDED, EV_NOT_LANDED)).any():
        return None
    time, flying = time[known], code[known] == EV_NOT_LANDED
    order = np.argsort(time, kind="stable")
    time, flying = time[order], flying[order]
    # Before the first event it was the other way round.
    return intervals(np.append(time[0] - 1.0, time), np.append(not flying[0], flying))


def _parameters(log: _Log) -> dict[str, float]:
    columns = log.fields("PARM", ("Name", "Value"))
    if columns is None:
        return {}
    names = (name.decode("ascii", "replace") for name in columns[0].tolist())
    return {name: float(value) for name, value in zip(names, columns[1], strict=True)}


def _firmware(log: _Log) -> str:
    columns = log.fields("MSG", ("Message",))
    texts = [text.decode("ascii", "replace") for text in columns[0].tolist()] if columns else []
    vehicle = next((text for text in texts if text.startswith(("ArduCopter", "APM:Copter", "ArduPlane"))), "ArduPilot")
    return f"dataflash, {vehicle}"
