"""What every log reader returns: the signals as logged, before they are brought to one grid."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from mimopilot.tuning.errors import TuningError
from mimopilot.tuning.logs.columns import Columns
from mimopilot.tuning.logs.resample import REQUIRED, Interval, Series, monotone
from numpy.typing import NDArray

#: Largest believable value of a signal: normalised moment, rad/s, rad.
RANGES = {"u": 5.0, "u_bar": 5.0, "y_i": 100.0, "r_i": 100.0, "y_o": 400.0, "r_o": 2 * np.pi}
UNITS = dict.fromkeys(("u", "u_bar"), "a moment as a share of the full one") | dict.fromkeys(("y_i", "r_i"), "rad/s")
UNITS |= dict.fromkeys(("y_o", "r_o"), "rad")
MAX_LISTED = 100  # names in a message: more than the topics of a PX4 log at its default profile
#: Beginnings of the names of parameters of PX4, ArduPilot and our module that make the loop: gains, filters, motors.
LOOP = ("MIMO_", "MC_", "IMU_", "THR_", "CA_", "ATC_", "RATE_", "STB_", "INS_", "MOT_", "CC", "FILT", "Q_A_", "Q_M_")
#: Those among them that steer an experiment and nothing else: our injector, PX4's autotune.
EXPERIMENT = ("MIMO_EX", "MC_AT_")
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
        The vehicle's parameters when logging began, by name.
    changes : sequence of (time s, name, value)
        Parameters that were set later, by time.
    faults : sequence of str
        Why no gains can be tuned from the log, as far as reading it shows.
    warnings : sequence of str
        What is wrong with the log although it can be used, such as damage.
    notes : sequence of str
        What the reader of an inspection should know besides.
    commands : Series or None
        Motor commands, 0 to 1, a column each. None: the log does not hold them.
    linear_thrust : bool
        Whether they are thrust fractions.
    published : mapping
        Name -> stamps (N,), s, with which a signal was logged, where those of `signals` are of the control cycle.
    span : tuple (begin, end) or None, s
        First and last time in the log, for one without signals. None: not known.
    columns : Columns or None
        Where the signals of a table are. None: the log names its signals itself.
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
    changes: Sequence[tuple[float, str, float]] = ()
    faults: Sequence[str] = ()
    warnings: Sequence[str] = ()
    notes: Sequence[str] = ()
    commands: Series | None = None
    linear_thrust: bool = True
    published: Mapping[str, NDArray[np.float64]] = field(default_factory=dict)
    span: Interval | None = None
    columns: Columns | None = None

    def __post_init__(self) -> None:
        signals, warnings = {}, [*self.warnings]
        for name, signal in self.signals.items():
            cleaned, dropped = _believable(name, signal, str(self.path))
            if len(cleaned.time) > 1:
                signals[name] = cleaned
            if dropped:
                warnings.append(f"{signal.topic}: {dropped} samples of {name} are out of range or order and left out")
        object.__setattr__(self, "signals", signals)
        object.__setattr__(self, "warnings", tuple(warnings))

    def require_signals(self) -> None:
        """Refuse a log of another vehicle, without torque, rates or angles, or with an impossible time.

        Raises
        ------
        TuningError
            All that is wrong at once: where a missing signal should be, what the log holds instead, what to change.
        """
        wrong = [*self.faults]
        missing = [name for name in REQUIRED if name not in self.signals]
        if missing:
            wrong.append(
                f"lacks {'; '.join(self.wanted[name] for name in missing)}; {self.advice}. "
                f"In this log: {listed(self.contents)}"
            )
        if wrong:
            raise TuningError(f"{self.path}: {'; '.join(wrong)}")

    def parameters_during(self, begin: float, end: float) -> tuple[dict[str, float], list[str]]:
        """The parameters in force when a part of the log (s) begins, and what of the loop changed before its end."""
        values = dict(self.parameters)
        for time, name, value in self.changes:
            if time <= begin:
                values[name] = value
        now, changed = dict(values), []
        for time, name, value in self.changes:
            ours = name.startswith(LOOP) and not name.startswith(EXPERIMENT)
            if ours and begin < time <= end and now.get(name) != value:
                old = now.get(name, math.nan)
                changed.append(f"{name} from {old:.6g} to {value:.6g} after {time - begin:.1f} s")
                now[name] = value
        return values, changed


def listed(names: Sequence[str]) -> str:
    """Names for a message, the first of very many."""
    more = f" and {len(names) - MAX_LISTED} more" if len(names) > MAX_LISTED else ""
    return ", ".join(names[:MAX_LISTED]) + more or "nothing"


def _believable(name: str, signal: Series, source: str) -> tuple[Series, int]:
    """The signal without samples that are not finite, wild or out of order, and how many of the latter two."""
    given = np.isfinite(signal.time) & np.isfinite(signal.values).all(axis=1)
    time, values = signal.time[given], signal.values[given]
    tame: NDArray[np.bool_] = np.abs(values).max(axis=1, initial=0) <= RANGES[name]
    wild = len(time) - int(np.count_nonzero(tame))
    if wild > MAX_WILD * len(time):
        raise TuningError(
            f"{source}: {signal.topic}: {100 * wild / len(time):.0f} % of {name} lie outside +-{RANGES[name]:.3g}, "
            f"the largest is {np.abs(values).max():.4g}; expected {UNITS[name]}: correct the unit"
        )
    time, values = time[tame], values[tame]
    ordered = monotone(Series(time, values, signal.topic))
    repeated = int(np.count_nonzero(np.diff(time) == 0))
    return ordered, wild + len(time) - repeated - len(ordered.time)
