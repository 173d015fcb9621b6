"""Faults: what can go wrong in a flight, with its size and time.

On the command line and in tables a fault is written KIND[:TARGET][=SIZE]@AT[+DURATION], times in seconds from the
start of the flight: ``motor:3=0.7@1.2`` is motor 3 with 0.7 of its thrust from 1.2 s on, ``gyro-stuck:roll@1.2+0.1``
a roll rate that repeats its last value for 0.1 s. In a scenario file it is a ``[[fault]]`` table. `KINDS` lists all.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Annotated, Any, Literal

from mimopilot.sitl.errors import SitlError
from mimopilot.sitl.physics.airframe import Vector
from mimopilot.tuning.parameters import AXES
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from mimopilot.common.toml import complaint

NOTATION = re.compile(r"([a-z-]+)(?::([^=@]+))?(?:=([^@]+))?@([^+]+)(?:\+(.+))?")
FOR_EVER = 1 << 62  # periods
Place = Literal["plant", "link", "autopilot"]
Target = Literal["motor", "axis", "position", "matrix"]


@dataclass(frozen=True)
class Kind:
    """One kind of fault.

    Attributes
    ----------
    what : str
        One line.
    place : str
        What it happens to: ``plant``, ``link`` (between plant and autopilot) or ``autopilot``.
    unit : str or None
        Of the size; None: it has none.
    smallest, largest : float
        Range of the size, both included.
    target : str or None
        Which of the fault's fields says what is hit.
    needs_target : bool
        False: without a target all are hit.
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
        "a motor gives this share of its thrust; 0: it is out", "plant", "share", target="motor", needs_target=True
    ),
    "battery": Kind(
        "all motors sag to this share of their thrust, in a ramp as long as the duration, and stay there",
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
    "gyro-noise": Kind("standard deviation of the measured rates, in place of the vehicle's", "plant", "rad/s", 0, 100),
    "gyro-nan": Kind("the measured rate is not a number", "plant", target="axis"),
    "delay": Kind("from each measurement to the motors, in place of the vehicle's own; whole periods", "link", "s"),
    "jitter": Kind("each command is late by a random time of 0 to this; whole periods", "link", "s"),
    "loss": Kind("each measurement is lost with this probability", "link", "probability"),
    "duplicate": Kind("with this probability the autopilot runs twice on a measurement", "link", "probability"),
    "skip": Kind("the autopilot misses so many ticks in a row", "link", "ticks", 1, 1e6, lasts=False),
    "clock": Kind(
        "the clock goes back by this; the autopilot takes nothing that is not newer", "link", "s", lasts=False
    ),
    "link": Kind("no measurement arrives, the motors hold their last command", "link"),
    "gain": Kind(
        "factor on the running gains (one matrix, or all), as a parameter write",
        "autopilot",
        "factor",
        -1e3,
        1e3,
        target="matrix",
    ),
    "stale": Kind("no set-point arrives", "autopilot"),
}


class Fault(BaseModel):
    """One fault of a flight.

    Attributes
    ----------
    kind : str
        One of `KINDS`, which says the unit and the range of the size.
    at : float, s
        When it begins, from the start of the flight.
    duration : float, s, or None
        How long it lasts; None: to the end of the flight. At least one control period.
    size : float or None
    motor : int, optional
        From 1.
    axis : str, optional
        ``roll``, ``pitch`` or ``yaw``.
    position : 3 numbers, m, optional
        FRD, from the airframe's reference point.
    matrix : str, optional
        ``Kp_o``, ``Kp_i``, ``Ki_i``, ``Kd_i`` or ``Kff_i``.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    kind: str
    at: Annotated[float, Field(ge=0, le=1e6)]
    duration: Annotated[float | None, Field(gt=0, le=1e6)] = None
    size: Annotated[float | None, Field(allow_inf_nan=False)] = None
    motor: Annotated[int | None, Field(ge=1, le=16)] = None
    axis: Literal["roll", "pitch", "yaw"] | None = None
    position: Vector | None = None
    matrix: Literal["Kp_o", "Kp_i", "Ki_i", "Kd_i", "Kff_i"] | None = None

    @model_validator(mode="after")
    def _fits_its_kind(self) -> Fault:
        if self.kind not in KINDS:
            raise ValueError(f"unknown kind {self.kind!r}, expected one of {', '.join(KINDS)}")
        kind = KINDS[self.kind]
        if kind.unit is None and self.size is not None:
            raise ValueError(f"{self.kind} takes no size, got {self.size:g}")
        if kind.unit is not None and not (self.size is not None and kind.smallest <= self.size <= kind.largest):
            got = "none" if self.size is None else f"{self.size:g}"
            raise ValueError(f"size: got {got}, expected {kind.smallest:g} to {kind.largest:g} ({kind.unit})")
        for target in ("motor", "axis", "position", "matrix"):
            if getattr(self, target) is not None and target != kind.target:
                raise ValueError(f"{self.kind} takes no {target}")
        if kind.needs_target and self.target is None:
            raise ValueError(f"{self.kind} does not say which {kind.target}")
        if not kind.lasts and self.duration is not None:
            raise ValueError(f"{self.kind} takes no duration: its size says how long it lasts")
        return self

    @property
    def place(self) -> Place:
        """What it happens to, see `Kind`."""
        return KINDS[self.kind].place

    @property
    def target(self) -> Any:
        """The field that says what is hit; None: everything, or nothing to choose."""
        target = KINDS[self.kind].target
        return getattr(self, target) if target else None

    @property
    def magnitude(self) -> float:
        """The size; 0 for a kind that has none."""
        return 0.0 if self.size is None else self.size

    @property
    def motors(self) -> list[int]:
        """Indices of the motors that are hit."""
        return [] if self.motor is None else [self.motor - 1]

    @property
    def axes(self) -> list[int]:
        """Indices of the axes that are hit."""
        return [0, 1, 2] if self.axis is None else [AXES.index(self.axis)]

    def span(self, Ts: float) -> tuple[int, int]:
        """First control period, of `Ts` s, in which it acts, and the first after it."""
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
    """Whole control periods of `Ts` s that come nearest to a time."""
    return round(seconds / Ts)


def _number(value: float) -> str:
    """The shortest text that reads back as the same number."""
    return repr(float(value)).removesuffix(".0").replace("e+", "e")


def make_fault(table: dict[str, Any], where: str) -> Fault:
    """A fault from the fields of a table.

    Parameters
    ----------
    table : dict
        Fields of `Fault`.
    where : str
        What the message begins with.

    Raises
    ------
    SitlError
        When a field is missing, unknown or wrong.
    """
    try:
        return Fault.model_validate(table)
    except ValidationError as error:
        raise SitlError(f"{where}: {complaint(error)}") from error


def parse_fault(text: str) -> Fault:
    """A fault from KIND[:TARGET][=SIZE]@AT[+DURATION].

    Raises
    ------
    SitlError
        When the text is not of this form, or says something impossible.
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
            raise SitlError(f"{where}: {kind} takes no target, got {target!r}")
        if field is not None:
            table[field] = target.split(",") if field == "position" else target
    return make_fault(table, where)


def parse_faults(texts: Iterable[str], allowed: tuple[Place, ...], who: str) -> tuple[Fault, ...]:
    """Faults from the command line, for a program that can apply only some.

    Parameters
    ----------
    texts : iterable of str
        See `parse_fault`.
    allowed : tuple of str
        Places that are within its reach.
    who : str
        The program, for the message.

    Raises
    ------
    SitlError
        Also when one happens elsewhere.
    """
    faults = tuple(map(parse_fault, texts))
    for fault in faults:
        if fault.place not in allowed:
            raise SitlError(f"fault {str(fault)!r}: happens in the {fault.place}, which {who} does not hold")
    return faults


def fault_help() -> str:
    """What the command line says of all kinds, one line each."""
    lines = ["KIND[:TARGET][=SIZE]@AT[+DURATION], times in s; without a duration it lasts to the end of the flight."]
    return "\n".join([*lines, *(_kind_help(name, kind) for name, kind in KINDS.items())])


def _kind_help(name: str, kind: Kind) -> str:
    target = f":{kind.target.upper()}" if kind.target else ""
    if not kind.needs_target:
        target = target and f"[{target}]"
    size = "" if kind.unit is None else "=SIZE"
    unit = "" if kind.unit is None else f" [{kind.unit}, {kind.smallest:g} to {kind.largest:g}]"
    return f"{name}{target}{size}: {kind.what}{unit}"
