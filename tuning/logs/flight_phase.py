"""Which part of a log is flight: where the vehicle says it was airborne, else where it moves."""

from __future__ import annotations

import numpy as np
from mimopilot.tuning.errors import TuningError
from mimopilot.tuning.logs.recording import Recording
from mimopilot.tuning.logs.resample import Interval, Series
from numpy.typing import NDArray

STILL_RATE = 0.01  # rad/s, standard deviation over a second: no multirotor hovers that quietly
STILL_WINDOW = 1.0  # s
TUMBLE = np.radians(75.0)  # of tilt: no multirotor holds its altitude there
BEFORE = 1.0  # s before a tumble that are not used: a vehicle is lost within 0.7 s of losing a motor
AGAIN = 3  # tumbles that are none: degrees for radians, or aerobatics
SHORT = 0.1  # s on the ground that are not worth telling


def flying_parts(recording: Recording) -> tuple[tuple[Interval, ...], tuple[str, ...]]:
    """The parts of a log that may be used for tuning.

    An injected excitation marks the experiment: from its first to its last sample that is not zero. Of it, or of the
    whole log, counts what was in the air, as the vehicle says, or from the first to the last movement; and nothing
    from the second before a tumble on.

    Parameters
    ----------
    recording : Recording
        With torque, rates and angles.

    Returns
    -------
    parts : tuple of (begin, end), s
    said : tuple of str
        What was cut off and why.

    Raises
    ------
    TuningError
        When the vehicle never flew, or tumbles again and again.
    """
    airborne, source = recording.airborne, str(recording.path)
    rates, torque = recording.signals["y_i"], recording.signals["u"]
    if airborne is not None:
        airborne = intersection(airborne, ((float(rates.time[0]), float(rates.time[-1])),))
    if airborne is not None and not airborne:
        raise TuningError(f"{source}: no flight: {recording.evidence} says that it never left the ground; fly it")
    marked = _marked(recording.signals.get("u_bar"))
    said: list[str] = []
    parts: tuple[Interval, ...] = (marked,) if marked else ((-np.inf, np.inf),)
    if airborne:
        parts = intersection(parts, airborne)
        if marked and not parts:
            raise TuningError(
                f"{source}: no flight: {recording.evidence} says that it was on the ground while a torque was "
                "injected; take off first"
            )
        grounded = marked[1] - marked[0] - sum(b - a for a, b in parts) if marked else 0.0
        if grounded > SHORT:
            said.append(
                f"{recording.evidence} says on the ground for {grounded:.1f} s of the excitation: that part is not used"
            )
    parts, tumble = _before_tumble(recording, parts)
    if tumble:
        said.append(tumble)
    moving = _moving(rates, parts)
    if moving is None or not np.ptp(torque.values, axis=0).any():
        largest = float(np.abs(rates.values).max())
        still = (
            f"the body rates in {rates.topic} do not move (at most {largest:.2g} rad/s)"
            if moving is None
            else f"{torque.topic} does not move"
        )
        seconds = sum(b - a for a, b in airborne or ())
        flew = f"{recording.evidence} says airborne for {seconds:.1f} s, but " if airborne else ""
        unit = "; if it flew, the unit of the rates is wrong" if moving is None else ""
        raise TuningError(
            f"{source}: no flight: {flew}{still}; a log from the bench cannot be tuned from, fly it{unit}"
        )
    return parts if marked or airborne else intersection(parts, (moving,)), tuple(said)


def _before_tumble(recording: Recording, parts: tuple[Interval, ...]) -> tuple[tuple[Interval, ...], str]:
    """The parts without what comes from the second before a tumble on, and what is to be said of it.

    Raises
    ------
    TuningError
        When the tilt is large again and again: that is no multirotor that was lost.
    """
    angles, source = recording.signals["y_o"], str(recording.path)
    tilt = np.arccos(np.clip(np.cos(angles.values[:, 0]) * np.cos(angles.values[:, 1]), -1.0, 1.0))
    inside = np.zeros(len(tilt), bool)
    for a, b in parts:
        inside |= (angles.time >= a) & (angles.time <= b)
    beyond = np.flatnonzero(inside & (tilt > TUMBLE))
    if not len(beyond):
        return parts, ""
    level = np.flatnonzero(inside & (tilt < TUMBLE / 2))
    times = len(np.unique(np.searchsorted(level, beyond)))
    if times >= AGAIN:
        raise TuningError(
            f"{source}: {angles.topic}: a tilt beyond {np.degrees(TUMBLE):.0f} degrees {times} times where the "
            "experiment is; no multirotor flies like that: are the angles in degrees (then give their unit), or was it "
            "aerobatics? Excite in hover"
        )
    at = float(angles.time[beyond[0]])
    kept = intersection(parts, ((-np.inf, at - BEFORE),))
    begin = min(float(series.time[0]) for series in recording.signals.values())
    if not kept:
        raise TuningError(
            f"{source}: no flight: a tilt beyond {np.degrees(TUMBLE):.0f} degrees at {at - begin:.1f} s, at the "
            "beginning of the experiment; fly it again"
        )
    return kept, (
        f"the vehicle tumbled at {at - begin:.1f} s (tilt beyond {np.degrees(TUMBLE):.0f} degrees): only what is "
        f"{BEFORE:g} s or more before it is used"
    )


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
