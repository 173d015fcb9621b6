"""The table of the controller's parameters.

A row of `ROWS` is a member of the C++ ``struct Gains``. The struct, its order and its layout in memory come from the
table. So do the keys of the gains file, and the names and ranges of parameters: in headers, PX4's module.yaml,
parameter files, the simulated vehicle and the uploader.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace

from mimopilot.tuning.errors import TuningError
from mimopilot.tuning.parameter_row import (
    AXIS_LETTERS,
    AXIS_NAMES,
    NOT_NEGATIVE,
    PERIOD,
    POSITIVE,
    PREFIX,
    STABLE_POLE,
    Parameter,
    Row,
    Shape,
    Valid,
)

#: Longest parameter name of MAVLink (PARAM_SET.param_id) and PX4, characters.
NAME_LENGTH = 16


def _gain(
    key: str, code: str, unit: str, largest: float, description: str, comment: str, diagonal: float | None = None
) -> Row:
    return Row(
        key=key,
        member=key.lower(),
        code=code,
        shape=Shape.MATRIX,
        unit=unit,
        minimum=-largest,
        maximum=largest,
        description=description,
        comment=comment,
        diagonal_minimum=diagonal,
    )


def _yaw(gain: Row) -> Row:
    """Row of the yaw scalar that belongs to a gain matrix."""
    return replace(gain, member=f"yaw_{gain.member}", shape=Shape.YAW, comment="")


def _limit(key: str, code: str, unit: str, smallest: float, largest: float, description: str, comment: str) -> Row:
    return Row(
        key=key,
        member=key,
        code=code,
        shape=Shape.AXES,
        unit=unit,
        minimum=smallest,
        maximum=largest,
        description=description,
        comment=comment,
        valid=POSITIVE,
    )


# Ranges: the diagonal of P must be positive and that of I not negative, or the loop is not closed. D and feed-forward
# may be negative: a reference model may ask for less damping than the vehicle has. The smallest P is a hundredth of
# that of small vehicles.
_GAINS = (
    _gain("Kp_o", "AP", "1/s", 50.0, "rate setpoint from angle error", "1/s, angle error to rate setpoint", 0.01),
    _gain("Kp_i", "RP", "s", 5.0, "torque from rate error", "s, rate error to torque", 1e-4),
    _gain(
        "Ki_i",
        "RI",
        "",
        10.0,
        "torque from the integral of the rate error",
        "1, integral of the rate error to torque",
        0.0,
    ),
    _gain(
        "Kd_i",
        "RD",
        "s^2",
        0.5,
        "torque from angular acceleration, subtracted",
        "s^2, measured angular acceleration to torque, subtracted",
    ),
    _gain("Kff_i", "RF", "s", 5.0, "torque from rate setpoint", "s, rate setpoint to torque"),
)

#: Weight of the yaw error if a gains file has none: PX4's default of MC_YAW_WEIGHT, which means the same.
YAW_WEIGHT = 0.4
#: Key of the row that switches on the slew limit of the setpoint.
SLEW = "setpoint_slew"
#: Largest slew of the setpoint in one period, rad: half of it stands for its tangent, to 0.1 %.
SLEW_STEP = 0.1
#: Key of the row that switches on model following.
MODEL = "model_omega"
#: Damping ratios of the attitude model. Below 0.1 it amplifies setpoints at its natural frequency more than five times.
MODEL_DAMPING = Valid(0.1, 2.0)
#: Largest omega Ts of the attitude model. Its recursion (see `tuning.reference_model.followed_model`) has the
#: characteristic polynomial z^2 - (2 - 2 zeta omega Ts - (omega Ts)^2) z + 1 - 2 zeta omega Ts. By Jury's criterion it
#: is stable if (omega Ts)^2 + 4 zeta omega Ts < 4. Up to 0.25, with a damping of at most 2, both coefficients also keep
#: their sign: no mode alternates from sample to sample.
MODEL_STEP = 0.25

# Without motor lag the ideal Kff_o is 1, and the ideal Kaff_i the inertia over the torque of u = 1: of the size of
# Kd_i, so of the same range.
_MODEL_GAINS = tuple(
    replace(gain, default=0.0, option=MODEL)
    for gain in (
        _gain("Kff_o", "AF", "", 5.0, "rate setpoint from model rate", "1, model's rate to rate setpoint"),
        _gain("Kaff_i", "RA", "s^2", 0.5, "torque from model acceleration", "s^2, model's acceleration to torque"),
    )
)

#: The table, in the order of the C++ struct.
ROWS: tuple[Row, ...] = (
    *_GAINS,
    *_MODEL_GAINS,
    *map(_yaw, _GAINS),
    _limit("rate_max", "RMAX", "rad/s", 0.01, 50.0, "limit of the rate setpoint", "rad/s"),
    _limit("moment_max", "UMAX", "norm", 0.01, 1.0, "limit of the torque, excitation included", "normalised"),
    _limit("integral_max", "IMAX", "norm", 0.001, 1.0, "limit of the integral term", "normalised"),
    Row(
        key="yaw_weight",
        member="yaw_weight",
        code="YAW_W",
        shape=Shape.SCALAR,
        unit="norm",
        minimum=0.01,
        maximum=1.0,
        description="weight of the yaw error beside roll and pitch; yaw gain unchanged",
        comment="weight of the yaw error against roll and pitch",
        default=YAW_WEIGHT,
        valid=Valid(0.0, 1.0, lowest_included=False),
    ),
    Row(
        key=SLEW,
        member=SLEW,
        code="SP_SLEW",
        shape=Shape.SCALAR,
        unit="rad/s",
        minimum=0.0,
        maximum=50.0,
        description="slew limit of the attitude setpoint; 0: none",
        comment="rad/s, slew limit of the attitude setpoint, 0: none",
        default=0.0,
        option=SLEW,
        valid=NOT_NEGATIVE,
        largest_in_period=SLEW_STEP,
    ),
    Row(
        key="derivative_cutoff_hz",
        member="derivative_pole",
        code="D_POLE",
        shape=Shape.POLE,
        unit="norm",
        minimum=0.0,
        maximum=0.9999,
        description="pole of the derivative filter, exp(-2 pi f_d Ts); 0: none",
        comment="a = exp(-2 pi f_d Ts), 0: no filter",
        valid=STABLE_POLE,
    ),
    Row(
        key="Ts",
        member="period",
        code="TS",
        shape=Shape.SCALAR,
        unit="s",
        minimum=PERIOD.lowest,
        maximum=PERIOD.highest,
        description="control period, fixed in the firmware",
        comment="Ts, s",
        writable=False,
        valid=PERIOD,
    ),
    # Written before the frequency by an upload, so the model starts with its damping.
    Row(
        key="model_damping",
        member="model_damping",
        code="M_DAMP",
        shape=Shape.SCALAR,
        unit="",
        minimum=0.3,
        maximum=2.0,
        description="attitude model: damping ratio",
        comment="attitude model: damping ratio",
        default=0.7,
        option=MODEL,
        valid=MODEL_DAMPING,
    ),
    Row(
        key=MODEL,
        member=MODEL,
        code="M_OMEGA",
        shape=Shape.SCALAR,
        unit="rad/s",
        minimum=0.0,
        maximum=50.0,
        description="attitude model: natural frequency; 0: no model following",
        comment="rad/s, attitude model: natural frequency, 0: no model following",
        default=0.0,
        option=MODEL,
        valid=NOT_NEGATIVE,
        largest_in_period=MODEL_STEP,
    ),
)


def rows(*shapes: Shape) -> tuple[Row, ...]:
    """Rows of the given shapes."""
    return tuple(row for row in ROWS if row.shape in shapes)


#: Gain matrix -> code.
MATRICES = {row.key: row.code for row in rows(Shape.MATRIX)}
#: The gains of yaw; each has a matrix of the same name.
YAW_GAINS = tuple(row.key for row in rows(Shape.YAW))
#: Limit -> code.
LIMITS = {row.key: row.code for row in rows(Shape.AXES)}

PARAMETERS: tuple[Parameter, ...] = tuple(parameter for row in ROWS for parameter in row.parameters())

#: Code of the unit of torque: N m of u = 1, by axis.
SCALE = "SCALE"
#: Further values that a vehicle publishes, so that gains for another unit of torque are detected.
IDENTITY: tuple[Parameter, ...] = tuple(
    Parameter(
        name=f"{PREFIX}{SCALE}_{axis}",
        code=f"{SCALE}_{axis}",
        unit="N m",
        minimum=0.0,
        maximum=1e6,
        writable=False,
        description=f"torque of u = 1, {AXIS_NAMES[axis]}",
    )
    for axis in AXIS_LETTERS
)


@dataclass(frozen=True)
class Setting:
    """One parameter of a vehicle that is not a gain, with its own default.

    Attributes
    ----------
    name, unit, minimum, maximum, description
        As in `Parameter`.
    default : float
        Initial value.
    integer : bool
        True: an integer.
    """

    name: str
    unit: str
    default: float
    minimum: float
    maximum: float
    integer: bool
    description: str


#: The experiment in a vehicle's firmware: a PRBS added to the controller output.
EXCITATION: tuple[Setting, ...] = (
    Setting("MIMO_EX_AX", "", 0, 0, 5, True, "excite once: 1 roll, 2 pitch, 3 both, 4 yaw, 5 all, one by one"),
    Setting("MIMO_EX_AMP", "norm", 0.1, 0.0, 0.5, False, "excitation: amplitude on roll and pitch"),
    Setting("MIMO_EX_AMPY", "norm", 0.2, 0.0, 0.5, False, "excitation: amplitude on yaw"),
    Setting("MIMO_EX_HMIN", "", 10, 1, 10000, True, "excitation: shortest pulse, control periods"),
    Setting("MIMO_EX_HMAX", "", 60, 1, 10000, True, "excitation: longest pulse, control periods"),
    Setting("MIMO_EX_DUR", "s", 16.0, 0.1, 300.0, False, "excitation: time on each axis"),
    Setting("MIMO_EX_SEED", "", 1, 0, 1000000, True, "excitation: seed of the pulses"),
    Setting("MIMO_EX_MODE", "", 4, 0, 30, True, "excitation: only in this nav_state (2 Position, 4 Hold)"),
    Setting("MIMO_EX_TILT", "rad", 0.5, 0.05, 1.0, False, "excitation: stop above this tilt"),
)

#: A vehicle's firmware has a number (`codegen.firmware_number`): of its gains, their unit of torque, and the names of
#: its parameters. Single precision holds six digits exactly, and ground stations show them.
LARGEST_NUMBER = 999_999
FIRMWARE_NUMBER = Parameter(
    name=f"{PREFIX}FW_ID",
    code="FW_ID",
    unit="",
    minimum=1.0,
    maximum=LARGEST_NUMBER,
    writable=False,
    description="number of the firmware's gains",
)
#: Stored parameters outlive a new firmware. They fly only if they were written for it, or are its own gains.
SET_NUMBER = Setting(
    "MIMO_SET_ID", "", 0, 0, LARGEST_NUMBER, False, "FW_ID of the firmware that the stored parameters are for; 0: none"
)

#: Which controller flies: this one or that of the flight stack; from 2 on, a switch chooses in flight.
ENABLE = Setting("MIMO_EN", "", 0, 0, 7, True, "1: this controller flies; 0: the stock one; 2-7: RC AUX1-6 chooses")

#: Prefix of a custom controller's parameters in ArduPilot: ours is number 3.
ARDUPILOT_PREFIX = "CC3_"
#: The experiment in ArduPilot, whose flight modes have other numbers.
ARDUPILOT_EXCITATION: tuple[Setting, ...] = tuple(
    replace(setting, default=5, description="excitation: only in this flight mode (2 AltHold, 5 Loiter)")
    if setting.name == "MIMO_EX_MODE"
    else setting
    for setting in EXCITATION
)


def ardupilot_name(name: str) -> str:
    """Name in ArduPilot of one of our parameters.

    Examples
    --------
    >>> ardupilot_name("MIMO_RP_RR")
    'CC3_RP_RR'
    """
    return ARDUPILOT_PREFIX + name.removeprefix(PREFIX)


def check_names() -> None:
    """Refuse names that vehicles cannot store: PX4 and MAVLink truncate long ones silently.

    Raises
    ------
    TuningError
        When a name is too long, has other characters than A-Z, 0-9 and _, or occurs twice.
    """
    table: tuple[Parameter | Setting, ...] = (
        *PARAMETERS,
        *IDENTITY,
        FIRMWARE_NUMBER,
        *EXCITATION,
        SET_NUMBER,
        ENABLE,
    )
    seen: set[str] = set()
    for parameter in table:
        name = parameter.name
        if len(name) > NAME_LENGTH:
            raise TuningError(
                f"{name}: has {len(name)} characters, expected at most {NAME_LENGTH}: vehicles truncate it"
            )
        if not re.fullmatch("[A-Z][A-Z0-9_]*", name):
            raise TuningError(f"{name}: expected a letter, then A-Z, 0-9 and _: vehicles drop other names")
        if name in seen:
            raise TuningError(f"{name}: two parameters have this name; rename one")
        seen.add(name)


def with_unit(key: str) -> str:
    """Name of a gain with its unit, for the first column of a table: ``Kp_o [1/s]``."""
    unit = next(row.unit for row in ROWS if row.key == key)
    return f"{key} [{unit}]" if unit else key
