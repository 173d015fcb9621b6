"""The one table of the controller's parameters.

The C++ headers, PX4's module.yaml, ground-station files, the SITL's parameter server and the uploader
all come from here. Its order is that of ``mimopilot::Gains`` seen as an array of float.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np
from mimopilot.codegen.errors import CodegenError
from mimopilot.tuning.gains import AXES, LIMITS, MATRICES, PARAMETER_PREFIX, Gains
from mimopilot.tuning.logs.flown_gains import SCALE
from mimopilot.tuning.thresholds import DEFAULT_THRESHOLDS
from numpy.typing import NDArray

AXIS_NAMES = dict(zip("RPY", AXES, strict=True))


@dataclass(frozen=True)
class Parameter:
    """One scalar of the controller as a vehicle publishes it.

    Attributes
    ----------
    name : str
        At most 16 characters: ``MIMO_<loop and term>_<output><error>``.
    code : str
        The element's code in `tuning.gains.Gains.elements`.
    unit : str
        As PX4 spells it; empty when it has none there.
    minimum, maximum : float
        Range that a vehicle accepts, both included.
    writable : bool
        False for what is fixed in the firmware and published only to be checked.
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


#: Matrix -> (unit, largest value, what it does).
_TERMS = {
    "Kp_o": ("1/s", 50.0, "rate set-point from angle error"),
    "Kp_i": ("s", 5.0, "moment from rate error"),
    "Ki_i": ("", 10.0, "moment from the integral of the rate error"),
    "Kd_i": ("s^2", 0.5, "moment from angular acceleration, subtracted"),
    "Kff_i": ("s", 5.0, "moment from rate set-point"),
}
#: Matrix -> least value of its diagonal: a loop without positive P, or with negative I, is none. D and feed-forward may
#: be negative: a reference model may ask for less damping than the vehicle has. P is a hundredth of what small
#: vehicles have, or more.
_DIAGONAL = {"Kp_o": 0.01, "Kp_i": 1e-4, "Ki_i": 0.0}
_LIMITS = {
    "rate_max": ("rad/s", 0.01, 50.0, "limit of the rate set-point"),
    "moment_max": ("norm", 0.01, 1.0, "limit of the moment, excitation included"),
    "integral_max": ("norm", 0.001, 1.0, "limit of the integral term"),
}


def _gain(matrix: str, output: str, error: str) -> Parameter:
    unit, largest, text = _TERMS[matrix]
    code = f"{MATRICES[matrix]}_{output}{error}"
    what = (
        f"{text}, {AXIS_NAMES[output]} from {AXIS_NAMES[error]}" if output != error else f"{text}, {AXIS_NAMES[output]}"
    )
    smallest = _DIAGONAL.get(matrix, -largest) if output == error else -largest
    return Parameter(PARAMETER_PREFIX + code, code, unit, smallest, largest, True, f"{matrix}: {what}")


def _limit(limit: str, axis: str) -> Parameter:
    unit, smallest, largest, text = _LIMITS[limit]
    code = f"{LIMITS[limit]}_{axis}"
    return Parameter(PARAMETER_PREFIX + code, code, unit, smallest, largest, True, f"{text}, {AXIS_NAMES[axis]}")


PARAMETERS: tuple[Parameter, ...] = (
    *(_gain(matrix, output, error) for matrix in MATRICES for output in "RP" for error in "RP"),
    *(_gain(matrix, "Y", "Y") for matrix in MATRICES),
    *(_limit(limit, axis) for limit in LIMITS for axis in "RPY"),
    Parameter(
        "MIMO_D_POLE", "D_POLE", "norm", 0.0, 0.9999, True, "pole of the derivative filter, exp(-2 pi f_d Ts); 0: none"
    ),
    Parameter("MIMO_TS", "TS", "s", 1e-4, 1.0, False, "control period, fixed in the firmware"),
)

#: What a vehicle publishes beside them, so that gains made for another unit of moment are noticed.
IDENTITY: tuple[Parameter, ...] = tuple(
    Parameter(
        f"{PARAMETER_PREFIX}{SCALE}_{axis}",
        f"{SCALE}_{axis}",
        "N m",
        0.0,
        1e6,
        False,
        f"moment of u = 1, {AXIS_NAMES[axis]}",
    )
    for axis in "RPY"
)


@dataclass(frozen=True)
class Setting:
    """One parameter of a vehicle that is no gain, with a default of its own.

    Attributes
    ----------
    name, unit, minimum, maximum, description
        As in `Parameter`.
    default : float
        What it is until somebody sets it.
    integer : bool
        True for a whole number.
    """

    name: str
    unit: str
    default: float
    minimum: float
    maximum: float
    integer: bool
    description: str


#: The experiment that a vehicle's own firmware flies: a PRBS added to the controller's output.
EXCITATION: tuple[Setting, ...] = (
    Setting("MIMO_EX_AX", "", 0, 0, 3, True, "excite once: 0 none, 1 roll, 2 pitch, 3 roll then pitch"),
    Setting("MIMO_EX_AMP", "norm", 0.1, 0.0, 0.5, False, "excitation: amplitude"),
    Setting("MIMO_EX_HMIN", "", 10, 1, 10000, True, "excitation: shortest pulse, control periods"),
    Setting("MIMO_EX_HMAX", "", 60, 1, 10000, True, "excitation: longest pulse, control periods"),
    Setting("MIMO_EX_DUR", "s", 16.0, 0.1, 300.0, False, "excitation: time on each axis"),
    Setting("MIMO_EX_SEED", "", 1, 0, 1000000, True, "excitation: seed of the pulses"),
    Setting("MIMO_EX_MODE", "", 4, 0, 30, True, "excitation: only in this nav_state (2 Position, 4 Hold)"),
    Setting("MIMO_EX_TILT", "rad", 0.5, 0.05, 1.0, False, "excitation: stops beyond this roll or pitch"),
)

#: Whether a vehicle's start-up script takes this controller or that of the flight stack.
ENABLE = Setting("MIMO_EN", "", 0, 0, 1, True, "1: this controller flies; 0: the stock one (reboot)")


#: Verdicts that gains may be emitted and uploaded with, the best first.
ACCEPTED = ("certified", "stable, thin margin")

#: Longest name that MAVLink and PX4 carry.
NAME_LENGTH = 16


def check_names() -> None:
    """Refuse a table that a vehicle would garble: PX4 and MAVLink say nothing of a name that is too long.

    Raises
    ------
    CodegenError
        Naming a parameter whose name is too long, not of A-Z, 0-9 and _, or taken twice.
    """
    table: tuple[Parameter | Setting, ...] = (*PARAMETERS, *IDENTITY, *EXCITATION, ENABLE)
    seen: set[str] = set()
    for parameter in table:
        name = parameter.name
        if len(name) > NAME_LENGTH:
            raise CodegenError(f"{name}: a name of {len(name)} characters, a vehicle stores at most {NAME_LENGTH}")
        if not re.fullmatch("[A-Z][A-Z0-9_]*", name):
            raise CodegenError(f"{name}: expected a letter, then A-Z, 0-9 and _: a vehicle drops other names")
        if name in seen:
            raise CodegenError(f"{name}: two parameters have this name")
        seen.add(name)


def identity_parameters(gains: Gains) -> dict[str, float]:
    """Name -> value of `IDENTITY`; empty when the gains do not say their unit of moment."""
    return {p.name: value for p, value in zip(IDENTITY, gains.moment_scale or (), strict=False)}


def check_ranges(gains: Gains) -> None:
    """Refuse a set that a vehicle would refuse.

    Raises
    ------
    CodegenError
        Naming the first parameter out of its range, its value and the range.
    """
    values = gains.elements()
    for parameter in PARAMETERS:
        value = values[parameter.code]
        if not parameter.minimum <= value <= parameter.maximum:
            raise CodegenError(
                f"{parameter.name}: got {value:.6g} {parameter.unit}".rstrip()
                + f", expected {parameter.minimum:g} to {parameter.maximum:g} ({parameter.description})"
            )


def check_verdict(gains: Gains, allow: bool) -> str:
    """Refuse gains whose loop is unstable, too near to it, or was never examined.

    Parameters
    ----------
    gains : Gains
        The set, with its certificate.
    allow : bool
        Go on all the same.

    Returns
    -------
    str
        A warning to show; empty when the set is certified.

    Raises
    ------
    CodegenError
        When the verdict is any other than ``certified`` and ``stable, thin margin``, and `allow` is False.
    """
    verdict, reason = gains.verdict()
    loose = _loose_thresholds(gains) if verdict in ACCEPTED else ""
    if verdict == ACCEPTED[0]:
        return loose
    if verdict not in ACCEPTED and not allow:
        verdict = "no certificate" if verdict == "none" else verdict
        raise CodegenError(f"{verdict}: {reason}; tune or certify again, or give --uncertified to go on all the same")
    return f"certificate: {verdict}: {reason}{'; ' if loose else ''}{loose}"


def _loose_thresholds(gains: Gains) -> str:
    """What is to be said where a certificate asked for less margin than usual."""
    asked = {**DEFAULT_THRESHOLDS.model_dump(), **dict((gains.certificate or {}).get("thresholds", {}))}
    usual = DEFAULT_THRESHOLDS
    peaks = asked["Ms"] <= usual.Ms and asked["thin_Ms"] <= usual.thin_Ms
    if peaks and asked["phase_deg"] >= usual.phase_deg and asked["thin_phase_deg"] >= usual.thin_phase_deg:
        return ""
    return (
        f"the certificate asked for less margin than usual: Ms {asked['Ms']:g} and {asked['phase_deg']:g} degrees "
        f"(thin: {asked['thin_Ms']:g} and {asked['thin_phase_deg']:g})"
    )


def to_array(gains: Gains) -> NDArray[np.float32]:
    """The (36,) float32 array that ``mimopilot::Gains`` is in memory."""
    values = gains.elements()
    return np.array([values[parameter.code] for parameter in PARAMETERS], dtype=np.float32)
