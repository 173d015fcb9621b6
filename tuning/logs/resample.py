"""Resampling the signals of a log, each with its own time stamps, to one uniform grid."""

from __future__ import annotations

import bisect
import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

from mimopilot.tuning.errors import TuningError

MIN_RATE = 100.0  # Hz, of torque, rates and angles: gains from slower logs are wrong
MAX_GAP = 5  # periods; a longer pause cuts the log
MIN_SECONDS = 5.0  # s of flight without a gap that tuning needs
SAME_RATE = 1.1  # periods within this factor count as equal
MAX_EMPTY = 20  # grid points per sample; more means a damaged time stamp

#: Signals that every log must hold, all at `MIN_RATE` or more.
REQUIRED = ("u", "y_i", "y_o")
#: Signals held between samples; the others are interpolated.
HELD = ("u", "u_bar", "r_bar", "r_o", "r_i")

Interval = tuple[float, float]


@dataclass(frozen=True, eq=False)
class Series:
    """One signal as logged: time (N,), s; values (N, n); and the topic, message or columns it came from."""

    time: NDArray[np.float64]
    values: NDArray[np.float64]
    topic: str


@dataclass(frozen=True, eq=False)
class Grid:
    """Signals on one grid.

    Attributes
    ----------
    Ts : float, s
        Period.
    signals, yaw : dict
        Name -> (N, 2) array of roll and pitch; name -> (N, 1) array of yaw.
    segments, yaw_segments : tuple of (start, stop)
        Stretches without a gap, in samples: those of roll and pitch, and those of yaw.
    """

    Ts: float
    signals: dict[str, NDArray[np.float64]]
    segments: tuple[tuple[int, int], ...]
    yaw: dict[str, NDArray[np.float64]]
    yaw_segments: tuple[tuple[int, int], ...]


def on_common_grid(
    series: Mapping[str, Series],
    parts: Sequence[Interval],
    source: str,
    advice: str,
    yaw: Mapping[str, Series] | None = None,
    yaw_parts: Sequence[Interval] = (),
) -> Grid:
    """All signals on the time grid of the torque.

    Setpoints, torque and excitation are held; measurements are interpolated. A pause of more than five periods
    in torque, rates or angles cuts the grid. If one of the three is slower than the others, all signals are
    decimated to its rate by the same zero-phase anti-alias filter.

    Parameters
    ----------
    series : mapping
        Name -> signal with increasing time stamps (see `monotone`); must hold `REQUIRED`.
    parts : sequence of (begin, end), s
        Parts of the log to use, in order.
    source : str
        Name of the log, for messages.
    advice : str
        What to change on the vehicle when a signal is slow, for messages.
    yaw : mapping, optional
        The signals of yaw; must hold `REQUIRED`. They change nothing in the rows of `parts`.
    yaw_parts : sequence of (begin, end), s
        Parts of the log to use for yaw, in order.

    Returns
    -------
    Grid

    Raises
    ------
    TuningError
        When torque, rates or angles are slower than 100 Hz, or less than 5 s are left.
    """
    begin, end = parts[0][0], parts[-1][1]
    rates = {name: rate_of(name, series[name], begin, end, source) for name in REQUIRED}
    slow = dict.fromkeys(complaint for _, complaint in rates.values() if complaint)
    if slow:
        raise TuningError(f"{source}: too slow: {'; '.join(slow)}; tuning needs {MIN_RATE:g} Hz or more; {advice}")
    periods = {name: period for name, (period, _) in rates.items()}
    slowest, fastest = max(periods.values()), min(periods.values())
    filtered = slowest > SAME_RATE * fastest
    leader = min(REQUIRED, key=lambda name: periods[name]) if filtered else "u"
    time = _inside(series[leader].time, begin, end)
    Ts = sampling_period(time)
    start, stop = time[0], time[-1]
    for name in REQUIRED:
        start, stop = max(start, series[name].time[0]), min(stop, series[name].time[-1])
    if stop - start > MAX_EMPTY * Ts * (len(time) + 1000):
        raise TuningError(
            f"{source}: damaged time stamps: {len(time)} samples in {stop - start:.3g} s; download it again"
        )
    count = max(0, int(np.floor((stop - start) / Ts + 0.5)) + 1)
    before, after = _rows_for_yaw(series, yaw_parts, (start, start + Ts * (count - 1)), Ts)
    grid = start + Ts * np.arange(-before, count + after)
    usable, usable_for_yaw = _within(grid, parts), _within(grid, yaw_parts)
    usable[:before] = usable[before + count :] = False
    signals = {}
    for name, signal in series.items():
        signals[name] = _place(signal, grid, Ts, name in HELD)
        if name in REQUIRED:
            covered = _covered(signal.time, grid, max(Ts, periods[name]))
            usable &= covered
            usable_for_yaw &= covered
    of_yaw = {name: _place(signal, grid, Ts, name in HELD) for name, signal in (yaw or {}).items()}
    for name in REQUIRED if of_yaw else ():
        time = yaw[name].time if yaw else grid
        usable_for_yaw &= _covered(time, grid, max(Ts, sampling_period(time)))
    segments, yaw_segments = _runs(usable), _runs(usable_for_yaw)
    if filtered:
        slow_Ts, signals, of_yaw, segments, yaw_segments = _decimate_all(
            Ts, signals, of_yaw, segments, yaw_segments, slowest
        )
        Ts = slow_Ts
    seconds = sum(b - a for a, b in segments) * Ts
    if seconds < MIN_SECONDS:
        raise TuningError(
            f"{source}: too short: {seconds:.1f} s of flight without a gap, tuning needs {MIN_SECONDS:g} s or more"
        )
    return Grid(Ts, signals, segments, of_yaw, yaw_segments)


def monotone(signal: Series) -> Series:
    """The signal with increasing time stamps: the last of equal ones is kept, those out of order are dropped."""
    keep = np.append(np.diff(signal.time) != 0, True)[: len(signal.time)]
    time, values = signal.time[keep], signal.values[keep]
    if np.any(np.diff(time) < 0):
        order = _longest_rise(time)
        time, values = time[order], values[order]
    return Series(time, values, signal.topic)


def sampling_period(time: NDArray[np.float64]) -> float:
    """Sampling period, s: the median interval, refined by a line fit that allows for missing samples."""
    median = float(np.median(np.diff(time)))
    index = np.concatenate([[0], np.cumsum(np.maximum(1, np.round(np.diff(time) / median)))])
    refined = float(np.polyfit(index, time, 1)[0])
    period = refined if abs(refined / median - 1) < 0.01 else median
    return round(period, 9) if abs(period - round(period, 6)) > 2e-9 else round(period, 6)


def held_samples(values: NDArray[np.float64]) -> int:
    """Rows for which each value of a slower signal is held; 1 when it is not held.

    Quantisation also repeats values, but irregularly; a hold never gives runs much shorter than its length.
    """
    changes = np.flatnonzero(np.any(np.diff(values, axis=0) != 0, axis=1))
    if len(changes) < 10:
        return 1
    runs = np.diff(changes)
    hold = int(np.median(runs))
    return hold if np.percentile(runs, 10) > hold / 2 else 1


def rate_of(name: str, signal: Series, begin: float, end: float, source: str) -> tuple[float, str]:
    """Period (s) at which the values of a signal change, and a complaint when it is too long."""
    inside = (signal.time >= begin - 1e-9) & (signal.time <= end + 1e-9)
    if np.count_nonzero(inside) < 3:
        raise TuningError(
            f"{source}: too short: {signal.topic} has {np.count_nonzero(inside)} samples in the "
            "experiment; log it faster or fly longer"
        )
    period = sampling_period(signal.time[inside])
    # Many logs quantise angles, so only torque and rates show a hold reliably.
    hold = held_samples(signal.values[inside]) if name != "y_o" else 1
    if 1 / (period * hold) >= MIN_RATE * 0.99:
        return period * hold, ""
    logged = f"{signal.topic} is logged at {1 / period:.1f} Hz"
    if hold > 1:
        logged += f" but each value is held for {hold} samples: its rate is {1 / (period * hold):.1f} Hz"
    return period * hold, logged


def _within(grid: NDArray[np.float64], parts: Sequence[Interval]) -> NDArray[np.bool_]:
    """Whether each grid point is in one of the parts, (N,)."""
    inside = np.zeros(len(grid), bool)
    for a, b in parts:
        inside |= (grid >= a - 1e-9) & (grid <= b + 1e-9)
    return inside


def _rows_for_yaw(
    series: Mapping[str, Series], parts: Sequence[Interval], used: Interval, Ts: float
) -> tuple[int, int]:
    """Grid points to add before and after the used part (s) so that yaw's parts are on the grid, too."""
    if not parts:
        return 0, 0
    begin = max(parts[0][0], *(series[name].time[0] for name in REQUIRED))
    end = min(parts[-1][1], *(series[name].time[-1] for name in REQUIRED))
    before, after = max(0, int((used[0] - begin) / Ts)), max(0, int((end - used[1]) / Ts + 0.5))
    if before + after > MAX_EMPTY * (len(series["u"].time) + 1000):  # damaged time stamps
        return 0, 0
    return before, after


def _inside(time: NDArray[np.float64], begin: float, end: float) -> NDArray[np.float64]:
    return time[(time >= begin - 1e-9) & (time <= end + 1e-9)]


def _longest_rise(time: NDArray[np.float64]) -> list[int]:
    """Indices of the longest increasing subsequence: one wrong stamp costs one sample, whichever way it jumps."""
    tails: list[float] = []
    at: list[int] = []
    before = [-1] * len(time)
    for i, stamp in enumerate(time.tolist()):
        place = bisect.bisect_left(tails, stamp)
        if place == len(tails):
            tails.append(stamp)
            at.append(i)
        else:
            tails[place], at[place] = stamp, i
        before[i] = at[place - 1] if place else -1
    rise, i = [], at[-1]
    while i >= 0:
        rise.append(i)
        i = before[i]
    return rise[::-1]


def _place(signal: Series, grid: NDArray[np.float64], Ts: float, hold: bool) -> NDArray[np.float64]:
    # Allow a thousandth of a period for rounding of the stamps, so that equal times pair exactly.
    index = np.searchsorted(signal.time, grid + 1e-3 * Ts, side="right") - 1
    last = signal.values[np.maximum(index, 0)]
    if hold:
        return np.where((index >= 0)[:, None], last, 0.0)
    exact = np.abs(signal.time[np.maximum(index, 0)] - grid) <= 1e-3 * Ts
    between = np.column_stack([np.interp(grid, signal.time, column) for column in signal.values.T])
    return np.where(exact[:, None], last, between)


def _covered(time: NDArray[np.float64], grid: NDArray[np.float64], Ts: float) -> NDArray[np.bool_]:
    """Whether each grid point is outside pauses of more than MAX_GAP periods, (N,)."""
    right = np.clip(np.searchsorted(time, grid - 1e-3 * Ts, side="left"), 0, len(time) - 1)
    left = np.clip(np.searchsorted(time, grid + 1e-3 * Ts, side="right") - 1, 0, len(time) - 1)
    covered: NDArray[np.bool_] = time[right] - time[left] <= MAX_GAP * Ts * 1.001
    return covered


def _runs(mask: NDArray[np.bool_]) -> tuple[tuple[int, int], ...]:
    edges = np.flatnonzero(np.diff(np.concatenate([[0], mask.astype(np.int8), [0]])))
    return tuple((int(a), int(b)) for a, b in zip(edges[::2], edges[1::2], strict=True))


def _decimate_all(
    Ts: float,
    signals: Mapping[str, NDArray[np.float64]],
    yaw: Mapping[str, NDArray[np.float64]],
    segments: Sequence[tuple[int, int]],
    yaw_segments: Sequence[tuple[int, int]],
    slow: float,
) -> tuple[
    float,
    dict[str, NDArray[np.float64]],
    dict[str, NDArray[np.float64]],
    tuple[tuple[int, int], ...],
    tuple[tuple[int, int], ...],
]:
    """Decimate the segments, then yaw's segments, whose rows follow: each keeps its own ends."""
    together = {("", name): signal for name, signal in signals.items()}
    together |= {("yaw", name): signal for name, signal in yaw.items()}
    period, first, kept = _decimate(Ts, together, segments, slow)
    _, second, of_yaw = _decimate(Ts, together, yaw_segments, slow)
    rows = len(first["", "u"])
    joined = {key: np.concatenate([first[key], second[key]]) for key in together}
    return (
        period,
        {name: joined["", name] for name in signals},
        {name: joined["yaw", name] for name in yaw},
        kept,
        tuple((a + rows, b + rows) for a, b in of_yaw),
    )


def _decimate(
    Ts: float, signals: Mapping[tuple[str, str], NDArray[np.float64]], segments: Sequence[tuple[int, int]], slow: float
) -> tuple[float, dict[tuple[str, str], NDArray[np.float64]], tuple[tuple[int, int], ...]]:
    """Every signal at the period `slow` (s). Each segment is filtered by itself: no filter crosses a gap."""
    from scipy.signal import resample_poly

    ratio = Fraction(Ts / slow).limit_denominator(16)
    up, down = ratio.numerator, ratio.denominator
    long_enough = [(a, b) for a, b in segments if b - a > 2 * down]
    pieces: dict[tuple[str, str], list[NDArray[np.float64]]] = {name: [signal[:0]] for name, signal in signals.items()}
    stops = [0]
    for a, b in long_enough:
        for name, signal in signals.items():
            pieces[name].append(resample_poly(signal[a:b], up, down, axis=0, padtype="line"))
        stops.append(stops[-1] + len(pieces["", "u"][-1]))
    joined = {name: np.concatenate(rows) for name, rows in pieces.items()}
    return Ts * down / up, joined, tuple(itertools.pairwise(stops))
