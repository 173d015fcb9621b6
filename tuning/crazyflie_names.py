"""Names of the controller's parameters and log variables on a Crazyflie: one group, for the firmware and its readers.

All parameters are floats, those that are fixed in the firmware (``mimo.TS``, ``mimo.SCALE_*``, ``mimo.FW_ID``) are
read-only, and the others persistent. A Crazyflie flies only a set that it has taken as a whole: it reads them when it
starts, and each time ``mimo.EN`` goes from 0 to 1 on the ground (`ControllerState`).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from enum import IntEnum

from mimopilot.tuning.parameter_row import PREFIX, Parameter
from mimopilot.tuning.parameters import (
    ENABLE,
    EXCITATION,
    FIRMWARE_NUMBER,
    IDENTITY,
    PARAMETERS,
    SET_NUMBER,
    Setting,
)

#: Group of our parameters and of our log variables.
GROUP = "mimo"
#: Longest ``group.name`` of a table of contents of CRTP: 30 bytes of data, less its header and the two ends of text.
NAME_LENGTH = 26
#: Setting that a Crazyflie has no use for: it has no flight modes with numbers.
_WITHOUT = "MIMO_EX_MODE"
#: Of the settings, the one that differs: a Crazyflie has no switches of a remote control.
CRAZYFLIE_ENABLE = replace(
    ENABLE, maximum=1, description="1: this controller flies; 0: the stock PID; taken on the ground"
)
SETTINGS: tuple[Setting, ...] = (*(one for one in EXCITATION if one.name != _WITHOUT), SET_NUMBER, CRAZYFLIE_ENABLE)
#: Read-only parameter with the `ControllerState`, as an integer of one byte.
STATE = f"{GROUP}.STATE"


class ControllerState(IntEnum):
    """What a Crazyflie does with the parameters; its read-only parameter and log variable."""

    STOCK = 0  # EN is 0: the stock PID flies
    FLIES = 1  # the set of parameters flies
    CHANGED = 2  # a set flies; a parameter has changed since it was taken: set EN to 0, then to 1
    REFUSED = 3  # the set of parameters is not valid: the one taken before flies
    WAITING = 4  # EN has changed in the air: it counts on the ground
    WRONG_PERIOD = 5  # the gains are for another rate: no torque, at all
    OTHER_FIRMWARE = 6  # the stored parameters are not for this firmware: the stock PID flies


def crazyflie_name(name: str) -> str:
    """``group.name`` on a Crazyflie of a parameter of the table.

    Examples
    --------
    >>> crazyflie_name("MIMO_RP_RR"), crazyflie_name("MIMO_EN")
    ('mimo.RP_RR', 'mimo.EN')
    """
    return f"{GROUP}.{name.removeprefix(PREFIX)}"


def crazyflie_parameters() -> Iterator[Parameter | Setting]:
    """All floats of the group, in the firmware's order."""
    yield from PARAMETERS
    yield from IDENTITY
    yield FIRMWARE_NUMBER
    yield from SETTINGS


@dataclass(frozen=True)
class LogVariable:
    """A log variable of the firmware, in SI units, body FRD.

    Attributes
    ----------
    name : str
        Without the group.
    type : str
        ``float``, ``int8_t`` or ``uint8_t``.
    unit, description : str
    """

    name: str
    type: str
    unit: str
    description: str


#: The log variables. Angles are those of roll, pitch, then yaw turned from the axes of earth (z down) to those of the
#: body (x forward, y right, z down): pitch is positive with the nose up, yaw to the right.
LOG_VARIABLES: tuple[LogVariable, ...] = (
    *(
        LogVariable(f"u{axis}", "float", "", "torque of the controller, normalised, excitation included")
        for axis in "RPY"
    ),
    *(LogVariable(f"ub{axis}", "float", "", "excitation, normalised torque") for axis in "RPY"),
    *(LogVariable(name, "float", "rad/s", "body rate") for name in "pqr"),
    *(LogVariable(f"{name}Sp", "float", "rad/s", "body rate setpoint that is flown") for name in "pqr"),
    *(LogVariable(name, "float", "rad", "attitude") for name in ("roll", "pitch", "yaw")),
    *(
        LogVariable(f"{name}Sp", "float", "rad", "attitude setpoint; NaN: rates are flown")
        for name in ("roll", "pitch", "yaw")
    ),
    LogVariable("phase", "int8_t", "", "excitation: -2 waits, -1 off, 0 roll, 1 pitch, 2 pause, 3 yaw"),
    LogVariable("end", "uint8_t", "", "how the last excitation ended"),
    LogVariable("state", "uint8_t", "", "what flies, see STATE"),
    LogVariable("refused", "uint8_t", "", "refused set: place of the first bad parameter in the table, from 1"),
    LogVariable("fault", "uint8_t", "", "bits of inputs that are invalid for too long"),
    LogVariable("saturated", "uint8_t", "", "bits of axes whose torque the motors could not give"),
)
