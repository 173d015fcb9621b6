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
#: Names after the prefix in the order of their indices, from 1 on. A vehicle stores a value under its index alone: an
#: index belongs to its parameter for ever: append new names, and leave the name of a parameter that no longer exists.
ORDER = (
    *("AP_RR", "AP_RP", "AP_PR", "AP_PP", "RP_RR", "RP_RP", "RP_PR", "RP_PP", "RI_RR", "RI_RP", "RI_PR", "RI_PP"),
    *("RD_RR", "RD_RP", "RD_PR", "RD_PP", "RF_RR", "RF_RP", "RF_PR", "RF_PP", "AF_RR", "AF_RP", "AF_PR", "AF_PP"),
    *("RA_RR", "RA_RP", "RA_PR", "RA_PP", "AP_YY", "RP_YY", "RI_YY", "RD_YY", "RF_YY", "RMAX_R", "RMAX_P", "RMAX_Y"),
    *("UMAX_R", "UMAX_P", "UMAX_Y", "IMAX_R", "IMAX_P", "IMAX_Y", "YAW_W", "SP_SLEW", "D_POLE", "TS", "M_DAMP"),
    *("M_OMEGA", "SCALE_R", "SCALE_P", "SCALE_Y", "EX_AX", "EX_AMP", "EX_AMPY", "EX_HMIN", "EX_HMAX", "EX_DUR"),
    *("EX_SEED", "EX_MODE", "EX_TILT"),
)
INDEX = {name: index for index, name in enumerate(ORDER, 1)}


@dataclass(frozen=True)
class GroupEntry:
    """One parameter of the controller's group; numbers as C++ literals, the name without the group's prefix.

    Attributes
    ----------
    name, title, description, range : str
        As in ArduPilot's parameter documentation.
    index : int
        Place in the group, under which ArduPilot stores the value: the same for every gain set.
    value : str
        Default.
    """

    name: str
    title: str
    description: str
    range: str
    index: int
    value: str


def group(gains: Gains) -> list[GroupEntry]:
    """Every parameter of the controller, with its default from `gains`.

    The unit of torque is published if the gains have it.

    Raises
    ------
    CodegenError
        If one has no index, or there are more than one group can have.
    """
    values: Mapping[str, float] = {p.name: gains.elements()[p.code] for p in PARAMETERS} | gains.identity()
    table: tuple[Parameter | Setting, ...] = (*PARAMETERS, *IDENTITY, *ARDUPILOT_EXCITATION)
    if len(ORDER) > LARGEST_INDEX:
        raise CodegenError(f"{len(ORDER)} indices: a group of ArduPilot has at most {LARGEST_INDEX}; use two groups")
    for source in table:
        if _name(source) not in INDEX:
            raise CodegenError(f"{source.name}: has no index in ArduPilot; append it to `codegen.ardupilot.ORDER`")
    return [
        _entry(source, source.default if isinstance(source, Setting) else values[source.name])
        for source in table
        if isinstance(source, Setting) or source.name in values
    ]


def _name(source: Parameter | Setting) -> str:
    return ardupilot_name(source.name).removeprefix(ARDUPILOT_PREFIX)


def _entry(source: Parameter | Setting, value: float) -> GroupEntry:
    fixed = isinstance(source, Parameter) and not source.writable
    low, high = (value, value) if fixed else (source.minimum, source.maximum)
    unit = f", {source.unit}" if source.unit not in ("", "norm") else ""
    note = ". Fixed in the firmware, for checking only" if fixed else ""
    return GroupEntry(
        name=_name(source),
        title=source.description,
        description=f"{source.description}{unit}{note}.",
        range=f"{low:g} {high:g}",
        index=INDEX[_name(source)],
        value=float_literal(value),
    )


def context(gains: Gains) -> dict[str, Any]:
    """What only the templates in ``firmware_templates/ardupilot`` use."""
    entries = group(gains)
    table = {
        "prefix": ARDUPILOT_PREFIX,
        "entries": entries,
        "places": [entry.name for entry in entries[len(PARAMETERS) :]],
        "published": entries[len(PARAMETERS) : -len(ARDUPILOT_EXCITATION)],
        "settings": ARDUPILOT_EXCITATION,
        "indices": len(ORDER),
        "largest_index": LARGEST_INDEX,
    }
    return {"ardupilot": table}
