"""Bringing the signals of a log, each with its own time stamps, to one uniform grid."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tuning.errors import TuningError

MIN_RATE = 100.0  # Hz, of the torque: below it gains come out wrong
MAX_GAP = 5  # samples
MIN_SECONDS = 5.0


@dataclass(frozen=True, eq=False)
class Series:
    """One signal as logged: time (N,), s; values (N, n); and the topic that it came from."""

    time: NDArray[np.float64]
    values: NDArray[np.float64]
    topic: str


@dataclass(frozen=True, eq=False)
class Grid:
    """Signals on one grid: period (s), name -> (N, 2) array, and the stretches without a gap (samples)."""

    Ts: float
    signals: dict[str, NDArray[np.float64]]
    segments: tuple[tuple[int, int], ...]


def on_common_grid(
    series: Mapping[str, Series], held: Sequence[str], begin: float, end: float, source: str, primary: str
) -> Grid:
    """Signals on the grid of the `primary` one, between two times.

    Set-points, torque and excitation are held, measurements interpolated. Where a signal pauses for more
    than five periods the grid is cut; a repeated or backward time stamp is dropped, the last value kept.

    Parameters
    ----------
    series : mapping
        Name -> signal.
    held : sequence of str
        Names of the signals that are constant between samples.
    begin, end : float, s
        Part of the log to use.
    source : str
        Name of the log, for messages.
    primary : str
        The signal whose sampling makes the grid: the torque.

    Returns
    -------
    Grid

    Raises
    ------
    TuningError
        When the primary signal is slower than 100 Hz, or less than 5 s are left.
    """
    clean = {name: _monotone(signal) for name, signal in series.items()}
    main = clean[primary]
    inside = (main.time >= begin - 1e-9) & (main.time <= end + 1e-9)
    time = main.time[inside]
    if len(time) < 3:
        raise TuningError(f"{source}: too short: {main.topic} has {len(time)} samples where the experiment is")
    Ts = _period(time)
    if 1 / Ts < MIN_RATE * 0.99:
        raise TuningError(
            f"{source}: too slow: {main.topic} is logged at {1 / Ts:.1f} Hz, tuning needs {MIN_RATE:g} Hz or more; "
            "set SDLOG_PROFILE to 17 (high rate) and fly again"
        )
    start, stop = time[0], time[-1]
    for name in ("y_i", "y_o"):
        start, stop = max(start, clean[name].time[0]), min(stop, clean[name].time[-1])
    count = int(np.floor((stop - start) / Ts + 0.5)) + 1
    if count * Ts < MIN_SECONDS:
        raise TuningError(
            f"{source}: too short: {max(count, 0) * Ts:.1f} s of flight, tuning needs {MIN_SECONDS:g} s or more"
        )
    grid = start + Ts * np.arange(count)
    gap_free = np.ones(count, bool)
    signals = {}
    for name, signal in clean.items():
        signals[name] = _place(signal, grid, Ts, name in held)
        if name in ("u", "y_i", "y_o"):
            gap_free &= _covered(signal.time, grid, Ts)
    segments = _runs(gap_free & np.all([np.isfinite(s).all(axis=1) for s in signals.values()], axis=0))
    usable = sum(b - a for a, b in segments) * Ts
    if usable < MIN_SECONDS:
        raise TuningError(f"{source}: too short: {usable:.1f} s without a gap, tuning needs {MIN_SECONDS:g} s or more")
    return Grid(Ts, signals, segments)


def _monotone(signal: Series) -> Series:
    """Drop repeated and backward time stamps; of equal ones the last is kept."""
    order = np.flatnonzero(np.append(np.diff(signal.time) > 0, True))
    time, values = signal.time[order], signal.values[order]
    rising = time >= np.maximum.accumulate(time)
    return Series(time[rising], values[rising], signal.topic)


def _period(time: NDArray[np.float64]) -> float:
    """Sampling period, s: the median interval, refined over the log where single samples are missing."""
    median = float(np.median(np.diff(time)))
    index = np.concatenate([[0], np.cumsum(np.maximum(1, np.round(np.diff(time) / median)))])
    refined = float(np.polyfit(index, time, 1)[0])
    period = refined if abs(refined / median - 1) < 0.01 else median
    return round(period, 9) if abs(period - round(period, 6)) > 2e-9 else round(period, 6)


def _place(signal: Series, grid: NDArray[np.float64], Ts: float, hold: bool) -> NDArray[np.float64]:
    # A thousandth of a period forgives rounding of the stamps, so that equal times pair exactly.
    index = np.searchsorted(signal.time, grid + 1e-3 * Ts, side="right") - 1
    last = signal.values[np.maximum(index, 0)]
    if hold:
        return np.where((index >= 0)[:, None], last, 0.0)
    exact = np.abs(signal.time[np.maximum(index, 0)] - grid) <= 1e-3 * Ts
    between = np.column_stack([np.interp(grid, signal.time, column) for column in signal.values.T])
    return np.where(exact[:, None], last, between)


def _covered(time: NDArray[np.float64], grid: NDArray[np.float64], Ts: float) -> NDArray[np.bool_]:
    """False for grid points inside a pause of more than MAX_GAP periods."""
    right = np.clip(np.searchsorted(time, grid - 1e-3 * Ts, side="left"), 0, len(time) - 1)
    left = np.clip(np.searchsorted(time, grid + 1e-3 * Ts, side="right") - 1, 0, len(time) - 1)
    covered: NDArray[np.bool_] = time[right] - time[left] <= MAX_GAP * Ts * 1.001
    return covered


def _runs(mask: NDArray[np.bool_]) -> tuple[tuple[int, int], ...]:
    edges = np.flatnonzero(np.diff(np.concatenate([[0], mask.astype(np.int8), [0]])))
    return tuple((int(a), int(b)) for a, b in zip(edges[::2], edges[1::2], strict=True))
