"""What every log reader returns: the signals as logged, before resampling."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mimopilot.tuning.errors import TuningError
from mimopilot.tuning.logs.columns import Columns
from mimopilot.tuning.logs.resample import REQUIRED, Interval, Series, monotone
from mimopilot.tuning.px4_names import AUTOTUNE_PREFIX

#: Damage of a log that ends too early.
INCOMPLETE = "the file ends inside a message: the download is incomplete or power was lost"

#: Largest plausible magnitude of a signal: torque (normalised), rad/s, rad. Gyros saturate at 35 rad/s (2000 deg/s).
#: y_o in degrees passes here, so that `check_angles` can name the wrong unit.
RANGES = {"u": 5.0, "u_bar": 5.0, "y_i": 100.0, "r_i": 100.0, "r_bar": 100.0, "y_o": 400.0, "r_o": 2 * np.pi}
#: rad, of the heading and its setpoint: they may have turned around often.
HEADING_RANGES = {"y_o": 400.0, "r_o": 400.0}
UNITS = dict.fromkeys(("u", "u_bar"), "a torque as a fraction of full torque")
UNITS |= dict.fromkeys(("y_i", "r_i", "r_bar"), "rad/s")
UNITS |= dict.fromkeys(("y_o", "r_o"), "rad")
MAX_LISTED = 100  # names in one message: a PX4 log at the default profile has fewer topics
#: Prefixes of parameters of PX4, ArduPilot and our module that change the loop: gains, filters, motors.
LOOP_PREFIXES = (
    "MIMO_",
    "MC_",
    "IMU_",
    "THR_",
    "CA_",
    "ATC_",
    "RATE_",
    "STB_",
    "INS_",
    "MOT_",
    "CC",
    "FILT",
    "Q_A_",
    "Q_M_",
)
#: Those among them that only configure an experiment: our injector, PX4's autotune.
EXPERIMENT_PREFIXES = ("MIMO_EX", AUTOTUNE_PREFIX)
MAX_OUTLIERS = 0.01  # fraction of samples out of range that damage explains; more means a wrong unit


@dataclass(frozen=True, eq=False)
class Recording:
    """The signals of one log, each with its own time stamps.

    Attributes
    ----------
    path : Path
        The log.
    format : str
        Its format and, if logged, the firmware.
    signals : mapping
        Name as in `tuning.experiment.Experiment` -> what was logged, in SI units.
    wanted : mapping
        Name -> where a log of this format holds the signal, for messages.
    contents : sequence of str
        Names of all topics, messages or columns in the log.
    advice : str
        What to change on the vehicle so that the signals are logged fast enough.
    airborne : tuple of (begin, end) or None, s
        When the vehicle flew. None: not logged.
    evidence : str
        Which topic or message says so.
    parameters : mapping
        Parameter name -> value when logging began.
    changes : sequence of (time s, name, value)
        Parameters set later, in order of time.
    faults : sequence of str
        Why gains cannot be tuned from the log, known to the reader.
    warnings : sequence of str
        What is wrong with a log that can still be used, such as damage.
    notes : sequence of str
        Remarks for `mimopilot inspect`.
    yaw : mapping
        The same as `signals` of the yaw axis, values (N, 1); headings may jump by 2 pi when given and do not after.
    commands : Series or None
        Motor commands, 0 to 1, one column per motor. None: not logged.
    published : mapping
        Name -> original time stamps (N,), s, of a signal whose stamps in `signals` are those of the control cycle.
    span : tuple (begin, end) or None, s
        First and last time in the log, for a log without signals. None: not known.
    columns : Columns or None
        Columns of a table. None: the log names its signals itself.
    beside : tuple of Path
        Further files of the same log, read with it.
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
    yaw: Mapping[str, Series] = field(default_factory=dict)
    commands: Series | None = None
    published: Mapping[str, NDArray[np.float64]] = field(default_factory=dict)
    span: Interval | None = None
    columns: Columns | None = None
    beside: tuple[Path, ...] = ()

    def __post_init__(self) -> None:
        signals, warnings = {}, [*self.warnings]
        for name, signal in self.signals.items():
            cleaned, dropped = _without_outliers(name, signal, str(self.path), RANGES[name])
            if len(cleaned.time) > 1:
                signals[name] = cleaned
            if dropped:
                warnings.append(
                    f"{signal.topic}: {dropped} samples of {name} are out of range or out of order and ignored"
                )
        yaw, faults = _clean_yaw(self.yaw, str(self.path))
        warnings += faults
        object.__setattr__(self, "yaw", yaw)
        object.__setattr__(self, "signals", signals)
        object.__setattr__(self, "warnings", tuple(warnings))

    def require_signals(self) -> None:
        """Check that the log is of a multirotor and holds torque, rates and angles.

        Raises
        ------
        TuningError
            With all faults at once: where a missing signal should be, what the log holds, what to change.
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
        """Parameter values at time `begin` (s), and the changes of loop parameters from then until `end` (s)."""
        values = dict(self.parameters)
        for time, name, value in self.changes:
            if time <= begin:
                values[name] = value
        now, changed = dict(values), []
        for time, name, value in self.changes:
            in_loop = name.startswith(LOOP_PREFIXES) and not name.startswith(EXPERIMENT_PREFIXES)
            if in_loop and begin < time <= end and now.get(name) != value:
                old = now.get(name, math.nan)
                changed.append(f"{name} from {old:.6g} to {value:.6g} after {time - begin:.1f} s")
                now[name] = value
        return values, changed


def listed(names: Sequence[str]) -> str:
    """Names for a message; the first `MAX_LISTED` of very many."""
    more = f" and {len(names) - MAX_LISTED} more" if len(names) > MAX_LISTED else ""
    return ", ".join(names[:MAX_LISTED]) + more or "nothing"


def _clean_yaw(signals: Mapping[str, Series], source: str) -> tuple[dict[str, Series], list[str]]:
    """Signals of yaw without outliers, headings without jumps of 2 pi; and what cannot be used."""
    kept, faults = {}, []
    for name, signal in signals.items():
        try:
            cleaned, _ = _without_outliers(name, signal, source, HEADING_RANGES.get(name, RANGES[name]))
        except TuningError as error:
            faults.append(f"yaw is left out: {str(error).removeprefix(f'{source}: ')}")
            continue
        if len(cleaned.time) > 1:
            unwrapped = np.unwrap(cleaned.values, axis=0) if name in HEADING_RANGES else cleaned.values
            kept[name] = Series(cleaned.time, unwrapped, cleaned.topic)
    return kept, faults


def _without_outliers(name: str, signal: Series, source: str, largest: float) -> tuple[Series, int]:
    """The signal without samples that are not finite, out of range or out of order; and the count of the latter two."""
    given = np.isfinite(signal.time) & np.isfinite(signal.values).all(axis=1)
    time, values = signal.time[given], signal.values[given]
    in_range: NDArray[np.bool_] = np.abs(values).max(axis=1, initial=0) <= largest
    outliers = len(time) - int(np.count_nonzero(in_range))
    if outliers > MAX_OUTLIERS * len(time):
        raise TuningError(
            f"{source}: {signal.topic}: {100 * outliers / len(time):.0f} % of {name} are outside +-{largest:.3g}, "
            f"the largest is {np.abs(values).max():.4g}; expected {UNITS[name]}: correct the unit"
        )
    time, values = time[in_range], values[in_range]
    ordered = monotone(Series(time, values, signal.topic))
    repeated = int(np.count_nonzero(np.diff(time) == 0))
    return ordered, outliers + len(time) - repeated - len(ordered.time)
