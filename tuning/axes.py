"""The law of some of the axes of a vehicle as n x n matrices, and their signals as an experiment of n columns.

Estimation, certificate and design take any number n of axes. By convention one axis is yaw, two are roll and pitch, and
three are all. The law of roll and pitch is a `Gains` itself; that of yaw, and that of all three, is an `AxesLaw`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from mimopilot.tuning.errors import TuningError
from mimopilot.tuning.experiment import MOVES, SIGNALS, Experiment, excited_segments, external_signal, largest_move
from mimopilot.tuning.gains import Gains
from mimopilot.tuning.law_filters import Filters
from mimopilot.tuning.parameter_row import AXES
from mimopilot.tuning.parameters import MATRICES, YAW_GAINS

#: Rate of yaw above which a vehicle turns, rad/s, and least distance of a setpoint from the heading that follows it,
#: rad: at that rate a heading controller of 10 1/s lags by as much. A flight stack that is asked for a rate of yaw sets
#: the setpoint to the heading.
TURNS, COPIED = 0.1, 0.01

Matrix = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class AxesLaw:
    """The law of n axes, without its limits; names, units and meaning as in `tuning.gains.Gains`.

    Attributes
    ----------
    Kp_o, Kp_i, Ki_i, Kd_i, Kff_i, Kff_o, Kaff_i : (n, n) arrays
    filters : Filters
        Without an attitude model: yaw does not follow one, and what roll and pitch follow is outside of the loop.
    """

    Kp_o: Matrix
    Kp_i: Matrix
    Ki_i: Matrix
    Kd_i: Matrix
    Kff_i: Matrix
    Kff_o: Matrix
    Kaff_i: Matrix
    filters: Filters

    @property
    def Ts(self) -> float:  # noqa: N802
        """Control period, s."""
        return self.filters.Ts


#: The law of one, two or three axes.
Law = Gains | AxesLaw

#: s before and after an excitation of yaw: PX4's autotune pauses as long, and most of the response fades in it.
AROUND_S = 2.0


def axis_names(count: int) -> tuple[str, ...]:
    """Names of the axes of a law, a response or an experiment of `count` axes."""
    return AXES[2:] if count == 1 else AXES[:count]


def axes_slice(count: int) -> slice:
    """Those axes among roll, pitch and yaw."""
    return slice(2, 3) if count == 1 else slice(0, count)


def law_of(gains: Gains, count: int, yaw_unit: float = 1.0) -> Law:
    """The law of `count` axes of a set.

    Parameters
    ----------
    gains : Gains
    count : int
    yaw_unit : float
        Unit of the yaw torque, in normalised torques, as in `all_axes`.
    """
    if count == 2:
        return gains
    matrices = {}
    for name in MATRICES:
        scalar = getattr(gains.yaw, name) if name in YAW_GAINS else 0.0
        yaw = np.array([[scalar / yaw_unit if name.endswith("_i") else scalar]])
        matrices[name] = yaw if count == 1 else block_diag(getattr(gains, name), yaw)
    filters = replace(gains.filters, model_omega=0.0).on(axes_slice(count), yaw_unit)
    return AxesLaw(**matrices, filters=filters)


def flown_law(experiment: Experiment) -> Law | None:
    """The law that flew on the axes of an experiment; None: not known."""
    return None if experiment.flown is None else law_of(experiment.flown, experiment.u.shape[1])


def yaw_axis(experiment: Experiment) -> Experiment:
    """The signals of yaw alone, as columns.

    Raises
    ------
    TuningError
        When the log does not hold them.
    """
    yaw = experiment.yaw
    if yaw is None:
        raise TuningError(f"{experiment.source}: the log does not contain torque, rate and heading of yaw")
    signals = {name: getattr(yaw, name) for name in SIGNALS}
    columns = {name: None if signal is None else signal[:, None] for name, signal in signals.items()}
    return replace(
        experiment,
        **columns,  # type: ignore[arg-type]  # of the names in Experiment
        yaw=None,
        motors=None,
        amplitude=None,
        segments=yaw.segments,
    )


def excited_yaw(experiment: Experiment) -> tuple[Experiment, NDArray[np.float64]]:
    """The yaw axis in the stretches of a flight that excite it, and its external signal, (N, 1).

    Raises
    ------
    TuningError
        When the log does not hold its signals, or nothing external moves them.
    """
    axis = yaw_axis(experiment)
    try:
        signal, name = external_signal(axis)
    except TuningError:
        raise TuningError(
            "no torque and no rate setpoint is injected on yaw, and its heading setpoint does not move"
        ) from None
    if name == "r_o":
        _check_setpoint(axis)
    # The noise elsewhere is another: the vehicle's own, or what the excitation of roll and pitch causes. A stretch of a
    # few seconds has too coarse a spectrum without the time around it.
    around, found = round(AROUND_S / axis.Ts), []
    for begin, end in excited_segments(axis.segments, signal[:, 0]):
        start, stop = next(part for part in axis.segments if part[0] <= begin < part[1])
        found.append((max(start, begin - around), min(stop, end + around)))
    return replace(axis, segments=tuple(found)), signal


def _check_setpoint(axis: Experiment) -> None:
    """Refuse a heading setpoint that hardly moves, or that is the measured heading while a pilot turns the vehicle."""
    assert axis.r_o is not None
    used = np.concatenate([np.arange(start, stop) for start, stop in axis.segments])
    moved = largest_move(axis.r_o[:, 0], axis.segments)
    if moved < MOVES:
        raise TuningError(
            f"nothing is injected on yaw, and its heading setpoint moves by {np.degrees(moved):.1f} degrees only (at "
            f"least {np.degrees(MOVES):.0f})"
        )
    turning = used[np.abs(axis.y_i[used, 0]) > TURNS]
    if len(turning) and np.median(np.abs(axis.r_o - axis.y_o)[turning]) < COPIED:
        raise TuningError("nothing is injected on yaw, and while it turns its heading setpoint is the measured heading")


def all_axes(experiment: Experiment, yaw_unit: float = 1.0) -> Experiment:
    """The signals of all three axes, as columns.

    Parameters
    ----------
    experiment : Experiment
    yaw_unit : float
        Unit of the yaw torque, in normalised torques.

    Raises
    ------
    TuningError
        When the log does not hold those of yaw.
    """
    yaw, joined = yaw_axis(experiment), dict[str, Any]()
    for name in SIGNALS:
        two, one = getattr(experiment, name), getattr(yaw, name)
        unit = yaw_unit if name in ("u", "u_bar") else 1.0
        joined[name] = None if two is None or one is None else np.hstack([two, one / unit])
    return replace(experiment, **joined, yaw=None, motors=None, amplitude=None, segments=experiment.all_segments)
