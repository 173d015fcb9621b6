"""The laws of the stock controllers, in the order of their own code, at the control period.

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

import numpy as np

from mimopilot.tuning.first_order_filter import Chain, Filter, Values
from mimopilot.tuning.law_filters import Filters, StockFilters
from mimopilot.tuning.law_terms import ERROR, RATE, SETPOINT, ControlLaw, Term, integral
from mimopilot.tuning.parameters import MODEL, SLEW


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
    "I": Term("Ki_i", ERROR, filter=lambda f: (*_error(f), *integral(f))),
    "D": Term("Kd_i", ERROR, filter=lambda f: (*_error(f), *_difference(_stock(f).derivative_hz, f.Ts))),
    "F": Term("Kff_i", SETPOINT),
    "G": Term(
        "derivative_feedforward",
        SETPOINT,
        filter=lambda f: (Filter(gain=1.0, pole=0.0, difference=True, divisor=f.Ts),),
    ),
}
#: Of PX4.
PX4_LAW = ControlLaw(
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
)
#: Of ArduPilot.
ARDUPILOT_LAW = ControlLaw(
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
)
#: Hz: low-pass of the rate setpoint in Betaflight's angle mode, three first-order ones of a cut-off that many times
#: higher (pid_init.c, ATTITUDE_CUTOFF_HZ; filter.h, CUTOFF_CORRECTION_PT3).
_ANGLE_MODE_HZ = 50.0 * 1.961459177
_BETAFLIGHT_TERMS = {
    "P": Term("Kp_i", ERROR),
    "I": Term("Ki_i", ERROR, filter=integral),
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
#: Of Betaflight, in angle mode.
BETAFLIGHT_LAW = ControlLaw(
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
)
