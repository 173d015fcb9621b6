"""The part of a log in flight: from the land detector or arming events, else from the body rates."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mimopilot.tuning.errors import TuningError
from mimopilot.tuning.logs.recording import Recording
from mimopilot.tuning.logs.resample import Interval, Series

STILL_RATE = 0.01  # rad/s, standard deviation over `STILL_WINDOW`: every hover is noisier
STILL_WINDOW = 1.0  # s
TUMBLE = np.radians(75.0)  # rad of tilt: no multirotor holds altitude beyond it
BEFORE_TUMBLE = 1.0  # s before a tumble that are not used: control is lost within 0.7 s of a motor failure
MAX_TUMBLES = 3  # as many tumbles mean degrees taken for radians, or aerobatics
#: s after the excitation in which the response fades: a chirp that ends with the record looks like its transient.
FADE = 2.0
#: s between a part of roll and pitch and one of yaw: less than a sample, so that none is in both.
APART = 1e-4
SHORT = 0.1  # s on the ground during the excitation that need no warning


def flying_parts(recording: Recording) -> tuple[tuple[Interval, ...], tuple[str, ...]]:
    """The parts of a log that can be used for tuning.

    An excitation of roll or pitch marks the experiment: from its first nonzero sample until the response to the last
    has faded, or yaw's excitation begins. Without one it is the whole log. Of the experiment the part in flight is
    used: as the vehicle logged it, else from the first to the last movement. Nothing is used from `BEFORE_TUMBLE`
    before a tumble on.

    Parameters
    ----------
    recording : Recording
        Holds torque, rates and angles.

    Returns
    -------
    parts : tuple of (begin, end), s
    warnings : tuple of str
        What is not used and why.

    Raises
    ------
    TuningError
        When the vehicle never flew, or tumbled `MAX_TUMBLES` times or more.
    """
    airborne, source = recording.airborne, str(recording.path)
    rates, torque = recording.signals["y_i"], recording.signals["u"]
    if airborne is not None:
        airborne = intersection(airborne, ((float(rates.time[0]), float(rates.time[-1])),))
    if airborne is not None and not airborne:
        raise TuningError(
            f"{source}: no flight: according to {recording.evidence} the vehicle never left the ground; record a flight"
        )
    marked = _marked(
        recording.signals.get("u_bar") or recording.signals.get("r_bar"), _active(_injected_into_yaw(recording))
    )
    warnings: list[str] = []
    parts: tuple[Interval, ...] = (marked,) if marked else ((-np.inf, np.inf),)
    if airborne:
        parts = intersection(parts, airborne)
        if marked and not parts:
            raise TuningError(
                f"{source}: no flight: according to {recording.evidence} the vehicle was on the ground while a torque "
                "was injected; take off first"
            )
        grounded = marked[1] - marked[0] - sum(b - a for a, b in parts) if marked else 0.0
        if grounded > SHORT:
            warnings.append(
                f"on the ground for {grounded:.1f} s of the excitation, according to {recording.evidence}: not used"
            )
    parts, tumble = _before_tumble(recording, parts)
    if tumble:
        warnings.append(tumble)
    moving = _moving(rates, parts)
    if moving is None or not np.ptp(torque.values, axis=0).any():
        largest = float(np.abs(rates.values).max())
        still = (
            f"the body rates in {rates.topic} do not change (at most {largest:.2g} rad/s)"
            if moving is None
            else f"{torque.topic} does not change"
        )
        seconds = sum(b - a for a, b in airborne or ())
        flew = f"airborne for {seconds:.1f} s according to {recording.evidence}, but " if airborne else ""
        unit = "; if the vehicle flew, correct the unit of the rates" if moving is None else ""
        raise TuningError(
            f"{source}: no flight: {flew}{still}; a log of a vehicle at rest cannot be used, record a flight{unit}"
        )
    return parts if marked or airborne else intersection(parts, (moving,)), tuple(warnings)


def yaw_parts(recording: Recording, parts: tuple[Interval, ...]) -> tuple[Interval, ...]:
    """The parts of a log that can be used for yaw.

    Where a torque or a rate is injected into yaw: those stretches in flight, each until its response has faded and from
    as long before, but behind parts of roll and pitch: the longer a stretch, the finer its spectrum. Nothing from
    `BEFORE_TUMBLE` before a tumble on. Otherwise those of roll and pitch.

    Parameters
    ----------
    recording : Recording
        Holds torque, rates and angles.
    parts : tuple of (begin, end), s
        Of roll and pitch, from `flying_parts`.
    """
    injected = _injected_into_yaw(recording)
    time = _active(injected)
    if injected is None or not len(time):
        return parts
    pauses = np.flatnonzero(np.diff(time) > 2 * FADE)
    begins, ends = time[np.append(0, pauses + 1)], time[np.append(pauses, -1)]
    first, last = float(injected.time[0]), float(injected.time[-1])
    marked = tuple(
        (
            max(float(a) - FADE, first, *(stop + APART for _, stop in parts if stop <= a)),
            min(float(b) + FADE, last),
        )
        for a, b in zip(begins, ends, strict=True)
    )
    whole = ((min(parts[0][0], marked[0][0]), max(parts[-1][1], marked[-1][1])),)
    try:
        kept, _ = _before_tumble(recording, whole)
    except TuningError:
        return ()
    return intersection(intersection(marked, kept), recording.airborne or whole)


def _injected_into_yaw(recording: Recording) -> Series | None:
    return recording.yaw.get("u_bar") or recording.yaw.get("r_bar")


def _active(injected: Series | None) -> NDArray[np.float64]:
    """Times (s) of the samples that are not zero."""
    return np.empty(0) if injected is None else injected.time[injected.values.any(axis=1)]


def _before_tumble(recording: Recording, parts: tuple[Interval, ...]) -> tuple[tuple[Interval, ...], str]:
    """The parts until `BEFORE_TUMBLE` before the first tumble, and a warning; empty when there is no tumble.

    Raises
    ------
    TuningError
        When there are `MAX_TUMBLES` tumbles or more, or one at the beginning of the experiment.
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
    if times >= MAX_TUMBLES:
        # A log that names its signals knows their units, too.
        unit = "" if recording.columns is None else "if the angles are in degrees, give their unit; "
        raise TuningError(
            f"{source}: {angles.topic}: a tilt beyond {np.degrees(TUMBLE):.0f} degrees {times} times in the "
            f"experiment: {unit}if it was aerobatics, excite in hover instead"
        )
    at = float(angles.time[beyond[0]])
    kept = intersection(parts, ((-np.inf, at - BEFORE_TUMBLE),))
    begin = min(float(series.time[0]) for series in recording.signals.values())
    if not kept:
        raise TuningError(
            f"{source}: no flight: a tilt beyond {np.degrees(TUMBLE):.0f} degrees at {at - begin:.1f} s, at the "
            "beginning of the experiment; repeat the flight"
        )
    return kept, (
        f"the vehicle tumbled at {at - begin:.1f} s (tilt beyond {np.degrees(TUMBLE):.0f} degrees): only the log until "
        f"{BEFORE_TUMBLE:g} s before it is used"
    )


def intervals(time: NDArray[np.float64], flag: NDArray[np.bool_]) -> tuple[Interval, ...]:
    """Intervals in which a logged state was true; each sample holds until the next.

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
    """The intervals (s) with pauses up to `pause` (s) filled: idle throttle in a descent is still flight."""
    joined: list[Interval] = []
    for a, b in parts:
        if joined and a - joined[-1][1] <= pause:
            a = joined.pop()[0]
        joined.append((a, b))
    return tuple(joined)


def intersection(first: tuple[Interval, ...], second: tuple[Interval, ...]) -> tuple[Interval, ...]:
    """Intersection of two lists of intervals, s."""
    shared = ((max(a, c), min(b, d)) for a, b in first for c, d in second)
    return tuple(sorted((a, b) for a, b in shared if a < b))


def _marked(excitation: Series | None, yaw: NDArray[np.float64]) -> Interval | None:
    """From the first excitation until the last has faded, or yaw is excited: that would be noise. `yaw`: when, s."""
    active = _active(excitation)
    if excitation is None or not len(active):
        return None
    end = min(active[-1] + FADE, excitation.time[-1])
    following = yaw[yaw > active[-1]]
    if len(following) and following[0] <= end:
        end = excitation.time[np.searchsorted(excitation.time, following[0]) - 1]
    return float(active[0]), float(end)


def _moving(rates: Series, parts: tuple[Interval, ...]) -> Interval | None:
    """From one window before the first movement to one after the last; None without movement."""
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
