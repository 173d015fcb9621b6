"""What a control law is made of, and the terms of ours.

Each term is a gain matrix, the signal that it acts on and a chain of first-order filters. `tuning.law` derives every
response from the table of the set's law, see `tuning.control_laws`, so all of tuning holds for each of them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

from mimopilot.tuning.first_order_filter import Chain, Filter
from mimopilot.tuning.law_filters import Filters
from mimopilot.tuning.parameters import MODEL, SLEW

#: Signals of the rate controller that a term can act on.
ERROR, RATE, SETPOINT = "error", "rate", "setpoint"
#: Signals of the attitude model that a term can act on: outside of the loop.
MODEL_RATE, MODEL_ACCELERATION = "model rate", "model acceleration"


@dataclass(frozen=True)
class Term:
    """One term of the rate controller.

    Attributes
    ----------
    matrix : str
        Name of its gain matrix in `tuning.gains.Gains`, or of a fixed gain in `StockFilters`.
    signal : str
        Signal that it acts on: `ERROR`, `RATE`, `SETPOINT`, `MODEL_RATE` or `MODEL_ACCELERATION`.
    sign : int
        Sign with which it is added to u.
    filter : callable
        `Filters` -> its filters, the first one first; empty: none.
    """

    matrix: str
    signal: str
    sign: int = 1
    filter: Callable[[Filters], Chain] = lambda filters: ()


@dataclass(frozen=True)
class ControlLaw:
    """One control law.

    Attributes
    ----------
    terms : mapping
        Letter -> term of the rate loop, in the order of its regressors and its sums.
    text : tuple of str
        The law in the comments of a gains file.
    coupled : bool
        Whether it has off-diagonal gains.
    setpoint : callable
        `Filters` -> filters of the rate setpoint, before every term.
    delay : int
        Periods after which a rate setpoint of the attitude controller acts.
    filters : tuple of str
        What it has of `STOCK_FILTERS`.
    lacks : tuple of str
        Keys of the parameter table that it does not have.
    largest : mapping
        Gain -> largest value that the autopilot accepts: roll, pitch, yaw. None: the ranges of our parameter table.
    step : mapping
        Gain -> value of 1 on an autopilot whose gains are whole numbers; empty: they are not.
    shared : tuple of str
        Gains that are one number for roll and pitch.
    """

    terms: Mapping[str, Term]
    text: tuple[str, ...]
    coupled: bool = False
    setpoint: Callable[[Filters], Chain] = lambda filters: ()
    delay: int = 1
    filters: tuple[str, ...] = ()
    lacks: tuple[str, ...] = field(default=("derivative_cutoff_hz", "Kff_o", "Kaff_i", SLEW, "model_damping", MODEL))
    largest: Mapping[str, tuple[float, float, float]] | None = None
    step: Mapping[str, float] = field(default_factory=dict)
    shared: tuple[str, ...] = ()


def integral(filters: Filters) -> Chain:
    """The filter of an integral term."""
    return (Filter(gain=filters.Ts, pole=1.0),)


def _derivative(filters: Filters) -> Chain:
    a = filters.derivative_pole
    return (Filter(gain=1 - a, pole=a, difference=True, divisor=filters.Ts),)


#: Letter -> term of our law.
TERMS = {
    "P": Term("Kp_i", ERROR),
    "I": Term("Ki_i", ERROR, filter=integral),
    "D": Term("Kd_i", RATE, -1, _derivative),
    "F": Term("Kff_i", SETPOINT),
    "A": Term("Kaff_i", MODEL_ACCELERATION),
}
#: Those on signals of the rate loop. Tuning estimates them; the others do not change its stability. Every law has gains
#: of these letters and names.
LOOP_TERMS = {letter: term for letter, term in TERMS.items() if term.signal in (ERROR, RATE, SETPOINT)}
#: The attitude controller, which makes the rate setpoint; its error is that of the angles.
ATTITUDE = Term("Kp_o", ERROR)
#: Its feed-forward from the attitude model.
ATTITUDE_FEEDFORWARD = Term("Kff_o", MODEL_RATE)
