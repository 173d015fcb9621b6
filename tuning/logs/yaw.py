"""The yaw axis of a log: found, checked, and left out with a warning where it cannot be used.

A log is good for roll and pitch without yaw, so nothing here refuses one.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from mimopilot.tuning.errors import TuningError
from mimopilot.tuning.experiment import Experiment, YawSignals, external_yaw_signal
from mimopilot.tuning.logs.columns import YAW_SIGNALS
from mimopilot.tuning.logs.flight_phase import yaw_parts
from mimopilot.tuning.logs.log_checks import CONTAINED, DEGREE, EXPLAINED, SAME_UNIT
from mimopilot.tuning.logs.recording import Recording
from mimopilot.tuning.logs.resample import MIN_SECONDS, REQUIRED, Grid, Interval, rate_of
from mimopilot.tuning.logs.signal_relations import WINDOW, injected_in

#: s. Headings are compared with rates integrated over this time: yaw moves slower than roll and pitch.
INTEGRATION = 0.5
#: rad, RMS over `INTEGRATION`, that this share of the windows must stay below for yaw to count as still: an estimated
#: heading wanders by 1 to 3 degrees.
MOVES, MOST = 0.02, 0.9
#: s, Hz: length of a spectrum, and the band in which the direction of the torque is judged: below it heading control
#: and wind act, above it the motors' lag turns the sign.
SPECTRUM, BAND = 4.0, (0.3, 5.0)
#: s: largest delay from the torque to its acceleration.
MAX_DELAY = 0.1
#: Coherence of the excitation with the rate from which on the direction of the torque is certain.
CLEAR = 0.3

Signal = NDArray[np.float64]


def yaw_intervals(recording: Recording, parts: tuple[Interval, ...]) -> tuple[tuple[Interval, ...], list[str]]:
    """The parts (s) of a log to use for yaw, and a warning when it has some of yaw's signals but cannot be used.

    Parameters
    ----------
    recording : Recording
        The log.
    parts : tuple of (begin, end), s
        Those of roll and pitch.
    """
    if not all(name in recording.yaw for name in REQUIRED):
        return (), []
    found = yaw_parts(recording, parts)
    if not found:
        return (), ["yaw is left out: it was not excited in flight"]
    try:
        slow = [
            complaint
            for name in REQUIRED
            if (complaint := rate_of(name, recording.yaw[name], found[0][0], found[-1][1], "yaw is left out")[1])
        ]
    except TuningError as error:
        return (), [str(error)]
    return ((), [f"yaw is left out: too slow: {'; '.join(dict.fromkeys(slow))}"]) if slow else (found, [])


def yaw_signals(grid: Grid, experiment: Experiment, recording: Recording) -> tuple[YawSignals | None, list[str]]:
    """The checked signals of yaw, and a warning where there are none though they were logged.

    Parameters
    ----------
    grid : Grid
        All signals on one grid.
    experiment : Experiment
        Those of roll and pitch.
    recording : Recording
        The log, for the names of its signals.
    """
    if not grid.yaw:
        return None, []
    seconds = sum(b - a for a, b in grid.yaw_segments) * grid.Ts
    if seconds < MIN_SECONDS:
        return None, [f"yaw is left out: too short: {seconds:.1f} s without a gap, {MIN_SECONDS:g} s are needed"]
    signals = {name: values[:, 0] for name, values in grid.yaw.items()}
    if "r_o" in signals:
        signals["r_o"] = _near(signals["r_o"], signals["y_o"], grid.yaw_segments)
    yaw = YawSignals(**signals, segments=grid.yaw_segments)
    wrong = _heading_fault(yaw, experiment, recording) or _torque_fault(yaw, grid.Ts, recording)
    wrong = wrong or _injection_fault(yaw, recording)
    return (None, [f"yaw is left out: {wrong}"]) if wrong else (yaw, [])


def _near(setpoint: Signal, heading: Signal, segments: tuple[tuple[int, int], ...]) -> Signal:
    """The heading setpoint without whole turns from the heading, segment by segment."""
    found = setpoint.copy()
    for start, stop in segments:
        turns = np.round(np.median(setpoint[start:stop] - heading[start:stop]) / math.tau)
        found[start:stop] -= math.tau * turns
    return found


def _name(signal: str, recording: Recording) -> str:
    """Topic, message or column of a signal of yaw."""
    topic = recording.yaw[signal].topic
    return topic if recording.columns else f"{topic} (yaw)"


def _correction(signal: str, what: str, recording: Recording) -> str:
    """The column-file line that corrects a signal; empty when the log names its signals itself."""
    field = YAW_SIGNALS.get(signal)
    if recording.columns is None or field is None:
        return ""
    return f"; put into the --columns file: {recording.columns.line(field, field, what)}"


def _heading_fault(yaw: YawSignals, experiment: Experiment, recording: Recording) -> str:
    """Why rate and heading do not agree; empty when they do, or yaw moves too little to tell."""
    step, window = max(1, round(INTEGRATION / experiment.Ts)), max(1, round(WINDOW / experiment.Ts))
    both = own = moved = 0.0
    sizes = []
    for start, stop in yaw.segments:
        roll, pitch = experiment.y_o[start:stop].T
        # The heading turns by the component of the body rates about the vertical.
        rate = (experiment.y_i[start:stop, 1] * np.sin(roll) + yaw.y_i[start:stop] * np.cos(roll)) / np.cos(pitch)
        turned = np.cumsum((rate[1:] + rate[:-1]) / 2 * experiment.Ts)
        heading = yaw.y_o[start + 1 : stop]
        for begin in range(0, len(turned) - step, window):
            part = slice(begin, begin + window)
            x, y = turned[step:][part] - turned[:-step][part], heading[step:][part] - heading[:-step][part]
            x, y = x - x.mean(), y - y.mean()
            sizes.append(float(np.sqrt(np.mean(x**2))))
            scale = float(np.sqrt(np.sum(x**2) * np.sum(y**2)))
            if sizes[-1] < MOVES or scale <= 0:
                continue  # the noise of a yaw that is still
            both, own, moved = both + x @ y / scale, own + x @ x / scale, moved + y @ y / scale
    if not sizes or np.quantile(sizes, MOST) < MOVES or not moved:
        return ""
    factor, explained = both / own, both**2 / (own * moved)
    rates, headings = _name("y_i", recording), _name("y_o", recording)
    if explained < EXPLAINED:
        return f"the rate in {rates} explains {explained:.0%} of the movement of {headings}, expected nearly all"
    if factor < 0:
        return (
            f"the heading in {headings} turns against the rate in {rates}: one has the wrong sign"
            f"{_correction('y_i', 'sign', recording)}"
        )
    if not SAME_UNIT[0] < factor < SAME_UNIT[1]:
        degrees = any(SAME_UNIT[0] < ratio < SAME_UNIT[1] for ratio in (factor / DEGREE, factor * DEGREE))
        return (
            f"the heading in {headings} changes {factor:.3g} times the integral of {rates}, expected 1: "
            f"{'degrees are taken for radians' if degrees else 'a wrong unit'}"
            f"{_correction('y_o' if factor > 1 else 'y_i', 'unit', recording) if degrees else ''}"
        )
    return ""


def _injection_fault(yaw: YawSignals, recording: Recording) -> str:
    """Why the torque or the rate setpoint does not contain what was injected; empty when they do."""
    for whole, part in (("u", "u_bar"), ("r_i", "r_bar")):
        total, injected = getattr(yaw, whole), getattr(yaw, part)
        if total is None or injected is None or not any(injected[a:b].any() for a, b in yaw.segments):
            continue
        share = float(injected_in(total[:, None], injected[:, None], yaw.segments)[0, 0])
        if share < CONTAINED:
            return (
                f"{_name(whole, recording)} does not contain what was injected, {_name(part, recording)} "
                f"({share:.2f} of it, expected 1): "
                f"{'one has the wrong sign' if share < -CONTAINED else 'log both at full rate'}"
                f"{_correction(part, 'sign', recording) if share < -CONTAINED else ''}"
            )
    return ""


def _torque_fault(yaw: YawSignals, Ts: float, recording: Recording) -> str:
    """Why the torque accelerates yaw in the wrong direction; empty when it does not, or this is not certain."""
    found = external_yaw_signal(yaw)
    if found is None:
        return ""
    acceleration, coherence = torque_to_acceleration(yaw, found[0], Ts)
    if acceleration > 0 or coherence < CLEAR:
        return ""
    return (
        f"a unit of the torque in {_name('u', recording)} accelerates yaw by {acceleration:.3g} rad/s^2, expected a "
        f"positive number: the torque, or rate and heading, have the wrong sign{_correction('u', 'sign', recording)}"
    )


def torque_to_acceleration(yaw: YawSignals, external: Signal, Ts: float) -> tuple[float, float]:
    """Acceleration of yaw for a unit of torque (rad/s^2) and the coherence of external signal and rate.

    Both from the spectra of the external signal, (N,), with torque and rate in `BAND`: the loop's noise does not reach
    them. A delay up to `MAX_DELAY` is allowed for: the one that explains the most.
    """
    from scipy.signal import csd

    length = round(SPECTRUM / Ts)
    total = np.zeros((4, length // 2 + 1), complex)
    for start, stop in yaw.segments:
        w, u, y = (signal[start:stop] for signal in (external, yaw.u, yaw.y_i))
        if len(w) < length // 2:
            continue
        pairs = ((w, u), (w, y), (w, w), (y, y))
        for row, (a, b) in zip(total, pairs, strict=True):
            shorter = min(length, len(a))
            row += len(a) * csd(a, b, 1 / Ts, nperseg=shorter, nfft=length)[1]
    frequency = np.arange(length // 2 + 1) / (length * Ts)
    used = (frequency >= BAND[0]) & (frequency <= BAND[1])
    wu, wy, ww, yy = total[:, used]
    omega = 2 * np.pi * frequency[used]
    power = float(np.sum(np.abs(wu) ** 2))
    if power <= 0:
        return 0.0, 0.0
    delays = np.arange(0.0, MAX_DELAY, Ts)
    gains = [float(np.sum((np.conj(wu) * 1j * omega * wy * np.exp(1j * omega * d)).real) / power) for d in delays]
    coherence = float(np.sum(np.abs(wy) ** 2 / np.abs(ww)) / np.sum(np.abs(yy)))
    return max(gains, key=abs), coherence
