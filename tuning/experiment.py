"""One recorded flight as uniformly sampled signals: the result of every log reader and of the simulation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from mimopilot.tuning.errors import TuningError
from mimopilot.tuning.gains import Gains
from mimopilot.tuning.motors import Motors

Signal = NDArray[np.float64]

#: Names of the signals of an experiment, and of those of its yaw axis.
SIGNALS = ("u", "y_i", "y_o", "u_bar", "r_bar", "r_o", "r_i")
#: rad, peak to peak: attitude setpoints of a hover move less; chosen, as an estimator's attitude wanders by 1 to 3 deg.
MOVES = np.radians(5.0)
#: External signal -> what it is.
EXTERNAL = {
    "u_bar": "injected torque (u_bar)",
    "r_bar": "injected rate setpoint (r_bar)",
    "r_o": "attitude setpoint of a pilot or an off-board computer (r_o)",
}
#: Share of the samples that are within the size of a flight's manoeuvres.
NEARLY_ALL = 0.999


@dataclass(frozen=True, eq=False)
class YawSignals:
    """Signals of the yaw axis, in the rows of the experiment that holds them.

    Attributes
    ----------
    segments : tuple of (start, stop)
        Stretches without a gap that tell about yaw, in samples, stop excluded: those in which yaw is excited, which
        roll's and pitch's segments leave out. All signals of the experiment are known there, too. Empty: those of the
        experiment.
    u : (N,) array
        Yaw torque (normalised) applied to the plant, after injection and saturation.
    y_i, y_o : (N,) arrays, rad/s, rad
        Measured yaw rate (body) and heading, without jumps of 2 pi.
    u_bar : (N,) array or None
        Injected excitation, part of u. None: not logged.
    r_bar : (N,) array or None, rad/s
        Excitation injected into the rate setpoint, part of r_i: PX4's own autotune. None: not logged.
    r_o, r_i : (N,) arrays or None, rad, rad/s
        Heading and yaw rate setpoints. None: not logged.
    """

    u: Signal
    y_i: Signal
    y_o: Signal
    u_bar: Signal | None = None
    r_bar: Signal | None = None
    r_o: Signal | None = None
    r_i: Signal | None = None
    segments: tuple[tuple[int, int], ...] = ()


@dataclass(frozen=True, eq=False)
class Experiment:
    """Signals of one flight, roll then pitch, in SI units; rows outside `segments` are not used.

    Attributes
    ----------
    Ts : float, s
        Sampling period.
    u : (N, 2) array
        Torque (normalised) applied to the plant, after injection and saturation.
    y_i, y_o : (N, 2) arrays, rad/s, rad
        Measured body rates and measured roll and pitch angle.
    u_bar : (N, 2) array or None
        Injected excitation, part of u. None: not logged.
    r_bar : (N, 2) array or None, rad/s
        Excitation injected into the rate setpoint, part of r_i: PX4's own autotune. None: not logged.
    r_o, r_i : (N, 2) arrays or None, rad, rad/s
        Attitude and rate setpoints. None: not logged.
    segments : tuple of (start, stop)
        Stretches without a gap, in samples, stop excluded.
    source, sha256 : str
        Name and hash of the log.
    flown : Gains or None
        The controller that flew. None: not logged.
    motors : Motors or None
        How the allocator drove the motors. None: not logged.
    warnings : tuple of str
        Defects of a usable log: damage, parameters that changed.
    amplitude : float or None, rad
        Size of the manoeuvres of the whole flight, also outside of the experiment. None: not known.
    yaw : YawSignals or None
        The same of the yaw axis. None: its torque, rate or heading is not logged.

    Raises
    ------
    TuningError
        When shapes differ, a segment is empty or out of range, or a sample in a segment is not finite.
    """

    Ts: float
    u: Signal
    y_i: Signal
    y_o: Signal
    u_bar: Signal | None = None
    r_bar: Signal | None = None
    r_o: Signal | None = None
    r_i: Signal | None = None
    segments: tuple[tuple[int, int], ...] = ()
    source: str = ""
    sha256: str = ""
    flown: Gains | None = None
    motors: Motors | None = None
    warnings: tuple[str, ...] = ()
    amplitude: float | None = None
    yaw: YawSignals | None = None

    def __post_init__(self) -> None:
        if not self.segments:
            object.__setattr__(self, "segments", ((0, len(self.u)),))
        yaw = self.yaw
        if yaw is not None and not yaw.segments:
            yaw = replace(yaw, segments=self.segments)
            object.__setattr__(self, "yaw", yaw)
        for name in SIGNALS:
            self._check(name, getattr(self, name), self.u.shape, self.segments)
            if yaw is not None:
                self._check(name, getattr(self, name), self.u.shape, yaw.segments)
                self._check(f"yaw.{name}", getattr(yaw, name), self.u.shape[:1], yaw.segments)

    def _check(
        self, name: str, signal: Signal | None, shape: tuple[int, ...], segments: tuple[tuple[int, int], ...]
    ) -> None:
        """Refuse a signal of another shape, or with a sample in a segment that is not finite."""
        if signal is None:
            return
        if signal.shape != shape or self.u.ndim != 2:
            raise TuningError(f"{self.source}: {name}: got shape {signal.shape}, expected {shape}")
        for start, stop in segments:
            if not 0 <= start < stop <= len(signal):
                raise TuningError(f"{self.source}: segment {start}..{stop}: expected a part of 0..{len(signal)}")
            finite = np.isfinite(signal[start:stop])
            bad = np.flatnonzero(~(finite if finite.ndim == 1 else finite.all(axis=1)))
            if len(bad):
                raise TuningError(
                    f"{self.source}: {name} is not finite at {len(bad)} samples, first at "
                    f"{(start + bad[0]) * self.Ts:.3f} s; cut that stretch out of the log"
                )

    @property
    def seconds(self) -> float:
        """Usable length of the flight, s."""
        return sum(stop - start for start, stop in self.segments) * self.Ts

    @property
    def all_segments(self) -> tuple[tuple[int, int], ...]:
        """Stretches without a gap that tell about roll and pitch, or about yaw, in samples, stop excluded."""
        joined: list[tuple[int, int]] = []
        for start, stop in sorted((*self.segments, *(self.yaw.segments if self.yaw else ()))):
            if joined and start <= joined[-1][1]:
                before = joined.pop()
                start, stop = before[0], max(stop, before[1])
            joined.append((start, stop))
        return tuple(joined)


def external_signal(experiment: Experiment) -> tuple[Signal, str]:
    """External signal, (N, n), and its name: injected torque, else injected rate setpoint, else attitude setpoint.

    Raises
    ------
    TuningError
        When neither is logged and varies.
    """
    for name in ("u_bar", "r_bar", "r_o"):
        signal = getattr(experiment, name)
        if signal is not None and any(np.ptp(signal[start:stop]) > 0 for start, stop in experiment.segments):
            return signal, name
    raise TuningError(
        f"{experiment.source}: no excitation: no injected torque or rate setpoint and no varying attitude setpoint is "
        "logged; fly an experiment with a torque injected on roll, then on pitch"
    )


def excited_segments(segments: Sequence[tuple[int, int]], signal: Signal) -> list[tuple[int, int]]:
    """The part of each segment from the first to the last sample at which an external signal (N,) is not zero.

    A signal that does not vary excites nothing.
    """
    found = []
    for start, stop in segments:
        part = signal[start:stop]
        moving = start + np.flatnonzero(part if np.ptp(part) > 0 else 0 * part)
        if len(moving):
            found.append((int(moving[0]), int(moving[-1]) + 1))
    return found


def largest_move(signal: Signal, segments: Sequence[tuple[int, int]]) -> float:
    """Largest change of an external signal (N,) within a segment, in its unit; 0 without segments."""
    return max((float(np.ptp(signal[start:stop])) for start, stop in segments), default=0.0)


def excites(name: str, signal: Signal, segments: Sequence[tuple[int, int]]) -> bool:
    """Whether an external signal (N,) of this name excites an axis: a setpoint counts when it moves by `MOVES`."""
    return largest_move(signal, segments) > (MOVES if name == "r_o" else 0.0)


def external_yaw_signal(yaw: YawSignals) -> tuple[Signal, str] | None:
    """External signal of yaw, (N,), and its name, chosen as in `external_signal`; None: yaw is not excited."""
    for name in EXTERNAL:
        signal = getattr(yaw, name)
        if signal is not None and excites(name, signal, yaw.segments):
            return signal, name
    return None


def manoeuvre_size(angles: Signal) -> float:
    """Size (rad) of the manoeuvres in angles (N, 2): their largest distance from the median, but for rare outliers."""
    return float(np.quantile(np.abs(angles - np.median(angles, axis=0)), NEARLY_ALL, axis=0).max())
