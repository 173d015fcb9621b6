"""Which part of a log is flight: where the vehicle says it was airborne, else where it moves."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tuning.errors import TuningError
from tuning.logs.recording import Recording
from tuning.logs.resample import Interval, Series

STILL_RATE = 0.01  # rad/s, standard deviation over a second: no multirotor hovers that quietly
STILL_WINDOW = 1.0  # s


def flying_parts(recording: Recording) -> tuple[Interval, ...]:
    """The parts of a log that may be used for tuning.

    An injected excitation marks the experiment: from its first to its last sample that is not zero. Else it
    is the time in the air, as the vehicle says, or from the first to the last movement.

    Parameters
    ----------
    recording : Recording
        With torque, rates and angles.

    Returns
    -------
    tuple of (begin, end), s

    Raises
    ------
    TuningError
        When the vehicle never flew.
    """
    airborne, source = recording.airborne, str(recording.path)
    rates, torque = recording.signals["y_i"], recording.signals["u"]
    if airborne is not None:
        airborne = intersection(airborne, ((float(rates.time[0]), float(rates.time[-1])),))
    if airborne is not None and not airborne:
        raise TuningError(f"{source}: no flight: {recording.evidence} says that it never left the ground; fly it")
    marked = _marked(recording.signals.get("u_bar"))
    if marked and airborne and not any(a < marked[1] and b > marked[0] for a, b in airborne):
        raise TuningError(
            f"{source}: no flight: {recording.evidence} says that it was on the ground while a moment was injected; "
            "take off first"
        )
    parts = (marked,) if marked else airborne or ((-np.inf, np.inf),)
    moving = _moving(rates, parts)
    if moving is None or not np.ptp(torque.values, axis=0).any():
        still = "the body rates do not move" if moving is None else f"{torque.topic} does not move"
        said = (
            f"{recording.evidence} says airborne for {sum(b - a for a, b in airborne):.1f} s, but " if airborne else ""
        )
        raise TuningError(f"{source}: no flight: {said}{still}; a log from the bench cannot be tuned from, fly it")
    return parts if marked or airborne else (moving,)


def intervals(time: NDArray[np.float64], flag: NDArray[np.bool_]) -> tuple[Interval, ...]:
    """When a logged state was true, each sample holding until the next.

    Parameters
    ----------
    time : (N,) array, s
        Stamps, rising.
    flag : (N,) array of bool
        The state. It is taken to hold before the first sample, and after the last, as there.

    Returns
    -------
    tuple of (begin, end), s
        With infinite ends where the log begins or ends in that state.
    """
    if not len(time):
        return ()
    bounds = np.concatenate([[-np.inf], time[1:], [np.inf]])
    edges = np.flatnonzero(np.diff(np.concatenate([[0], flag.astype(np.int8), [0]])))
    return tuple((float(bounds[a]), float(bounds[b])) for a, b in zip(edges[::2], edges[1::2], strict=True))


def bridged(parts: tuple[Interval, ...], pause: float = 1.0) -> tuple[Interval, ...]:
    """The intervals (s) with pauses up to `pause` (s) filled: idle throttle in a dive is still flight."""
    joined: list[Interval] = []
    for a, b in parts:
        if joined and a - joined[-1][1] <= pause:
            a = joined.pop()[0]
        joined.append((a, b))
    return tuple(joined)


def intersection(first: tuple[Interval, ...], second: tuple[Interval, ...]) -> tuple[Interval, ...]:
    """What two lists of intervals share, s."""
    shared = ((max(a, c), min(b, d)) for a, b in first for c, d in second)
    return tuple(sorted((a, b) for a, b in shared if a < b))


def _marked(excitation: Series | None) -> Interval | None:
    if excitation is None:
        return None
    active = np.flatnonzero(excitation.values.any(axis=1))
    return (float(excitation.time[active[0]]), float(excitation.time[active[-1]])) if len(active) else None


def _moving(rates: Series, parts: tuple[Interval, ...]) -> Interval | None:
    """From the second before the first movement to the one after the last; None when there is none."""
    inside = np.zeros(len(rates.time), bool)
    for a, b in parts:
        inside |= (rates.time >= a) & (rates.time <= b)
    time, values = rates.time[inside], rates.values[inside]
    if not len(time):
        return None
    window = np.floor((time - time[0]) / STILL_WINDOW).astype(np.int64)
    starts = np.flatnonzero(np.append(True, np.diff(window) > 0))
    stops = np.append(starts[1:], len(time))
    count = (stops - starts)[:, None]
    mean = np.add.reduceat(values, starts) / count
    spread = np.sqrt(np.maximum(np.add.reduceat(values**2, starts) / count - mean**2, 0)).max(axis=1)
    busy = np.flatnonzero(spread > STILL_RATE)
    if not len(busy):
        return None
    first, last = max(busy[0] - 1, 0), min(busy[-1] + 1, len(stops) - 1)
    return float(time[starts[first]]), float(time[stops[last] - 1])
