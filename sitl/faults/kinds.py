"""Faults of a flight: their kinds, sizes and times.

On the command line and in tables a fault is written KIND[:TARGET][=SIZE]@AT[+DURATION], with times in seconds from the
start of the flight. ``motor:3=0.7@1.2``: motor 3 gives 0.7 of its thrust from 1.2 s on. ``gyro-stuck:roll@1.2+0.1``:
the roll rate repeats its last value for 0.1 s. In a scenario file a fault is a ``[[fault]]`` table. `KINDS` lists all.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from mimopilot.common.toml import complaint
from mimopilot.sitl.errors import SitlError
from mimopilot.sitl.physics.airframe import Vector
from mimopilot.tuning.parameter_row import AXES

NOTATION = re.compile(r"([a-z-]+)(?::([^=@]+))?(?:=([^@]+))?@([^+]+)(?:\+(.+))?")
FOR_EVER = 1 << 62  # periods; more than any flight has
Place = Literal["plant", "link", "autopilot"]
Target = Literal["motor", "axis", "position", "matrix"]


@dataclass(frozen=True)
class Kind:
    """One kind of fault.

    Attributes
    ----------
    what : str
        Description, one line.
    place : str
        Where it happens: ``plant``, ``link`` (between plant and autopilot) or ``autopilot``.
    unit : str or None
        Unit of the size; None: it takes no size.
    smallest, largest : float
        Range of the size, both included.
    target : str or None
        Field of the fault that names what is affected; None: it takes no target.
    needs_target : bool
        False: without a target all are affected.
    lasts : bool
        False: it takes no duration.
    """

    what: str
    place: Place
    unit: str | None = None
    smallest: float = 0.0
    largest: float = 1.0
    target: Target | None = None
    needs_target: bool = False
    lasts: bool = True


KINDS: dict[str, Kind] = {
    "motor": Kind(
        "a motor gives this share of its thrust; 0: it stops", "plant", "share", target="motor", needs_target=True
    ),
    "battery": Kind(
        "thrust of all motors falls to this share, in a ramp as long as the duration, and stays there",
        "plant",
        "share",
    ),
    "mass": Kind(
        "a load is attached at x,y,z (m, FRD, from the reference point)",
        "plant",
        "kg",
        smallest=1e-3,
        largest=100.0,
        target="position",
        needs_target=True,
    ),
    "gyro-stuck": Kind("the measured rate repeats its last value", "plant", target="axis"),
    "gyro-bias": Kind("added to the measured rate", "plant", "rad/s", -100.0, 100.0, target="axis"),
    "gyro-noise": Kind("standard deviation of the measured rates, instead of the vehicle's", "plant", "rad/s", 0, 100),
    "gyro-nan": Kind("the measured rate is not a number", "plant", target="axis"),
    "delay": Kind("delay from each measurement to the motors, instead of the vehicle's; whole periods", "link", "s"),
    "jitter": Kind("each command is delayed by a random time from 0 to this; whole periods", "link", "s"),
    "loss": Kind("each measurement is lost with this probability", "link", "probability"),
    "duplicate": Kind("the autopilot runs twice on a measurement with this probability", "link", "probability"),
    "skip": Kind("the autopilot misses this number of consecutive ticks", "link", "ticks", 1, 1e6, lasts=False),
    "clock": Kind(
        "the clock is set back by this; the autopilot ignores measurements that are not newer", "link", "s", lasts=False
    ),
    "link": Kind("no measurement arrives; the motors hold their last command", "link"),
    "gain": Kind(
        "factor on the gains in the controller (one matrix, or all), as by a parameter write",
        "autopilot",
        "factor",
        -1e3,
        1e3,
        target="matrix",
    ),
    "stale": Kind("no setpoint arrives", "autopilot"),
}


class Fault(BaseModel):
    """One fault of a flight.

    Attributes
    ----------
    kind : str
        One of `KINDS`, which gives the unit and the range of the size.
    at : float, s
        Begin, from the start of the flight.
    duration : float, s, or None
        At least one control period; None: to the end of the flight.
    size : float or None
    motor : int, optional
        From 1.
    axis : str, optional
        ``roll``, ``pitch`` or ``yaw``.
    position : 3 numbers, m, optional
        FRD, from the airframe's reference point.
    matrix : str, optional
        ``Kp_o``, ``Kp_i``, ``Ki_i``, ``Kd_i``, ``Kff_i``, ``Kff_o`` or ``Kaff_i``.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    kind: str
    at: Annotated[float, Field(ge=0, le=1e6)]
    duration: Annotated[float | None, Field(gt=0, le=1e6)] = None
    size: Annotated[float | None, Field(allow_inf_nan=False)] = None
    motor: Annotated[int | None, Field(ge=1, le=16)] = None
    axis: Literal["roll", "pitch", "yaw"] | None = None
    position: Vector | None = None
    matrix: Literal["Kp_o", "Kp_i", "Ki_i", "Kd_i", "Kff_i", "Kff_o", "Kaff_i"] | None = None

    @model_validator(mode="after")
    def _fits_its_kind(self) -> Fault:
        if self.kind not in KINDS:
            raise ValueError(f"unknown kind {self.kind!r}, expected one of {', '.join(KINDS)}")
        kind = KINDS[self.kind]
        if kind.unit is None and self.size is not None:
            raise ValueError(f"{self.kind} takes no size, got {self.size:g}; leave it out")
        if kind.unit is not None and not (self.size is not None and kind.smallest <= self.size <= kind.largest):
            got = "none" if self.size is None else f"{self.size:g}"
            raise ValueError(f"size: got {got}, expected {kind.smallest:g} to {kind.largest:g} ({kind.unit})")
        for target in ("motor", "axis", "position", "matrix"):
            if getattr(self, target) is not None and target != kind.target:
                raise ValueError(f"{self.kind} takes no {target}; leave it out")
        if kind.needs_target and self.target is None:
            raise ValueError(f"{self.kind} needs a {kind.target}, got none")
        if not kind.lasts and self.duration is not None:
            raise ValueError(f"{self.kind} takes no duration: its size gives how long it lasts")
        return self

    @property
    def place(self) -> Place:
        """Where it happens, see `Kind`."""
        return KINDS[self.kind].place

    @property
    def target(self) -> Any:
        """Value of the field that names what is affected; None: all, or the kind takes no target."""
        target = KINDS[self.kind].target
        return getattr(self, target) if target else None

    @property
    def magnitude(self) -> float:
        """The size; 0 for a kind that has none."""
        return 0.0 if self.size is None else self.size

    @property
    def motors(self) -> list[int]:
        """Indices of the affected motors."""
        return [] if self.motor is None else [self.motor - 1]

    @property
    def axes(self) -> list[int]:
        """Indices of the affected axes."""
        return [0, 1, 2] if self.axis is None else [AXES.index(self.axis)]

    def span(self, Ts: float) -> tuple[int, int]:
        """First control period (of `Ts` s) in which it acts, and the first after it."""
        begin = periods(self.at, Ts)
        if self.kind == "skip":
            return begin, begin + round(self.magnitude)
        if self.kind == "clock":
            return begin, begin + periods(self.magnitude, Ts)
        if self.duration is None or self.kind == "battery":
            return begin, FOR_EVER
        return begin, begin + max(1, periods(self.duration, Ts))

    def __str__(self) -> str:
        """As it is written on the command line."""
        target = self.target
        if isinstance(target, tuple):
            target = ",".join(map(_number, target))
        return (
            self.kind
            + ("" if target is None else f":{target}")
            + ("" if self.size is None else f"={_number(self.size)}")
            + f"@{_number(self.at)}"
            + ("" if self.duration is None else f"+{_number(self.duration)}")
        )


def periods(seconds: float, Ts: float) -> int:
    """Number of whole control periods (of `Ts` s) nearest to a time."""
    return round(seconds / Ts)


def _number(value: float) -> str:
    """Shortest text that reads back as the same number."""
    return repr(float(value)).removesuffix(".0").replace("e+", "e")


def make_fault(table: dict[str, Any], where: str) -> Fault:
    """Make a fault from the fields of a table.

    Parameters
    ----------
    table : dict
        Fields of `Fault`.
    where : str
        Begin of the error message.

    Raises
    ------
    SitlError
        When a field is missing, unknown or wrong.
    """
    try:
        return Fault.model_validate(table)
    except ValidationError as error:
        raise SitlError(f"{where}: {complaint(error, Fault)}") from error


def parse_fault(text: str) -> Fault:
    """Parse a fault written KIND[:TARGET][=SIZE]@AT[+DURATION].

    Raises
    ------
    SitlError
        When the text is not of this form, or a field is wrong.
    """
    where = f"fault {text!r}"
    match = NOTATION.fullmatch(text.strip())
    if match is None:
        raise SitlError(f"{where}: expected KIND[:TARGET][=SIZE]@AT[+DURATION], times in s, such as motor:3=0.7@1.2")
    kind, target, size, at, duration = match.groups()
    table: dict[str, Any] = {"kind": kind, "at": at}
    table |= {name: value for name, value in (("size", size), ("duration", duration)) if value is not None}
    if target is not None:
        field = KINDS[kind].target if kind in KINDS else None
        if kind in KINDS and field is None:
            raise SitlError(f"{where}: {kind} takes no target, got {target!r}; leave it out")
        if field is not None:
            table[field] = target.split(",") if field == "position" else target
    return make_fault(table, where)


def parse_faults(texts: Iterable[str], allowed: tuple[Place, ...], who: str) -> tuple[Fault, ...]:
    """Parse faults from the command line, for a program that can apply only some.

    Parameters
    ----------
    texts : iterable of str
        See `parse_fault`.
    allowed : tuple of str
        Places in which it can apply faults.
    who : str
        Name of the program, for the message.

    Raises
    ------
    SitlError
        When a fault is wrong, or happens in another place.
    """
    faults = tuple(map(parse_fault, texts))
    for fault in faults:
        if fault.place not in allowed:
            raise SitlError(f"fault {str(fault)!r}: acts on the {fault.place}, which is not part of {who}")
    return faults


def fault_help() -> str:
    """Help text of the command line: one line for each kind."""
    lines = ["KIND[:TARGET][=SIZE]@AT[+DURATION], times in s. Without a duration, to the end of the flight."]
    return "\n".join([*lines, *(_kind_help(name, kind) for name, kind in KINDS.items())])


def _kind_help(name: str, kind: Kind) -> str:
    target = f":{kind.target.upper()}" if kind.target else ""
    if not kind.needs_target:
        target = target and f"[{target}]"
    size = "" if kind.unit is None else "=SIZE"
    unit = "" if kind.unit is None else f" [{kind.unit}, {kind.smallest:g} to {kind.largest:g}]"
    return f"{name}{target}{size}: {kind.what}{unit}"
