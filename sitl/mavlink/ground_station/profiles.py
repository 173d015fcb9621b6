"""Conversion of gains to the parameters of a vehicle: our module's, or those of a stock autopilot.

A set is for one controller, and only that one receives it: what flies is what was certified. No factor is needed: PX4's
and ArduPilot's angle P is in 1/s; their rate P, I, D and FF are normalised torque per rad/s, its integral, its
derivative and the rate setpoint. Rate limits are converted to deg/s. The unit of the normalised torque is the vehicle's
own: see `sitl.physics.moment_scale`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import NamedTuple

from mimopilot.common.errors import check_choice
from mimopilot.sitl.errors import SitlError
from mimopilot.sitl.mavlink.wire.float32 import single
from mimopilot.tuning.acceptance import check_ranges
from mimopilot.tuning.control_laws import control_law
from mimopilot.tuning.gains import Gains, Limits, Triple
from mimopilot.tuning.law_filters import ARDUPILOT_STOCK, BETAFLIGHT, MIMO, PX4_STOCK, StockFilters
from mimopilot.tuning.parameter_row import PREFIX, Parameter, Shape
from mimopilot.tuning.parameters import (
    ARDUPILOT_EXCITATION,
    ARDUPILOT_PREFIX,
    ENABLE,
    EXCITATION,
    FIRMWARE_NUMBER,
    IDENTITY,
    PARAMETERS,
    ROWS,
    SET_NUMBER,
    Setting,
    ardupilot_name,
    rows,
)

#: Profile of our custom controller in ArduPilot, whose law is that of our module.
ARDUPILOT_CUSTOM = "ardupilot-custom"


@dataclass(frozen=True)
class ParameterWrite:
    """One parameter to write: unit, value in single precision, and allowed range."""

    name: str
    unit: str
    value: float
    minimum: float
    maximum: float


class Binding(NamedTuple):
    """Parameters that bind a stored set to a firmware: its number, and that with which the set is stored."""

    firmware: str
    stored: str


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
    notes : tuple of str
        Other differences of the vehicle's controller.
    profile : str
        Key of `PROFILES` that the vehicle must fit; empty: any vehicle.
    integers : frozenset of str
        Parameters that may be whole numbers on the vehicle.
    requires : dict
        Name -> value of a setting of the vehicle without which the others do not exist.
    binding : Binding, optional
        Of a vehicle with our controller; None: a stock vehicle, or `settings` has what it held.
    """

    settings: tuple[ParameterWrite, ...]
    fixed: dict[str, float]
    scale: tuple[str, ...]
    notes: tuple[str, ...] = ()
    profile: str = ""
    integers: frozenset[str] = frozenset()
    requires: Mapping[str, float] = field(default_factory=dict)
    binding: Binding | None = None

    def bound(self, number: float) -> UploadPlan:
        """The plan for a firmware with this number."""
        assert self.binding is not None
        write = ParameterWrite(self.binding.stored, "", number, SET_NUMBER.minimum, SET_NUMBER.maximum)
        return replace(self, settings=(*self.settings, write), fixed=self.fixed | {self.binding.firmware: number})

    @property
    def lock(self) -> str:
        """The parameter of `settings` without which a vehicle takes none of the others; empty: there is none."""
        return next((name for name in self.values if name in LOCKS), "")

    @property
    def unnumbered(self) -> str:
        """The firmware's number that our gains from a file lack; empty: they have it, or there are none."""
        for binding, prefix in ((MODULE_BINDING, PREFIX), (CUSTOM_BINDING, ARDUPILOT_PREFIX)):
            ours = any(prefix + parameter.code in self.values for parameter in PARAMETERS)
            if ours and self.binding is None and binding.firmware not in self.fixed:
                return binding.firmware
        return ""

    @property
    def values(self) -> dict[str, float]:
        """Name -> value to write."""
        return {setting.name: setting.value for setting in self.settings}


#: Of our module, and of our custom controller in ArduPilot.
MODULE_BINDING = Binding(FIRMWARE_NUMBER.name, SET_NUMBER.name)
CUSTOM_BINDING = Binding(*map(ardupilot_name, MODULE_BINDING))
LOCKS = (MODULE_BINDING.stored, CUSTOM_BINDING.stored)


def _mimo(gains: Gains) -> UploadPlan:
    check_ranges(gains)
    elements = gains.elements()
    settings = tuple(
        ParameterWrite(p.name, p.unit, elements[p.code], p.minimum, p.maximum) for p in PARAMETERS if p.writable
    )
    fixed = {p.name: single(elements[p.code]) for p in PARAMETERS if not p.writable}
    return UploadPlan(settings, fixed, tuple(p.name for p in IDENTITY), binding=MODULE_BINDING)


#: ArduPilot's choice of a custom controller: ours.
CHOSEN = {"CC_TYPE": float(ARDUPILOT_PREFIX.strip("C_"))}


def _ardupilot_custom(gains: Gains) -> UploadPlan:
    """ArduPilot shows a custom controller's parameters only while it is chosen."""
    plan = _mimo(gains)
    return replace(
        plan,
        settings=tuple(replace(setting, name=ardupilot_name(setting.name)) for setting in plan.settings),
        fixed={ardupilot_name(name): value for name, value in plan.fixed.items()},
        scale=tuple(map(ardupilot_name, plan.scale)),
        binding=CUSTOM_BINDING,
        integers=frozenset(CHOSEN),
        requires=CHOSEN,
    )


def _px4_stock(gains: Gains) -> UploadPlan:
    """PX4 multiplies P, I and D by K: it is set to 1."""
    stock, largest = _stock_law(gains)
    settings: list[ParameterWrite] = []
    for axis, name in enumerate(("ROLL", "PITCH", "YAW")):
        names = (f"MC_{name}_P", *(f"MC_{name}RATE_{term}" for term in ("P", "I", "D", "FF")))
        settings += [
            *_gains_of(gains, axis, names, largest),
            ParameterWrite(f"MC_{name}RATE_K", "", 1.0, 1.0, 1.0),
            ParameterWrite(f"MC_{name[0]}R_INT_LIM", "norm", gains.limits.integral_max[axis], 0.0, 1.0),
            ParameterWrite(f"MC_{name}RATE_MAX", "deg/s", math.degrees(gains.limits.rate_max[axis]), 0.0, 1800.0),
        ]
    settings.append(ParameterWrite("MC_YAW_WEIGHT", "norm", gains.filters.yaw_weight, 0.0, 1.0))
    settings.append(ParameterWrite("IMU_DGYRO_CUTOFF", "Hz", stock.derivative_hz[0], 0.0, 1000.0))
    if stock.torque_hz[2]:  # older versions have no such filter
        settings.append(ParameterWrite("MC_YAW_TQ_CUTOFF", "Hz", stock.torque_hz[2], 0.0, 10.0))
    return UploadPlan(tuple(settings), {}, (), ("PX4 integrates less when the rate error is large",))


def _ardupilot_stock(gains: Gains) -> UploadPlan:
    """Ranges start at 0: ArduPilot enforces none."""
    stock, largest = _stock_law(gains)
    settings: list[ParameterWrite] = []
    for axis, name in enumerate(("RLL", "PIT", "YAW")):
        names = (f"ATC_ANG_{name}_P", *(f"ATC_RAT_{name}_{term}" for term in ("P", "I", "D", "FF")))
        limit = gains.limits.rate_max[axis]
        # No limit, 0, was read as that of our law: see `tuning.logs.stock_controllers`.
        limit = 0.0 if limit == Limits().rate_max[axis] else math.degrees(limit)
        settings += [
            *_gains_of(gains, axis, names, largest),
            ParameterWrite(f"ATC_RAT_{name}_IMAX", "norm", gains.limits.integral_max[axis], 0.0, 1.0),
            ParameterWrite(f"ATC_RAT_{name}_FLTT", "Hz", stock.setpoint_hz[axis], 0.0, 100.0),
            ParameterWrite(f"ATC_RAT_{name}_FLTE", "Hz", stock.error_hz[axis], 0.0, 100.0),
            ParameterWrite(f"ATC_RAT_{name}_FLTD", "Hz", stock.derivative_hz[axis], 0.0, 100.0),
            ParameterWrite(f"ATC_RATE_{name[0]}_MAX", "deg/s", limit, 0.0, 1080.0),
        ]
        if stock.derivative_feedforward[axis]:  # older versions have none
            value = stock.derivative_feedforward[axis]
            settings.append(ParameterWrite(f"ATC_RAT_{name}_D_FF", "s^2", value, 0.0, 0.02))
    if stock.shaping_s[0]:  # with ATC_RATE_FF_ENAB, which stays as it is
        settings.append(ParameterWrite("ATC_INPUT_TC", "s", stock.shaping_s[0], 0.0, 1.0))
    notes = ("ArduPilot replaces the angle P by a square root for large errors, and limits a setpoint's acceleration",)
    return UploadPlan(tuple(settings), {}, (), notes)


def _stock_law(gains: Gains) -> tuple[StockFilters, Mapping[str, Triple]]:
    """Filters of a stock set, and the largest gains of its controller."""
    stock, largest = gains.filters.stock, control_law(gains.filters).largest
    assert stock is not None and largest is not None  # make_plan compares the profile with the set's controller
    return stock, largest


def _gains_of(
    gains: Gains, axis: int, names: tuple[str, ...], largest: Mapping[str, Triple]
) -> Iterator[ParameterWrite]:
    """P of the attitude controller, then P, I, D and FF of the rate controller, of one axis."""
    for row, name in zip(rows(Shape.YAW), names, strict=True):
        value = getattr(gains.yaw, row.key) if axis == 2 else float(getattr(gains, row.key)[axis, axis])
        yield ParameterWrite(name, row.unit, value, 0.0, largest[row.key][axis])


#: Profile -> its conversion of gains.
PROFILES: dict[str, Callable[[Gains], UploadPlan]] = {
    MIMO: _mimo,
    PX4_STOCK: _px4_stock,
    ARDUPILOT_STOCK: _ardupilot_stock,
    ARDUPILOT_CUSTOM: _ardupilot_custom,
}


def law_of(profile: str) -> str:
    """Law that the gains of a profile are for, a key of `tuning.control_laws.LAWS`."""
    return MIMO if profile == ARDUPILOT_CUSTOM else profile


def make_plan(gains: Gains, profile: str = "mimo") -> UploadPlan:
    """Plan the upload of gains to a vehicle.

    Parameters
    ----------
    gains : Gains
        To upload.
    profile : str
        A key of `PROFILES`: the controller that the gains are for.

    Raises
    ------
    SitlError
        If the profile is unknown or not that of the gains, or a value is out of its parameter's range.
    CodegenError
        If a value is out of the range of our module's parameter.
    """
    if BETAFLIGHT in (profile, gains.controller):
        raise SitlError(
            f"the gains are for {gains.controller}: Betaflight takes no parameters over MAVLink; write lines for its "
            f"command line: mimopilot params FILE --format {BETAFLIGHT}, of gains from tune LOG --profile {BETAFLIGHT}"
        )
    check_choice("--profile", profile, PROFILES, SitlError)
    if law_of(profile) != gains.controller:
        raise SitlError(
            f"--profile {profile}: the gains are for {gains.controller}; upload them with --profile "
            f"{gains.controller}, or design gains for this one: mimopilot tune LOG --profile {profile}"
        )
    plan = PROFILES[profile](gains)
    for setting in plan.settings:
        if not setting.minimum <= setting.value <= setting.maximum:
            raise SitlError(
                f"{setting.name}: got {setting.value:.6g}, expected {setting.minimum:g} to {setting.maximum:g} "
                f"{setting.unit}".rstrip()
                + f"; the {profile} controller does not accept it: tune again, or use another profile"
            )
    return replace(plan, settings=tuple(replace(s, value=single(s.value)) for s in plan.settings), profile=profile)


def module_parameters(profile: str) -> tuple[list[str], Binding]:
    """Names of the writable parameters of our module, or of our custom controller, and what binds them to a firmware.

    Raises
    ------
    SitlError
        If it is the profile of another controller: what it has depends on the gains.
    """
    names = [p.name for p in PARAMETERS if p.writable]
    if profile == ARDUPILOT_CUSTOM:
        return [ardupilot_name(name) for name in names], CUSTOM_BINDING
    if profile != MIMO:
        raise SitlError(
            f"--profile {profile}: expected {MIMO} or {ARDUPILOT_CUSTOM} without a gains file; gains of a stock "
            "controller: mimopilot import-params"
        )
    return names, MODULE_BINDING


#: Our vehicles' parameters by name. The other profiles are recognised by the prefix of their names.
_OURS: tuple[Parameter | Setting, ...] = (*PARAMETERS, *IDENTITY, FIRMWARE_NUMBER, *EXCITATION, SET_NUMBER, ENABLE)
TABLE = {p.name: p for p in _OURS}
_ON_ARDUPILOT: tuple[Parameter | Setting, ...] = (
    *PARAMETERS,
    *IDENTITY,
    FIRMWARE_NUMBER,
    *ARDUPILOT_EXCITATION,
    SET_NUMBER,
)
TABLE |= {ardupilot_name(p.name): p for p in _ON_ARDUPILOT}
PREFIXES = {
    MIMO: (PREFIX,),
    PX4_STOCK: ("MC_",),
    ARDUPILOT_STOCK: ("ATC_", "SID_"),
    ARDUPILOT_CUSTOM: (ARDUPILOT_PREFIX,),
}


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
    required = {code for row in ROWS if row.default is None for code in row.codes}
    for prefix in (PREFIX, ARDUPILOT_PREFIX):
        writable = [prefix + p.code for p in PARAMETERS if p.writable and p.code in required]
        lacking = [name for name in writable if name not in values]
        if 0 < len(lacking) < len(writable):
            raise SitlError(
                f"{source}: holds {len(writable) - len(lacking)} of our {len(writable)} gains and lacks {lacking[0]}"
                f"{f' and {len(lacking) - 1} more' if len(lacking) > 1 else ''}: restore a complete "
                "set"
            )
    fixed = {
        prefix + p.code
        for p in (*PARAMETERS, *IDENTITY, FIRMWARE_NUMBER)
        if not p.writable
        for prefix in (PREFIX, ARDUPILOT_PREFIX)
    }
    settings = tuple(
        ParameterWrite(name, TABLE[name].unit if name in TABLE else "", value, -math.inf, math.inf)
        for name, value in values.items()
        if name not in fixed
    )
    profile = next((p for p, prefix in PREFIXES.items() if any(name.startswith(prefix) for name in values)), "")
    held = {name: values[name] for name in values if name in fixed}
    requires = CHOSEN if profile == ARDUPILOT_CUSTOM else {}
    integers = frozenset({*values, *requires})
    return UploadPlan(settings, held, (), profile=profile, integers=integers, requires=requires)
