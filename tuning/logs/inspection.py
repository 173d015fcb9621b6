"""Inspection of a log: its signals, its excitation, and whether gains can be tuned from it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mimopilot.tuning.errors import TuningError
from mimopilot.tuning.estimation.instrumental_variables import excited_stretches
from mimopilot.tuning.experiment import Experiment, excites, external_signal, external_yaw_signal
from mimopilot.tuning.gains import Gains
from mimopilot.tuning.logs.columns import Columns
from mimopilot.tuning.logs.flight_phase import flying_parts, intersection
from mimopilot.tuning.logs.log_checks import check_log
from mimopilot.tuning.logs.reader import open_log, unchecked_experiment
from mimopilot.tuning.logs.recording import Recording
from mimopilot.tuning.logs.resample import MAX_GAP, Interval, Series, held_samples, sampling_period

AXES = ("roll", "pitch")
BAND_POWER = (0.05, 0.95)  # the band of a signal is between these fractions of its cumulative power


@dataclass(frozen=True)
class SignalReport:
    """One signal as logged; tuples are of roll and pitch, or of yaw.

    Attributes
    ----------
    source : str
        Topic, message or columns.
    rate_hz : float, Hz
        Messages per second.
    held : int
        Messages for which each value is held; 1 when every message has a new value.
    gaps : int
        Pauses of more than `tuning.logs.resample.MAX_GAP` periods.
    longest_gap_s : float, s
        The longest pause.
    minimum, maximum : tuple of float
        Extremes, in SI units.
    saturated : tuple of float or None
        Fraction of torque samples at the limit; None for other signals.
    """

    source: str
    rate_hz: float
    held: int
    gaps: int
    longest_gap_s: float
    minimum: tuple[float, ...]
    maximum: tuple[float, ...]
    saturated: tuple[float, ...] | None


@dataclass(frozen=True)
class ExcitationReport:
    """The external signal on one axis: RMS in the unit of the signal, and the band (Hz) with 90 % of its power."""

    rms: float
    band_hz: tuple[float, float]


@dataclass(frozen=True, eq=False)
class Inspection:
    """What was found in one log.

    Attributes
    ----------
    recording : Recording
        The log as read.
    seconds : float, s
        From the first to the last sample of all signals; of the log when it has no signals.
    airborne : tuple of (begin, end) or None, s
        When the vehicle flew according to the log, since the first sample. None: not logged.
    signals : dict
        Signal name -> report.
    parts : tuple of (begin, end) in s
        Usable parts, since the first sample; empty when the vehicle did not fly.
    yaw : dict
        The same of yaw, with one value each.
    external : dict
        Axis that is excited -> name of the external signal that counts, see `tuning.experiment.EXTERNAL`.
    experiment : Experiment or None
        The usable parts; None when there are none.
    excitation : dict
        Name and axis of the external signal -> report; empty without excitation.
    reason : str or None
        Why gains cannot be tuned from the log and what to change; None when they can be.
    """

    recording: Recording
    seconds: float
    airborne: tuple[Interval, ...] | None
    signals: dict[str, SignalReport]
    parts: tuple[Interval, ...]
    experiment: Experiment | None
    excitation: dict[str, ExcitationReport]
    reason: str | None
    yaw: dict[str, SignalReport]
    external: dict[str, str]

    @property
    def warnings(self) -> tuple[str, ...]:
        """What is wrong with a log that can still be used."""
        return self.experiment.warnings if self.experiment else tuple(self.recording.warnings)

    @property
    def flown(self) -> Gains | None:
        """The gains that flew; None when not logged."""
        return self.experiment.flown if self.experiment else None


def inspect_log(path: Path, columns: Columns | None = None) -> Inspection:
    """Inspect a log without tuning from it.

    Parameters
    ----------
    path : Path
        A log of any format in `tuning.logs.formats`.
    columns : Columns, optional
        Names and units in a CSV or MATLAB file.

    Returns
    -------
    Inspection

    Raises
    ------
    TuningError
        When the file cannot be read.
    """
    recording = open_log(path, columns)
    limit = 1.0
    parts: tuple[Interval, ...] = ()
    experiment, reason = None, None
    excitation: dict[str, ExcitationReport] = {}
    try:
        recording.require_signals()
        parts = flying_parts(recording)[0]
        experiment = unchecked_experiment(recording)
        if experiment.flown is not None:
            limit = min(experiment.flown.limits.moment_max[:2])
        instrument, name = external_signal(experiment)
        excitation = {
            f"{name} {axis}": _excitation(instrument[:, i], experiment.segments, experiment.Ts)
            for i, axis in enumerate(AXES)
        }
        excited_stretches(experiment, instrument, "mimo")
        check_log(experiment, recording)
    except TuningError as error:
        reason = str(error).removeprefix(f"{path}: ").removeprefix(f"{path.name}: ")
    if experiment is not None and experiment.yaw is not None and (of_yaw := external_yaw_signal(experiment.yaw)):
        excitation[f"{of_yaw[1]} yaw"] = _excitation(of_yaw[0], experiment.yaw.segments, experiment.Ts)
    first, last = recording.span or (0.0, 0.0)
    begin = min((float(s.time[0]) for s in recording.signals.values()), default=first)
    end = max((float(s.time[-1]) for s in recording.signals.values()), default=last)

    def since_begin(intervals: tuple[Interval, ...]) -> tuple[Interval, ...]:
        return tuple((a - begin, b - begin) for a, b in intersection(intervals, ((begin, end),)))

    return Inspection(
        recording=recording,
        seconds=end - begin,
        airborne=None if recording.airborne is None else since_begin(recording.airborne),
        signals={
            name: _signal(name, signal, recording.published.get(name, signal.time), limit)
            for name, signal in recording.signals.items()
        },
        parts=since_begin(parts),
        experiment=experiment,
        excitation=excitation,
        reason=reason,
        yaw={name: _signal(name, signal, signal.time, 1.0) for name, signal in recording.yaw.items()},
        external=_excited_axes(experiment),
    )


def _excited_axes(experiment: Experiment | None) -> dict[str, str]:
    """Axis -> name of its external signal, of the axes that one excites."""
    if experiment is None:
        return {}
    found = {}
    try:
        signal, name = external_signal(experiment)
    except TuningError:
        pass
    else:
        for i, axis in enumerate(AXES):
            if excites(name, signal[:, i], experiment.segments):
                found[axis] = name
    yaw = external_yaw_signal(experiment.yaw) if experiment.yaw else None
    return found | ({"yaw": yaw[1]} if yaw else {})


def _signal(name: str, signal: Series, stamps: NDArray[np.float64], limit: float) -> SignalReport:
    pauses = np.diff(stamps)
    pauses = pauses[pauses > 0]
    period = sampling_period(np.append(0, np.cumsum(pauses)))
    low, high = signal.values.min(axis=0), signal.values.max(axis=0)
    share = np.mean(np.abs(signal.values) >= 0.999 * limit, axis=0)
    return SignalReport(
        source=signal.topic,
        rate_hz=1 / period,
        held=held_samples(signal.values),
        gaps=int(np.count_nonzero(pauses > MAX_GAP * period * 1.001)),
        longest_gap_s=float(pauses.max()),
        minimum=tuple(low.tolist()),
        maximum=tuple(high.tolist()),
        saturated=tuple(share.tolist()) if name == "u" else None,
    )


def _excitation(signal: NDArray[np.float64], segments: tuple[tuple[int, int], ...], Ts: float) -> ExcitationReport:
    """RMS and band of one axis of the external signal in the segments of the experiment."""
    from scipy.signal import periodogram

    rows = [signal[a:b] for a, b in segments]
    used = np.concatenate(rows)
    longest = max(rows, key=len)
    frequency, power = periodogram(longest, 1 / Ts, detrend="constant")
    total = np.cumsum(power)
    if total[-1] <= 0:
        return ExcitationReport(float(np.std(used)), (0.0, 0.0))
    low, high = (float(frequency[np.searchsorted(total, share * total[-1])]) for share in BAND_POWER)
    return ExcitationReport(float(np.std(used)), (low, high))
