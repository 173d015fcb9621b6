"""The control laws that gains are made for, as tables of terms: ours, and those of PX4, ArduPilot and Betaflight.

Each term is a gain matrix, the signal that it acts on and a chain of first-order filters. `tuning.law` derives every
response from the table of the set's law, so all of tuning holds for each of them.

The stock laws, in the order of their own code, at the control period:

- PX4 v1.16 (MulticopterRateControl.cpp, rate_control.cpp, VehicleAngularVelocity.cpp): the integral that counts is that
  of the period before; D is the difference of the gyro's rate behind a first-order low-pass (IMU_DGYRO_CUTOFF), at the
  gyro's own rate: a gyro that is sampled faster than the controller runs lags a little less. Yaw torque is low-passed
  (MC_YAW_TQ_CUTOFF).
- ArduCopter 4.6 (AC_PID.cpp, AC_AttitudeControl_Multi.cpp): low-pass of the setpoint (FLTT) and of the error (FLTE); D
  is the filtered error's difference behind a low-pass (FLTD); feed-forward of the filtered setpoint and its difference.
  With ATC_RATE_FF_ENAB the attitude setpoint is shaped (attitude_command_model in AC_AttitudeControl.cpp and
  shape_pos_vel_accel in control.cpp, 4.8): below its limits of acceleration and jerk, with x the shaped setpoint, s the
  given one and T = ATC_INPUT_TC, T^2 x'' = s - x - 2 T x', critically damped. x is what the log holds as setpoint, and
  x' is added to the rate setpoint.

Both run the rate controller before the attitude controller in a period, so a rate setpoint acts one period later. The
logged rate is that behind the gyro's own filters (IMU_GYRO_CUTOFF, INS_GYRO_FILTER): those are part of the measured
plant.

- Betaflight 2025.12 (pid.c, pid_init.c, filter.c), in angle mode: the rate setpoint passes a third-order low-pass of
  50 Hz (ATTITUDE_CUTOFF_HZ) and acts in the same period; D is the difference of the gyro's rate behind two first-order
  low-passes (dterm_lpf1, dterm_lpf2). Its feed-forward follows the sticks' speed in acro mode: it is outside of the
  loop. Gains are whole numbers in units of pid.h.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from mimopilot.tuning.errors import TuningError
from mimopilot.tuning.first_order_filter import Chain, Filter, Values
from mimopilot.tuning.parameter_row import AXES, NOT_NEGATIVE, pole_of
from mimopilot.tuning.parameters import MODEL, SLEW, YAW_WEIGHT
from mimopilot.tuning.reference_model import ReferenceModel, followed_model

#: Signals of the rate controller that a term can act on.
ERROR, RATE, SETPOINT = "error", "rate", "setpoint"
#: Signals of the attitude model that a term can act on: outside of the loop.
MODEL_RATE, MODEL_ACCELERATION = "model rate", "model acceleration"
#: Names of the laws; those of the stock ones are also the profiles of an upload.
MIMO, PX4_STOCK, ARDUPILOT_STOCK, BETAFLIGHT = "mimo", "px4-stock", "ardupilot-stock", "betaflight"


@dataclass(frozen=True)
class StockFilters:
    """Filters and fixed gains of a stock law, each for roll, pitch, yaw.

    Attributes
    ----------
    controller : str
        Key of `LAWS`.
    derivative_hz, setpoint_hz, error_hz, torque_hz, derivative2_hz : tuple of float, Hz
        Cut-offs of the first-order low-passes of the derivative, the rate setpoint, the rate error and the torque, and
        of a second one of the derivative; 0: no filter.
    derivative_feedforward : tuple of float, s^2
        Torque from the derivative of the rate setpoint.
    shaping_s : tuple of float, s
        Time constant of the attitude setpoint's shaping, whose rate is fed forward; 0: neither.
    """

    controller: str
    derivative_hz: tuple[float, ...]
    setpoint_hz: tuple[float, ...] = (0.0, 0.0, 0.0)
    error_hz: tuple[float, ...] = (0.0, 0.0, 0.0)
    torque_hz: tuple[float, ...] = (0.0, 0.0, 0.0)
    derivative_feedforward: tuple[float, ...] = (0.0, 0.0, 0.0)
    shaping_s: tuple[float, ...] = (0.0, 0.0, 0.0)
    derivative2_hz: tuple[float, ...] = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        for name in STOCK_FILTERS:
            for axis, value in zip(AXES, getattr(self, name), strict=False):
                if not NOT_NEGATIVE.holds(value):
                    raise TuningError(f"filters.{name} ({axis}): got {value}, expected {NOT_NEGATIVE}")

    def on(self, axes: slice, yaw_unit: float = 1.0) -> StockFilters:
        """The filters of some axes, see `Filters.on`."""
        found = replace(self, **{name: getattr(self, name)[axes] for name in STOCK_FILTERS})
        *others, yaw = found.derivative_feedforward
        return found if yaw_unit == 1.0 else replace(found, derivative_feedforward=(*others, yaw / yaw_unit))


#: Names of the filters and fixed gains.
STOCK_FILTERS = (
    "derivative_hz",
    "setpoint_hz",
    "error_hz",
    "torque_hz",
    "derivative_feedforward",
    "shaping_s",
    "derivative2_hz",
)
#: Those that were not known from the beginning: at 0 they change no certificate.
LATER_FILTERS = ("shaping_s", "derivative2_hz")


@dataclass(frozen=True)
class Filters:
    """Period, filters and attitude model of the law.

    Attributes
    ----------
    Ts : float, s
        Control period.
    derivative_cutoff_hz : float, Hz
        Cut-off f_d of our law's first-order derivative filter; 0 means no filter. Stock laws have theirs in `stock`.
    model_omega : float, rad/s
        Natural frequency of the attitude model; 0 means no model following.
    model_damping : float
        Damping ratio of the attitude model.
    yaw_weight : float
        Weight of the yaw error in the attitude error, above 0 and at most 1.
    setpoint_slew : float, rad/s
        Slew limit of the attitude setpoint; 0 means none.
    stock : StockFilters or None
        The stock law that the gains are for. None: ours.
    shaping_s : float, s
        Of our law where ArduPilot gives its setpoints: time constant of their shaping; their rate is fed forward. 0:
        neither. It is outside of the loop.
    """

    Ts: float
    derivative_cutoff_hz: float = 0.0
    model_omega: float = 0.0
    model_damping: float = 0.7
    yaw_weight: float = YAW_WEIGHT
    setpoint_slew: float = 0.0
    stock: StockFilters | None = None
    shaping_s: float = 0.0

    @property
    def derivative_pole(self) -> float:
        """Pole a = exp(-2 pi f_d Ts) of our derivative filter; 0 when f_d = 0."""
        return pole_of(self.derivative_cutoff_hz, self.Ts)

    @property
    def followed(self) -> ReferenceModel | None:
        """Attitude model of roll and of pitch; None: no model following."""
        return followed_model(self.model_omega, self.model_damping, self.Ts) if self.model_omega else None

    @property
    def shaping(self) -> tuple[float, ...]:
        """Time constant (s) of the autopilot's shaping of the setpoint, for each axis; 0: none."""
        return (self.shaping_s,) * 3 if self.stock is None else self.stock.shaping_s

    @property
    def law(self) -> ControlLaw:
        """The law of the gains."""
        return LAWS[MIMO if self.stock is None else self.stock.controller]

    def on(self, axes: slice, yaw_unit: float = 1.0) -> Filters:
        """The filters of some axes: 0 roll, 1 pitch, 2 yaw, the last with another unit of torque."""
        return self if self.stock is None else replace(self, stock=self.stock.on(axes, yaw_unit))


@dataclass(frozen=True)
class Term:
    """One term of the rate controller.

    Attributes
    ----------
    matrix : str
        Name of its gain matrix in `tuning.gains.Gains`, or of a fixed gain in `StockFilters`.
    signal : str
        Signal that it acts on: `ERROR`, `RATE`, `SETPOINT`, `MODEL_RATE` or `MODEL_ACCELERATION`.
    sign : int
        Sign with which it is added to u.
    filter : callable
        `Filters` -> its filters, the first one first; empty: none.
    """

    matrix: str
    signal: str
    sign: int = 1
    filter: Callable[[Filters], Chain] = lambda filters: ()


@dataclass(frozen=True)
class ControlLaw:
    """One control law.

    Attributes
    ----------
    terms : mapping
        Letter -> term of the rate loop, in the order of its regressors and its sums.
    text : tuple of str
        The law in the comments of a gains file.
    coupled : bool
        Whether it has off-diagonal gains.
    setpoint : callable
        `Filters` -> filters of the rate setpoint, before every term.
    delay : int
        Periods after which a rate setpoint of the attitude controller acts.
    filters : tuple of str
        What it has of `STOCK_FILTERS`.
    lacks : tuple of str
        Keys of the parameter table that it does not have.
    largest : mapping
        Gain -> largest value that the autopilot accepts: roll, pitch, yaw. None: the ranges of our parameter table.
    step : mapping
        Gain -> value of 1 on an autopilot whose gains are whole numbers; empty: they are not.
    shared : tuple of str
        Gains that are one number for roll and pitch.
    """

    terms: Mapping[str, Term]
    text: tuple[str, ...]
    coupled: bool = False
    setpoint: Callable[[Filters], Chain] = lambda filters: ()
    delay: int = 1
    filters: tuple[str, ...] = ()
    lacks: tuple[str, ...] = field(default=("derivative_cutoff_hz", "Kff_o", "Kaff_i", SLEW, "model_damping", MODEL))
    largest: Mapping[str, tuple[float, float, float]] | None = None
    step: Mapping[str, float] = field(default_factory=dict)
    shared: tuple[str, ...] = ()


def _integral(filters: Filters) -> Chain:
    return (Filter(gain=filters.Ts, pole=1.0),)


def _derivative(filters: Filters) -> Chain:
    a = filters.derivative_pole
    return (Filter(gain=1 - a, pole=a, difference=True, divisor=filters.Ts),)


#: Letter -> term of our law.
TERMS = {
    "P": Term("Kp_i", ERROR),
    "I": Term("Ki_i", ERROR, filter=_integral),
    "D": Term("Kd_i", RATE, -1, _derivative),
    "F": Term("Kff_i", SETPOINT),
    "A": Term("Kaff_i", MODEL_ACCELERATION),
}
#: Those on signals of the rate loop. Tuning estimates them; the others do not change its stability. Every law has gains
#: of these letters and names.
LOOP_TERMS = {letter: term for letter, term in TERMS.items() if term.signal in (ERROR, RATE, SETPOINT)}


def _stock(filters: Filters) -> StockFilters:
    assert filters.stock is not None  # the term is in a stock law
    return filters.stock


def _pole(cutoffs: tuple[float, ...], Ts: float) -> Values:
    """Pole of y += a (x - y), a = Ts / (Ts + 1 / (2 pi f)): both autopilots' low-pass; 0 when f = 0."""
    poles = 1 / (1 + 2 * np.pi * np.array(cutoffs) * Ts) * (np.array(cutoffs) > 0)
    return float(poles[0]) if np.all(poles == poles[0]) else poles


def _low_pass(cutoffs: tuple[float, ...], Ts: float) -> Chain:
    pole = _pole(cutoffs, Ts)
    return (Filter(gain=1 - pole, pole=pole),) if np.any(pole) else ()


def _difference(cutoffs: tuple[float, ...], Ts: float) -> Chain:
    pole = _pole(cutoffs, Ts)
    return (Filter(gain=1 - pole, pole=pole, difference=True, divisor=Ts),)


def _torque(filters: Filters) -> Chain:
    return _low_pass(_stock(filters).torque_hz, filters.Ts)


def _error(filters: Filters) -> Chain:
    return _low_pass(_stock(filters).error_hz, filters.Ts)


def _px4_derivative(filters: Filters) -> Chain:
    # A cut-off from half the rate on switches the filter off.
    cutoffs = tuple(hertz if hertz < 0.5 / filters.Ts else 0.0 for hertz in _stock(filters).derivative_hz)
    return (*_difference(cutoffs, filters.Ts), *_torque(filters))


_PX4_TERMS = {
    "P": Term("Kp_i", ERROR, filter=_torque),
    "I": Term("Ki_i", ERROR, filter=lambda f: (Filter(gain=f.Ts, pole=1.0, delayed=True), *_torque(f))),
    "D": Term("Kd_i", RATE, -1, _px4_derivative),
    "F": Term("Kff_i", SETPOINT, filter=_torque),
}
_ARDUPILOT_TERMS = {
    "P": Term("Kp_i", ERROR, filter=_error),
    "I": Term("Ki_i", ERROR, filter=lambda f: (*_error(f), *_integral(f))),
    "D": Term("Kd_i", ERROR, filter=lambda f: (*_error(f), *_difference(_stock(f).derivative_hz, f.Ts))),
    "F": Term("Kff_i", SETPOINT),
    "G": Term(
        "derivative_feedforward",
        SETPOINT,
        filter=lambda f: (Filter(gain=1.0, pole=0.0, difference=True, divisor=f.Ts),),
    ),
}
#: Hz: low-pass of the rate setpoint in Betaflight's angle mode, three first-order ones of a cut-off that many times
#: higher (pid_init.c, ATTITUDE_CUTOFF_HZ; filter.h, CUTOFF_CORRECTION_PT3).
_ANGLE_MODE_HZ = 50.0 * 1.961459177
_BETAFLIGHT_TERMS = {
    "P": Term("Kp_i", ERROR),
    "I": Term("Ki_i", ERROR, filter=_integral),
    "D": Term(
        "Kd_i",
        RATE,
        -1,
        lambda f: (*_low_pass(_stock(f).derivative2_hz, f.Ts), *_difference(_stock(f).derivative_hz, f.Ts)),
    ),
    "F": Term("Kff_i", SETPOINT),
}
#: Value of 1 on its command line: pid.h, PTERM_SCALE, ITERM_SCALE and DTERM_SCALE for deg/s and a torque of
#: PID_MIXER_SCALING, 1000; pid_init.c, angleGain. The largest numbers are those of settings.c.
_PER_RADIAN = 180 / np.pi / 1000
_BETAFLIGHT_STEP = {
    "Kp_o": 0.1,
    "Kp_i": 0.032029 * _PER_RADIAN,
    "Ki_i": 0.244381 * _PER_RADIAN,
    "Kd_i": 0.000529 * _PER_RADIAN,
    "Kff_i": 1.0,
}
_BETAFLIGHT_LARGEST = {"Kp_o": 200, "Kp_i": 250, "Ki_i": 250, "Kd_i": 250, "Kff_i": 0}
_MIMO_TEXT = (
    "# mimopilot gains. Row: output; column: error; roll then pitch. Positive Kd damps.",
    "# r_i = Kp_o (r_o - y_o);  u = Kp_i (r_i - y_i) + I - Kd_i dy_i/dt + Kff_i r_i,  I += Ts Ki_i (r_i - y_i)",
)
#: Name of a law -> the law.
LAWS = {
    MIMO: ControlLaw(LOOP_TERMS, _MIMO_TEXT, coupled=True, delay=0, lacks=()),
    PX4_STOCK: ControlLaw(
        _PX4_TERMS,
        (
            "# mimopilot gains for PX4's stock controllers: MC_*RATE_P, I, D (K = 1), FF; diagonal, roll then pitch.",
            "# r_i = Kp_o (r_o - y_o);  u = Kp_i (r_i - y_i) + I - Kd_i dy_i/dt + Kff_i r_i, dy_i/dt low-passed at "
            "derivative_hz",
        ),
        filters=("derivative_hz", "torque_hz"),
        # PX4's parameter reference, v1.16; where it has no maximum, that of our table.
        largest={
            "Kp_o": (12.0, 12.0, 5.0),
            "Kp_i": (0.5, 0.6, 0.6),
            "Ki_i": (10.0, 10.0, 10.0),
            "Kd_i": (0.01, 0.5, 0.5),
            "Kff_i": (5.0, 5.0, 5.0),
        },
    ),
    ARDUPILOT_STOCK: ControlLaw(
        _ARDUPILOT_TERMS,
        (
            "# mimopilot gains for ArduPilot's stock controllers: ATC_RAT_*_P, I, D, FF; diagonal, roll then pitch.",
            "# r_i = Kp_o (r_o - y_o) + dr_o/dt, low-passed at setpoint_hz; shaping_s 0: no dr_o/dt;",
            "# e = r_i - y_i, low-passed at error_hz;",
            "# u = Kp_i e + I + Kd_i de/dt + Kff_i r_i + derivative_feedforward dr_i/dt; de/dt at derivative_hz",
        ),
        setpoint=lambda f: _low_pass(_stock(f).setpoint_hz, f.Ts),
        filters=("derivative_hz", "setpoint_hz", "error_hz", "derivative_feedforward", "shaping_s"),
        lacks=("derivative_cutoff_hz", "Kff_o", "Kaff_i", SLEW, "model_damping", MODEL, "yaw_weight"),
        # ArduPilot's parameter reference, ArduCopter 4.6; it enforces none.
        largest={
            "Kp_o": (12.0, 12.0, 12.0),
            "Kp_i": (0.5, 0.5, 2.5),
            "Ki_i": (2.0, 2.0, 1.0),
            "Kd_i": (0.05, 0.05, 0.02),
            "Kff_i": (0.5, 0.5, 0.5),
        },
    ),
    BETAFLIGHT: ControlLaw(
        _BETAFLIGHT_TERMS,
        (
            "# mimopilot gains for Betaflight's own controller in angle mode; diagonal, roll then pitch.",
            "# r_i = Kp_o (r_o - y_o), low-passed at 50 Hz;  u = Kp_i (r_i - y_i) + I - Kd_i dy_i/dt,",
            "# dy_i/dt low-passed at derivative_hz and at derivative2_hz",
        ),
        setpoint=lambda f: 3 * _low_pass((_ANGLE_MODE_HZ,), f.Ts),
        delay=0,
        filters=("derivative_hz", "derivative2_hz"),
        lacks=("derivative_cutoff_hz", "Kff_o", "Kaff_i", SLEW, "model_damping", MODEL, "yaw_weight"),
        largest={name: (most * _BETAFLIGHT_STEP[name],) * 3 for name, most in _BETAFLIGHT_LARGEST.items()},
        step=_BETAFLIGHT_STEP,
        shared=("Kp_o",),
    ),
}

#: The attitude controller, which makes the rate setpoint; its error is that of the angles.
ATTITUDE = Term("Kp_o", ERROR)
#: Its feed-forward from the attitude model.
ATTITUDE_FEEDFORWARD = Term("Kff_o", MODEL_RATE)
