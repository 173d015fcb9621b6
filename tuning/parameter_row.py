"""A row of the parameter table: what it holds, its valid values, and the parameters that it makes."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from enum import Enum

#: Prefix of every parameter's name.
PREFIX = "MIMO_"
AXES = ("roll", "pitch", "yaw")
#: The axes that the matrices couple.
ROLL_PITCH = AXES[:2]
AXIS_LETTERS = "RPY"
AXIS_NAMES = dict(zip(AXIS_LETTERS, AXES, strict=True))


def pole_of(cutoff_hz: float, Ts: float) -> float:
    """Pole of a first-order filter, exp(-2 pi f Ts), 0 when f = 0.

    Parameters
    ----------
    cutoff_hz : float, Hz
    Ts : float, s
    """
    return math.exp(-2 * math.pi * cutoff_hz * Ts) if cutoff_hz > 0 else 0.0


def cutoff_of(pole: float, Ts: float) -> float:
    """Cutoff of a first-order filter, Hz; inverse of `pole_of`; 0 when the pole is 0."""
    return -math.log(pole) / (2 * math.pi * Ts) if pole > 0 else 0.0


class Shape(Enum):
    """Shape of a row's value."""

    MATRIX = "2x2 matrix, roll and pitch"
    YAW = "scalar of the yaw axis"
    AXES = "one value per axis: roll, pitch, yaw"
    POLE = "pole of a first-order filter; the gains file has its cutoff in Hz"
    SCALAR = "one value"


@dataclass(frozen=True)
class Valid:
    """Values that the controller can run with; a vehicle's range may be narrower.

    Attributes
    ----------
    lowest, highest : float
        Bounds; infinite for none.
    lowest_included, highest_included : bool
        Whether the bound itself is valid.
    """

    lowest: float = -math.inf
    highest: float = math.inf
    lowest_included: bool = True
    highest_included: bool = True

    def holds(self, value: float) -> bool:
        """Whether a value is finite and within the bounds."""
        above = value >= self.lowest if self.lowest_included else value > self.lowest
        below = value <= self.highest if self.highest_included else value < self.highest
        return math.isfinite(value) and above and below

    def __str__(self) -> str:
        low = f"{'at least' if self.lowest_included else 'more than'} {self.lowest:g}"
        high = f"{'at most' if self.highest_included else 'below'} {self.highest:g}"
        parts = [text for text, bound in ((low, self.lowest), (high, self.highest)) if math.isfinite(bound)]
        return " and ".join(parts) or "a finite number"


ANY = Valid()
POSITIVE = Valid(lowest=0.0, lowest_included=False)
NOT_NEGATIVE = Valid(lowest=0.0)
STABLE_POLE = Valid(0.0, 1.0, highest_included=False)
#: Control period, s: 1 Hz to 10 kHz.
PERIOD = Valid(1e-4, 1.0)


@dataclass(frozen=True)
class Row:
    """One member of the controller's gains.

    Attributes
    ----------
    key : str
        Name in the gains file and in Python.
    member : str
        Name in C++.
    code : str
        Short name; with prefix and axes it makes a parameter name.
    shape : Shape
    unit : str
        PX4's spelling; empty if PX4 has none.
    minimum, maximum : float
        Range that a vehicle accepts, inclusive.
    description : str
        Description of the parameter.
    comment : str
        Comment of the C++ member; empty: none.
    diagonal_minimum : float or None
        Lower limit of a matrix' diagonal, if it differs from `minimum`.
    default : float or None
        Value if a gains file lacks the key; None: the key is required. A gain has one only if it belongs to an option,
        and only while that is off.
    option : str
        Key of the row that switches on the option to which this row belongs, 0: off; empty: to none. While the option
        is off, a gains file leaves out the row if it has its default.
    writable : bool
        False for values that are fixed in the firmware and published only to be checked.
    valid : Valid
    largest_in_period : float
        Largest product of the value and the control period; infinite: not limited.
    """

    key: str
    member: str
    code: str
    shape: Shape
    unit: str
    minimum: float
    maximum: float
    description: str
    comment: str = ""
    diagonal_minimum: float | None = None
    default: float | None = None
    option: str = ""
    writable: bool = True
    valid: Valid = ANY
    largest_in_period: float = math.inf

    @property
    def section(self) -> str:
        """The gains file's table with the key; empty: top level."""
        return {Shape.MATRIX: "roll_pitch", Shape.YAW: "yaw", Shape.AXES: "limits"}.get(self.shape, "")

    @property
    def codes(self) -> tuple[str, ...]:
        """Codes of the elements, in the order of the C++ member."""
        if self.shape is Shape.MATRIX:
            return tuple(f"{self.code}_{i}{j}" for i in "RP" for j in "RP")
        if self.shape is Shape.YAW:
            return (f"{self.code}_YY",)
        if self.shape is Shape.AXES:
            return tuple(f"{self.code}_{axis}" for axis in AXIS_LETTERS)
        return (self.code,)

    @property
    def dimensions(self) -> str:
        """Array dimensions of the C++ member."""
        return {Shape.MATRIX: "[2][2]", Shape.AXES: "[3]"}.get(self.shape, "")

    def element(self, value: float, Ts: float) -> float:
        """Value in the controller, from the value in the gains file."""
        return pole_of(value, Ts) if self.shape is Shape.POLE else value

    def value(self, element: float, Ts: float) -> float:
        """Inverse of `element`."""
        return cutoff_of(element, Ts) if self.shape is Shape.POLE else element

    def parameters(self) -> Iterator[Parameter]:
        """One parameter for each element."""
        for code in self.codes:
            axes = code.removeprefix(self.code).removeprefix("_")
            what, minimum = self.description, self.minimum
            if self.shape in (Shape.MATRIX, Shape.YAW):
                output, error = axes[0], axes[1]
                where = AXIS_NAMES[output] if output == error else f"{AXIS_NAMES[output]} from {AXIS_NAMES[error]}"
                what = f"{self.key}: {what}, {where}"
                if output == error and self.diagonal_minimum is not None:
                    minimum = self.diagonal_minimum
            elif axes:
                what = f"{what}, {AXIS_NAMES[axes]}"
            yield Parameter(
                name=PREFIX + code,
                code=code,
                unit=self.unit,
                minimum=minimum,
                maximum=self.maximum,
                writable=self.writable,
                description=what,
            )


@dataclass(frozen=True)
class Parameter:
    """One scalar of the controller, as a vehicle publishes it.

    Attributes
    ----------
    name : str
        At most 16 characters: ``MIMO_<loop and term>_<output><error>``.
    code : str
        The element's code in `tuning.gains.Gains.elements`.
    unit : str
        PX4's spelling; empty if PX4 has none.
    minimum, maximum : float
        Range that a vehicle accepts, inclusive.
    writable : bool
        False for values that are fixed in the firmware and published only to be checked.
    description : str
        One line.
    """

    name: str
    code: str
    unit: str
    minimum: float
    maximum: float
    writable: bool
    description: str
