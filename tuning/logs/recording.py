"""What every log reader returns: the signals as logged, before they are brought to one grid."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tuning.errors import TuningError
from tuning.logs.resample import REQUIRED, Interval, Series, monotone

#: Largest believable value of a signal: normalised moment, rad/s, rad.
RANGES = {"u": 5.0, "u_bar": 5.0, "y_i": 100.0, "r_i": 100.0, "y_o": 2 * np.pi, "r_o": 2 * np.pi}
MAX_WILD = 0.01  # share of a signal that may lie outside its range: damage; more is a wrong unit


@dataclass(frozen=True, eq=False)
class Recording:
    """The signals of one log, each with its own time stamps.

    Attributes
    ----------
    path : Path
        The log.
    format : str
        Its kind and, where it says so, the firmware.
    signals : mapping
        Name as in `tuning.experiment.Experiment` -> what was logged, in SI units.
    wanted : mapping
        Name -> where a log of this format holds that signal, for messages.
    contents : sequence of str
        Names of all topics, messages or columns in the log.
    advice : str
        What to change on the vehicle so that signals are logged, and fast enough.
    airborne : tuple of (begin, end) or None, s
        When the vehicle flew. None: the log does not say.
    evidence : str
        What says so.
    parameters : mapping
        The vehicle's parameters, by name.
    notes : sequence of str
        What the reader of an inspection should know besides.
    commands : Series or None
        Motor commands as thrust fractions, a column each. None: the log does not hold them.
    """

    path: Path
    format: str
    signals: Mapping[str, Series]
    wanted: Mapping[str, str]
    contents: Sequence[str]
    advice: str
    airborne: tuple[Interval, ...] | None = None
    evidence: str = ""
    parameters: Mapping[str, float] = field(default_factory=dict)
    notes: Sequence[str] = ()
    commands: Series | None = None

    def __post_init__(self) -> None:
        cleaned = {name: _believable(name, signal, str(self.path)) for name, signal in self.signals.items()}
        object.__setattr__(self, "signals", {name: signal for name, signal in cleaned.items() if len(signal.time) > 1})

    def require_signals(self) -> None:
        """Refuse a log without torque, rates or angles.

        Raises
        ------
        TuningError
            Naming where the missing signal should be, what the log holds instead and what to change.
        """
        missing = [name for name in REQUIRED if name not in self.signals]
        if missing:
            raise TuningError(
                f"{self.path}: lacks {'; '.join(self.wanted[name] for name in missing)}; {self.advice}. "
                f"In this log: {', '.join(self.contents) or 'nothing'}"
            )


def _believable(name: str, signal: Series, source: str) -> Series:
    """The signal without samples that are not finite, wild or out of order."""
    given = np.isfinite(signal.time) & np.isfinite(signal.values).all(axis=1)
    time, values = signal.time[given], signal.values[given]
    tame: NDArray[np.bool_] = np.abs(values).max(axis=1, initial=0) <= RANGES[name]
    wild = len(time) - int(np.count_nonzero(tame))
    if wild > MAX_WILD * len(time):
        raise TuningError(
            f"{source}: {signal.topic}: {100 * wild / len(time):.0f} % of {name} lie outside +-{RANGES[name]:.3g}, "
            f"the largest is {np.abs(values).max():.4g}; expected a normalised moment, rad/s and rad: correct the unit"
        )
    return monotone(Series(time[tame], values[tame], signal.topic))
