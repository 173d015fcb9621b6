"""Conversion of gains to the parameters of a vehicle: our module's, or those of a stock autopilot.

A stock controller is diagonal: off-diagonal gains are lost. No factor is needed for the gains: PX4's and ArduPilot's
angle P is in 1/s; their rate P, I, D and FF are normalised torque per rad/s, its integral, its derivative and the rate
setpoint. Both filter the derivative by a first-order low-pass with our cutoff. Rate limits are converted to deg/s.
The unit of the normalised torque is the vehicle's own: see `sitl.physics.moment_scale`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from mimopilot.sitl.errors import SitlError
from mimopilot.sitl.mavlink.wire.float32 import single
from mimopilot.tuning.acceptance import check_ranges
from mimopilot.tuning.gains import Gains
from mimopilot.tuning.parameter_row import AXES, AXIS_LETTERS, PREFIX, Parameter
from mimopilot.tuning.parameters import ENABLE, EXCITATION, IDENTITY, MATRICES, PARAMETERS, ROWS, YAW_GAINS, Setting

#: Largest off-diagonal gain, as a share of its row's diagonal, that a stock profile drops without the option; chosen.
DROPPED_SHARE = 0.1


@dataclass(frozen=True)
class ParameterWrite:
    """One parameter to write: unit, value in single precision, and allowed range."""

    name: str
    unit: str
    value: float
    minimum: float
    maximum: float


@dataclass(frozen=True)
class UploadPlan:
    """Parameters that an upload writes, and those that it checks.

    Attributes
    ----------
    settings : tuple of ParameterWrite
        To write, in the order of the vehicle's table.
    fixed : dict
        Name -> value that the firmware must have been built with.
    scale : tuple of str
        Parameters in which the vehicle publishes its unit of torque, N m; empty if it has none.
    dropped : dict
        Code of a gain that the vehicle has no parameter for -> its size as a share of its row's diagonal.
    notes : tuple of str
        Other differences of the vehicle's controller.
    profile : str
        Key of `PROFILES` that the vehicle must fit; empty: any vehicle.
    integers : frozenset of str
        Parameters that may be whole numbers on the vehicle.
    """

    settings: tuple[ParameterWrite, ...]
    fixed: dict[str, float]
    scale: tuple[str, ...]
    dropped: dict[str, float]
    notes: tuple[str, ...] = ()
    profile: str = ""
    integers: frozenset[str] = frozenset()

    @property
    def values(self) -> dict[str, float]:
        """Name -> value to write."""
        return {setting.name: setting.value for setting in self.settings}


def _mimo(gains: Gains) -> UploadPlan:
    check_ranges(gains)
    elements = gains.elements()
    settings = tuple(
        ParameterWrite(p.name, p.unit, elements[p.code], p.minimum, p.maximum) for p in PARAMETERS if p.writable
    )
    fixed = {p.name: single(elements[p.code]) for p in PARAMETERS if not p.writable}
    return UploadPlan(settings, fixed, tuple(p.name for p in IDENTITY), {})


def _px4_stock(gains: Gains) -> UploadPlan:
    """Ranges are from PX4's parameter reference; if it has no maximum, from our table."""
    settings: list[ParameterWrite] = []
    largest_p, largest_d = (0.5, 0.6, 0.6), (0.01, 0.5, 0.5)
    for axis, name in enumerate(("ROLL", "PITCH", "YAW")):
        angle, p, i, d, ff = _diagonal(gains, axis)
        limit = math.degrees(gains.limits.rate_max[axis])
        settings += [
            ParameterWrite(f"MC_{name}_P", "1/s", angle, 0.0, 5.0 if name == "YAW" else 12.0),
            ParameterWrite(f"MC_{name}RATE_P", "s", p, 0.0, largest_p[axis]),
            ParameterWrite(f"MC_{name}RATE_I", "", i, 0.0, 10.0),
            ParameterWrite(f"MC_{name}RATE_D", "s^2", d, 0.0, largest_d[axis]),
            ParameterWrite(f"MC_{name}RATE_FF", "s", ff, 0.0, 5.0),
            # PX4 multiplies P, I and D by it.
            ParameterWrite(f"MC_{name}RATE_K", "", 1.0, 1.0, 1.0),
            ParameterWrite(f"MC_{name[0]}R_INT_LIM", "norm", gains.limits.integral_max[axis], 0.0, 1.0),
            ParameterWrite(f"MC_{name}RATE_MAX", "deg/s", limit, 0.0, 1800.0),
        ]
    settings.append(ParameterWrite("MC_YAW_WEIGHT", "norm", gains.filters.yaw_weight, 0.0, 1.0))
    settings.append(ParameterWrite("IMU_DGYRO_CUTOFF", "Hz", gains.derivative_cutoff_hz, 0.0, 1000.0))
    notes = ("PX4 integrates less when the rate error is large, and MC_YAW_TQ_CUTOFF filters yaw; neither is set",)
    return UploadPlan(tuple(settings), {}, (), {}, notes)


def _ardupilot_stock(gains: Gains) -> UploadPlan:
    """Ranges are from ArduPilot's parameter reference, but start at 0: it enforces none."""
    settings: list[ParameterWrite] = []
    largest_p, largest_i, largest_d = (0.5, 0.5, 2.5), (2.0, 2.0, 1.0), (0.05, 0.05, 0.02)
    for axis, name in enumerate(("RLL", "PIT", "YAW")):
        angle, p, i, d, ff = _diagonal(gains, axis)
        settings += [
            ParameterWrite(f"ATC_ANG_{name}_P", "1/s", angle, 0.0, 12.0),
            ParameterWrite(f"ATC_RAT_{name}_P", "s", p, 0.0, largest_p[axis]),
            ParameterWrite(f"ATC_RAT_{name}_I", "", i, 0.0, largest_i[axis]),
            ParameterWrite(f"ATC_RAT_{name}_D", "s^2", d, 0.0, largest_d[axis]),
            ParameterWrite(f"ATC_RAT_{name}_FF", "s", ff, 0.0, 0.5),
            ParameterWrite(f"ATC_RAT_{name}_IMAX", "norm", gains.limits.integral_max[axis], 0.0, 1.0),
            ParameterWrite(f"ATC_RAT_{name}_FLTD", "Hz", gains.derivative_cutoff_hz, 0.0, 100.0),
            ParameterWrite(f"ATC_RATE_{name[0]}_MAX", "deg/s", math.degrees(gains.limits.rate_max[axis]), 0.0, 1080.0),
        ]
    notes = (
        "ArduPilot's D acts on the error, not on the measurement; its FLTT and FLTE filters, which our loop does not "
        "have, are not set",
    )
    return UploadPlan(tuple(settings), {}, (), {}, notes)


#: Profile -> its conversion of gains.
PROFILES: dict[str, Callable[[Gains], UploadPlan]] = {
    "mimo": _mimo,
    "px4-stock": _px4_stock,
    "ardupilot-stock": _ardupilot_stock,
}


def make_plan(gains: Gains, profile: str = "mimo", drop: bool = False) -> UploadPlan:
    """Plan the upload of gains to a vehicle.

    Parameters
    ----------
    gains : Gains
        To upload.
    profile : str
        A key of `PROFILES`.
    drop : bool
        Drop off-diagonal gains of any size.

    Raises
    ------
    SitlError
        If the profile is unknown, a value is out of its parameter's range, or a large off-diagonal would be dropped.
    CodegenError
        If a value is out of the range of our module's parameter.
    """
    if profile not in PROFILES:
        raise SitlError(f"--profile: got {profile!r}, expected one of {', '.join(PROFILES)}")
    plan = PROFILES[profile](gains)
    for setting in plan.settings:
        if not setting.minimum <= setting.value <= setting.maximum:
            raise SitlError(
                f"{setting.name}: got {setting.value:.6g}, expected {setting.minimum:g} to {setting.maximum:g} "
                f"{setting.unit}".rstrip()
                + f"; the {profile} controller does not accept it: tune again, or use another profile"
            )
    if profile != "mimo":
        plan = replace(plan, dropped=off_diagonal_shares(gains), notes=plan.notes + _lost_features(gains))
        code, share = max(plan.dropped.items(), key=lambda item: item[1], default=("", 0.0))
        if share > DROPPED_SHARE and not drop:
            raise SitlError(
                f"{code}: the {profile} controller has no off-diagonals, and this one is {share:.0%} of its diagonal, "
                f"expected at most {DROPPED_SHARE:.0%}; use the mimo profile, or give --drop-off-diagonals"
            )
    return replace(plan, settings=tuple(replace(s, value=single(s.value)) for s in plan.settings), profile=profile)


def off_diagonal_shares(gains: Gains) -> dict[str, float]:
    """Code of each non-zero off-diagonal gain -> its size as a share of its row's diagonal; without model following."""
    shares: dict[str, float] = {}
    for name in YAW_GAINS:
        matrix, code = np.abs(getattr(gains, name)), MATRICES[name]
        for i, j in ((0, 1), (1, 0)):
            if matrix[i, j] > 0:
                share = matrix[i, j] / matrix[i, i] if matrix[i, i] > 0 else math.inf
                shares[f"{code}_{AXIS_LETTERS[i]}{AXIS_LETTERS[j]}"] = float(share)
    return shares


def _diagonal(gains: Gains, axis: int) -> list[float]:
    """P of the outer loop, then P, I, D and FF of the inner loop, of one axis."""
    if axis == 2:
        return [getattr(gains.yaw, name) for name in YAW_GAINS]
    return [float(getattr(gains, name)[axis, axis]) for name in YAW_GAINS]


def _lost_features(gains: Gains) -> tuple[str, ...]:
    lost = [axis for axis, limit in zip(AXES, gains.limits.moment_max, strict=True) if limit < 1]
    limits = (f"moment_max ({', '.join(lost)}) has no counterpart and is not set",) if lost else ()
    model = ("model following has no counterpart: attitude setpoints act directly",) if gains.filters.followed else ()
    return limits + model


#: Our vehicles' parameters by name. The other profiles are recognised by the prefix of their names.
_OURS: tuple[Parameter | Setting, ...] = (*PARAMETERS, *IDENTITY, *EXCITATION, ENABLE)
TABLE = {p.name: p for p in _OURS}
PREFIXES = {"mimo": (PREFIX,), "px4-stock": ("MC_",), "ardupilot-stock": ("ATC_", "SID_")}


def violated_range(name: str, value: float) -> str:
    """Range of one of our parameters if a value is outside it; empty if inside, or not our parameter."""
    ours = TABLE.get(name)
    if ours is None or ours.minimum <= value <= ours.maximum:
        return ""
    return f"{ours.minimum:g} to {ours.maximum:g} {ours.unit}".rstrip() + f" ({ours.description})"


def make_restore_plan(values: Mapping[str, float], source: str) -> UploadPlan:
    """Plan the restoration of values that a vehicle held.

    Parameters
    ----------
    values : mapping
        Name -> value in single precision.
    source : str
        Their file, for messages.

    Raises
    ------
    SitlError
        If one is out of the range of our table, or only some of our gains are present that have no default.
    """
    for name, value in values.items():
        expected = violated_range(name, value)
        if expected:
            raise SitlError(f"{source}: {name}: got {value:.6g}, expected {expected}")
    # A snapshot may be older than a row of the table that has a default.
    required = {PREFIX + code for row in ROWS if row.default is None for code in row.codes}
    writable = [p.name for p in PARAMETERS if p.writable and p.name in required]
    lacking = [name for name in writable if name not in values]
    if 0 < len(lacking) < len(writable):
        raise SitlError(
            f"{source}: holds {len(writable) - len(lacking)} of our {len(writable)} gains and lacks {lacking[0]}"
            f"{f' and {len(lacking) - 1} more' if len(lacking) > 1 else ''}: restore a complete "
            "set"
        )
    fixed = {p.name for p in (*PARAMETERS, *IDENTITY) if not p.writable}
    settings = tuple(
        ParameterWrite(name, TABLE[name].unit if name in TABLE else "", value, -math.inf, math.inf)
        for name, value in values.items()
        if name not in fixed
    )
    profile = next((p for p, prefix in PREFIXES.items() if any(name.startswith(prefix) for name in values)), "")
    held = {name: values[name] for name in values if name in fixed}
    return UploadPlan(settings, held, (), {}, profile=profile, integers=frozenset(values))
