"""The parameters of PX4's module.yaml."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from mimopilot.codegen.firmware_number import firmware_number
from mimopilot.tuning.gains import Gains
from mimopilot.tuning.parameter_row import Parameter
from mimopilot.tuning.parameters import (
    ENABLE,
    EXCITATION,
    FIRMWARE_NUMBER,
    IDENTITY,
    PARAMETERS,
    SET_NUMBER,
    Setting,
)

#: Our unit -> PX4's; PX4 does not list our other units.
_UNITS = {"s": "s", "rad": "rad", "rad/s": "rad/s", "norm": "norm", "N m": "Nm"}


@dataclass(frozen=True)
class YamlEntry:
    """One parameter of a module.yaml; numbers as the text in the file."""

    name: str
    type: str
    unit: str
    default: str
    minimum: str
    maximum: str
    decimal: int
    increment: str
    short: str
    long: str


def yaml_number(value: float) -> str:
    """Shortest text that YAML reads as a float and that reads back as float32(value).

    Examples
    --------
    >>> yaml_number(0.1), yaml_number(-3), yaml_number(1e-5), yaml_number(1.5e-7)
    ('0.1', '-3.0', '1.0e-05', '1.5e-07')
    """
    mantissa, exponent, power = str(np.float32(value)).partition("e")
    return f"{mantissa if '.' in mantissa else f'{mantissa}.0'}{exponent}{power}"


def entries(gains: Gains) -> list[YamlEntry]:
    """Every parameter of the module, with its default from `gains`.

    The unit of torque is published if the gains have it. A parameter that is fixed in the firmware has a range of
    one value.
    """
    values = gains.elements()
    scales = gains.identity()
    return [
        *(_of_parameter(parameter, values[parameter.code]) for parameter in PARAMETERS),
        *(_of_parameter(parameter, scales[parameter.name]) for parameter in IDENTITY if parameter.name in scales),
        _of_parameter(FIRMWARE_NUMBER, firmware_number(gains)),
        *(_of_setting(setting) for setting in (*EXCITATION, SET_NUMBER, ENABLE)),
    ]


def context(gains: Gains) -> dict[str, Any]:
    """What only the templates in ``firmware_templates/px4`` use."""
    return {"px4_parameters": entries(gains)}


def _of_parameter(parameter: Parameter, value: float) -> YamlEntry:
    fixed = "" if parameter.writable else " Fixed in the firmware, for checking only."
    low, high = (parameter.minimum, parameter.maximum) if parameter.writable else (value, value)
    return _entry(parameter, value, low, high, False, fixed)


def _of_setting(setting: Setting) -> YamlEntry:
    return _entry(setting, setting.default, setting.minimum, setting.maximum, setting.integer, "")


def _entry(source: Parameter | Setting, default: float, low: float, high: float, integer: bool, note: str) -> YamlEntry:
    def text(value: float) -> str:
        return str(int(value)) if integer else yaml_number(value)

    digits = min(max(3 - math.floor(math.log10(high)), 2), 4)  # a step is about a ten-thousandth of the range
    unit = f" In {source.unit}." if source.unit else ""
    return YamlEntry(
        name=source.name,
        type="int32" if integer else "float",
        unit=_UNITS.get(source.unit, ""),
        default=text(default),
        minimum=text(low),
        maximum=text(high),
        decimal=digits + 1,
        increment=yaml_number(10.0**-digits),
        short=source.description,
        long=f"{source.description}.{unit}{note}",
    )
