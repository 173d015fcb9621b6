"""What the templates of the Crazyflie's app are filled with."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

from mimopilot.codegen.errors import CodegenError
from mimopilot.codegen.firmware_number import firmware_number
from mimopilot.codegen.literals import float_literal
from mimopilot.tuning.crazyflie_names import (
    CRAZYFLIE_ENABLE,
    GROUP,
    LOG_VARIABLES,
    SETTINGS,
    ControllerState,
    crazyflie_name,
    crazyflie_parameters,
)
from mimopilot.tuning.gains import Gains
from mimopilot.tuning.parameter_row import Parameter
from mimopilot.tuning.parameters import FIRMWARE_NUMBER, IDENTITY, SET_NUMBER, Setting


@dataclass(frozen=True)
class CParameter:
    """One parameter of the app: a member of its C structure.

    Attributes
    ----------
    name : str
        Without the group.
    unit, description : str
    literal : str
        Value, C literal.
    writable : bool
        False: read-only.
    """

    name: str
    unit: str
    description: str
    literal: str
    writable: bool


def context(gains: Gains) -> dict[str, Any]:
    """What only the templates in ``firmware_templates/crazyflie`` use.

    Raises
    ------
    CodegenError
        If the gains do not say how many N m one unit of torque is: the firmware takes N m.
    """
    if gains.moment_scale is None:
        raise CodegenError(
            "moment_scale: the gains have none, and the Crazyflie's firmware takes torques in N m; tune again with "
            "--spec FILE, where FILE says moment_scale = [...]: the N m of u = 1 on roll, pitch and yaw"
        )
    values = gains.elements() | {p.code: gains.identity()[p.name] for p in IDENTITY}
    values |= {FIRMWARE_NUMBER.code: firmware_number(gains)}
    return {
        "crazyflie_group": GROUP,
        "crazyflie_parameters": [_member(one, values) for one in crazyflie_parameters()],
        "crazyflie_excitation": [
            replace(one, name=crazyflie_name(one.name)) for one in SETTINGS if one not in (SET_NUMBER, CRAZYFLIE_ENABLE)
        ],
        "crazyflie_states": list(ControllerState),
        "log_variables": LOG_VARIABLES,
        "moment_scale": [float_literal(value) for value in gains.moment_scale],
    }


def _member(one: Parameter | Setting, values: Mapping[str, float]) -> CParameter:
    name = crazyflie_name(one.name).removeprefix(f"{GROUP}.")
    value, writable = (one.default, True) if isinstance(one, Setting) else (values[one.code], one.writable)
    return CParameter(name, one.unit, one.description, float_literal(value), writable)
