"""The parameters of ArduPilot's custom controller."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from mimopilot.codegen.errors import CodegenError
from mimopilot.codegen.literals import float_literal
from mimopilot.tuning.gains import Gains
from mimopilot.tuning.parameter_row import Parameter
from mimopilot.tuning.parameters import (
    ARDUPILOT_EXCITATION,
    ARDUPILOT_PREFIX,
    IDENTITY,
    PARAMETERS,
    Setting,
    ardupilot_name,
)

#: Largest index in a parameter group: ArduPilot's AP_Param has 6 bits for it.
LARGEST_INDEX = 63


@dataclass(frozen=True)
class GroupEntry:
    """One parameter of the controller's group; numbers as C++ literals, the name without the group's prefix.

    Attributes
    ----------
    name, title, description, range : str
        As in ArduPilot's parameter documentation.
    index : int
        Place in the group, under which ArduPilot stores the value: the same for every gain set.
    value, minimum, maximum : str
        Default and limits; a parameter that is fixed in the firmware has one value.
    setting : bool
        Not a gain, and not published only.
    """

    name: str
    title: str
    description: str
    range: str
    index: int
    value: str
    minimum: str
    maximum: str
    setting: bool


def group(gains: Gains) -> list[GroupEntry]:
    """Every parameter of the controller, with its default from `gains`.

    The unit of torque is published if the gains have it.

    Raises
    ------
    CodegenError
        If there are more than one group can have.
    """
    values: Mapping[str, float] = {p.name: gains.elements()[p.code] for p in PARAMETERS} | gains.identity()
    table: tuple[Parameter | Setting, ...] = (*PARAMETERS, *IDENTITY, *ARDUPILOT_EXCITATION)
    if len(table) > LARGEST_INDEX:
        raise CodegenError(f"{len(table)} parameters: a group of ArduPilot has at most {LARGEST_INDEX}; use two groups")
    return [
        _entry(source, index, source.default if isinstance(source, Setting) else values[source.name])
        for index, source in enumerate(table, 1)
        if isinstance(source, Setting) or source.name in values
    ]


def _entry(source: Parameter | Setting, index: int, value: float) -> GroupEntry:
    fixed = isinstance(source, Parameter) and not source.writable
    low, high = (value, value) if fixed else (source.minimum, source.maximum)
    unit = f", {source.unit}" if source.unit not in ("", "norm") else ""
    note = ". Fixed in the firmware, for checking only" if fixed else ""
    return GroupEntry(
        name=ardupilot_name(source.name).removeprefix(ARDUPILOT_PREFIX),
        title=source.description,
        description=f"{source.description}{unit}{note}.",
        range=f"{low:g} {high:g}",
        index=index,
        value=float_literal(value),
        minimum=float_literal(low),
        maximum=float_literal(high),
        setting=isinstance(source, Setting),
    )


def context(gains: Gains) -> dict[str, Any]:
    """What only the templates in ``firmware_templates/ardupilot`` use."""
    entries = group(gains)
    places = [entry.name for entry in entries if entry.index > len(PARAMETERS)]
    table = {"prefix": ARDUPILOT_PREFIX, "entries": entries, "places": places, "settings": ARDUPILOT_EXCITATION}
    return {"ardupilot": table}
