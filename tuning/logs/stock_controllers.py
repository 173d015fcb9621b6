"""The controllers of PX4, ArduPilot and Betaflight: which of their parameters is which of our gains."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

from mimopilot.tuning.control_laws import LAWS
from mimopilot.tuning.gains import Limits
from mimopilot.tuning.law_filters import ARDUPILOT_STOCK, BETAFLIGHT, PX4_STOCK, StockFilters
from mimopilot.tuning.parameter_row import AXIS_LETTERS, Row, Shape


@dataclass(frozen=True)
class StockController:
    """Parameters of an autopilot's own controller.

    Attributes
    ----------
    name : str
        The autopilot.
    axes : tuple of 3 str
        Its names of roll, pitch and yaw.
    gains : mapping
        Matrix -> parameter of an axis; empty: it has none, the gain is 0.
    factor : str
        Parameter of an axis that multiplies the rate terms; empty: none.
    limits : mapping
        Limit -> for each axis its parameter, the factor to our unit, and the value where it is not logged (NaN: not
        known).
    cutoffs : mapping
        Cut-off of a filter -> parameter, Hz.
    rate : str
        Parameter of the control rate, Hz.
    profile : str
        Its law, a key of `tuning.control_laws.LAWS`.
    filters : mapping
        Filter of its law -> parameter for roll, pitch and yaw; empty: none.
    later : tuple of str
        Parameters that earlier versions do not have, and do not need: their filter or gain is 0.
    scalars : mapping
        Scalar of our table -> parameter.
    unlimited : mapping
        Limit -> value where the parameter is 0, which means that there is no limit.
    switches : mapping
        Filter -> parameter without which it is off.
    fixed : mapping
        Element of the table -> value where it has no parameter.
    """

    name: str
    axes: tuple[str, str, str]
    gains: Mapping[str, str]
    factor: str
    limits: Mapping[str, list[tuple[str, float, float]]]
    cutoffs: Mapping[str, str]
    rate: str
    profile: str
    filters: Mapping[str, tuple[str, str, str]]
    later: tuple[str, ...]
    scalars: Mapping[str, str] = field(default_factory=dict)
    unlimited: Mapping[str, tuple[float, ...]] = field(default_factory=dict)
    switches: Mapping[str, str] = field(default_factory=dict)
    fixed: Mapping[str, float] = field(default_factory=dict)

    @property
    def filter_names(self) -> list[str]:
        """Parameters of the filters that every version has."""
        names = [name for axes in self.filters.values() for name in axes if name and name not in self.later]
        return list(dict.fromkeys(names))

    def stock_filters(self, values: Mapping[str, float]) -> StockFilters:
        """The filters of its law; `values` hold all `filter_names`."""
        on = {name: axes for name, axes in self.filters.items() if values.get(self.switches.get(name, ""), 1.0)}
        return StockFilters(
            self.profile,
            **{name: tuple(values.get(one, 0.0) for one in axes) for name, axes in on.items()},
        )

    def shaping(self, values: Mapping[str, float]) -> float:
        """Time constant (s) of the setpoint's shaping whose rate is fed forward; 0: neither."""
        name = self.filters.get("shaping_s", ("",))[0]
        return values.get(name, 0.0) if values.get(self.switches.get("shaping_s", ""), 1.0) else 0.0

    def maps(self, row: Row) -> bool:
        """Whether it has parameters for a row of our table."""
        return any(row.key in table for table in (self.gains, self.limits, self.cutoffs, self.scalars))

    def names(self, row: Row, code: str) -> tuple[str, ...]:
        """Parameters that an element of a row is made of; the first is its own, the others are factors."""
        if row.shape in (Shape.POLE, Shape.SCALAR):
            table = self.cutoffs if row.shape is Shape.POLE else self.scalars
            return (table[row.key],) if row.key in table else ()
        *_, letters = code.rpartition("_")
        if letters[0] != letters[-1] or not self.maps(row):
            return ()
        axis = AXIS_LETTERS.index(letters[0])
        if row.shape is Shape.AXES:
            name = self.limits[row.key][axis][0]
            return (name,) if name else ()
        own = "" if code in self.fixed else self.gains[row.key].format(axis=self.axes[axis])
        if not own:
            return ()
        return (own, self.factor.format(axis=self.axes[axis])) if self.factor and row.key in _SCALED else (own,)

    def value(self, row: Row, code: str, values: Mapping[str, float]) -> float:
        """What it has for an element of a row, in the unit of the gains file; NaN where `values` do not tell."""
        names = self.names(row, code)
        if row.shape is Shape.POLE:
            return values.get(names[0], row.default or 0.0) if names else row.default or 0.0
        if row.shape is Shape.SCALAR:
            default = math.nan if row.default is None else row.default
            return values.get(names[0], default) if names else default
        if row.shape is Shape.AXES:
            axis = AXIS_LETTERS.index(code[-1])
            name, factor, default = self.limits[row.key][axis]
            return factor * values.get(name, default) or self.unlimited.get(row.key, (0.0, 0.0, 0.0))[axis]
        if row.key not in self.gains:
            return math.nan
        if not names:
            return self.fixed.get(code, 0.0)
        own, *factors = names
        step = LAWS[self.profile].step.get(row.key, 1.0)
        return math.prod(values.get(name, 1.0) for name in factors) * step * values.get(own, math.nan)


_DEGREE = math.pi / 180
#: The rate terms that PX4's factor K multiplies (MulticopterRateControl::parameters_updated): not the feed-forward.
_SCALED = ("Kp_i", "Ki_i", "Kd_i")
_PX4_AXES = ("ROLL", "PITCH", "YAW")
PX4 = StockController(
    name="PX4",
    axes=_PX4_AXES,
    gains={
        "Kp_o": "MC_{axis}_P",
        "Kp_i": "MC_{axis}RATE_P",
        "Ki_i": "MC_{axis}RATE_I",
        "Kd_i": "MC_{axis}RATE_D",
        "Kff_i": "MC_{axis}RATE_FF",
    },
    factor="MC_{axis}RATE_K",
    limits={
        "rate_max": [(f"MC_{axis}RATE_MAX", _DEGREE, math.nan) for axis in _PX4_AXES],
        "moment_max": [("", 1.0, 1.0)] * 3,
        "integral_max": [(name, 1.0, math.nan) for name in ("MC_RR_INT_LIM", "MC_PR_INT_LIM", "MC_YR_INT_LIM")],
    },
    cutoffs={"derivative_cutoff_hz": "IMU_DGYRO_CUTOFF"},
    rate="IMU_GYRO_RATEMAX",
    profile=PX4_STOCK,
    filters={"derivative_hz": ("IMU_DGYRO_CUTOFF",) * 3, "torque_hz": ("", "", "MC_YAW_TQ_CUTOFF")},
    later=("MC_YAW_TQ_CUTOFF",),
    scalars={"yaw_weight": "MC_YAW_WEIGHT"},
)
_ARDUPILOT_AXES = ("RLL", "PIT", "YAW")


def _of_axes(name: str) -> tuple[str, str, str]:
    roll, pitch, yaw = (f"ATC_RAT_{axis}_{name}" for axis in _ARDUPILOT_AXES)
    return roll, pitch, yaw


ARDUPILOT = StockController(
    name="ArduPilot",
    axes=_ARDUPILOT_AXES,
    gains={
        "Kp_o": "ATC_ANG_{axis}_P",
        "Kp_i": "ATC_RAT_{axis}_P",
        "Ki_i": "ATC_RAT_{axis}_I",
        "Kd_i": "ATC_RAT_{axis}_D",
        "Kff_i": "ATC_RAT_{axis}_FF",
    },
    factor="",
    limits={
        "rate_max": [(f"ATC_RATE_{letter}_MAX", _DEGREE, 0.0) for letter in AXIS_LETTERS],
        "moment_max": [("", 1.0, 1.0)] * 3,
        "integral_max": [(f"ATC_RAT_{axis}_IMAX", 1.0, math.nan) for axis in _ARDUPILOT_AXES],
    },
    cutoffs={"derivative_cutoff_hz": "ATC_RAT_RLL_FLTD"},
    rate="SCHED_LOOP_RATE",
    profile=ARDUPILOT_STOCK,
    filters={
        "derivative_hz": _of_axes("FLTD"),
        "setpoint_hz": _of_axes("FLTT"),
        "error_hz": _of_axes("FLTE"),
        "derivative_feedforward": _of_axes("D_FF"),
        "shaping_s": ("ATC_INPUT_TC",) * 3,
    },
    later=(*_of_axes("D_FF"), "ATC_INPUT_TC"),
    unlimited={"rate_max": Limits().rate_max},
    switches={"shaping_s": "ATC_RATE_FF_ENAB"},
)

_BETAFLIGHT_AXES = ("roll", "pitch", "yaw")
BETAFLIGHT_STOCK = StockController(
    name="Betaflight",
    axes=_BETAFLIGHT_AXES,
    gains={
        "Kp_o": "angle_p_gain",
        "Kp_i": "p_{axis}",
        "Ki_i": "i_{axis}",
        "Kd_i": "d_{axis}",
        "Kff_i": "",  # its feed-forward follows the speed of the sticks
    },
    factor="",
    limits={
        "rate_max": [(f"{axis}_rate_limit", _DEGREE, math.nan) for axis in _BETAFLIGHT_AXES],
        "moment_max": [(name, 1e-3, math.nan) for name in ("pidsum_limit", "pidsum_limit", "pidsum_limit_yaw")],
        "integral_max": [(name, 1e-3, math.nan) for name in ("iterm_limit", "iterm_limit", "iterm_limit_yaw")],
    },
    cutoffs={},
    rate="pid_loop_hz",
    profile=BETAFLIGHT,
    filters={
        "derivative_hz": ("dterm_lpf1_static_hz",) * 3,
        "derivative2_hz": ("dterm_lpf2_static_hz",) * 3,
    },
    later=(),
    # It holds no heading: the smallest gain that a set can have.
    fixed={"AP_YY": 0.01},
)
_STOCKS = {"ATC_RAT_RLL_P": ARDUPILOT, "p_roll": BETAFLIGHT_STOCK}


def stock_of(values: Mapping[str, float]) -> StockController:
    """The controller whose parameters these are; PX4's if they do not tell."""
    return next((stock for name, stock in _STOCKS.items() if name in values), PX4)
