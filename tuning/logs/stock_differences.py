"""What a stock controller does that a gains file cannot say: named, never dropped silently."""

from __future__ import annotations

from collections.abc import Mapping

from mimopilot.tuning.logs.stock_controllers import ARDUPILOT, PX4, StockController
from mimopilot.tuning.parameters import YAW_WEIGHT

#: Parameter -> its unit, and what it does where it is not 0.
Effects = Mapping[str, tuple[str, str]]
_PX4: Effects = {
    "MC_YAW_TQ_CUTOFF": ("Hz", "low-pass of the yaw torque; no gain of ours"),
    "MC_BAT_SCALE_EN": ("", "torque and thrust are scaled with the battery's voltage; no gain of ours"),
}
#: PX4's filters of the rates, which stay in effect: they act before any controller.
_PX4_GYRO = ("IMU_GYRO_CUTOFF", "IMU_GYRO_NF0_FRQ", "IMU_GYRO_NF1_FRQ", "IMU_GYRO_DNF_EN")
#: ArduPilot: the same for the end of the name of an axis' parameter (AC_PID.h).
_ARDUPILOT_AXIS: Effects = {
    "FLTT": ("Hz", "low-pass of the rate setpoint; our law has none"),
    "FLTE": ("Hz", "low-pass of the rate error; our law has none"),
    "SMAX": ("", "limit of the slew rate, which lowers P and D; our law has none"),
    "PDMX": ("", "limit of the sum of P and D; our law has none"),
    "D_FF": ("", "feed-forward of the setpoint's derivative; our law has none"),
    "NTF": ("", "notch filter of the setpoint; our law has none"),
    "NEF": ("", "notch filter of the error; our law has none"),
}
_ARDUPILOT: Effects = {
    "ATC_INPUT_TC": ("s", "time constant of the setpoint's shaping; no gain"),
    "ATC_RATE_FF_ENAB": ("", "the rate of the shaped setpoint is fed forward; ours only with model following"),
    "ATC_ACCEL_R_MAX": ("", "limit of the acceleration, roll: a square root replaces the angle P for large errors"),
    "ATC_ACCEL_P_MAX": ("", "limit of the acceleration, pitch: a square root replaces the angle P for large errors"),
    "ATC_ACCEL_Y_MAX": ("", "limit of the acceleration, yaw: a square root replaces the angle P for large errors"),
}
#: ArduPilot's filters of the rates.
_ARDUPILOT_GYRO = ("INS_GYRO_FILTER", "INS_HNTCH_ENABLE", "INS_HNTC2_ENABLE")


def optional_names(stock: StockController) -> tuple[str, ...]:
    """Parameters that `differences` looks at."""
    if stock is PX4:
        return (*_PX4, *_PX4_GYRO, "MAV_TYPE")
    per_axis = [f"ATC_RAT_{axis}_{name}" for axis in ARDUPILOT.axes for name in _ARDUPILOT_AXIS]
    cutoffs = [f"ATC_RAT_{axis}_FLTD" for axis in ARDUPILOT.axes[1:]]
    return (*per_axis, *cutoffs, *_ARDUPILOT, *_ARDUPILOT_GYRO, "FRAME_CLASS")


def differences(stock: StockController, values: Mapping[str, float], exact: bool = False) -> list[str]:
    """One text for each thing that the gains cannot carry over.

    Parameters
    ----------
    stock : StockController
    values : mapping
        All parameters that are known.
    exact : bool
        The gains are for this stock controller itself.
    """
    if exact:  # what its own set holds is not missing from it
        held = {name for axes in stock.filters.values() for name in axes} | set(stock.switches.values())
        values = {name: value for name, value in values.items() if name not in held}
    return _of_px4(values, exact) if stock is PX4 else _of_ardupilot(values, exact)


def _of_px4(values: Mapping[str, float], exact: bool) -> list[str]:
    found = _named(_PX4, values)
    damped = [axis for axis in PX4.axes if values.get(f"MC_{axis}RATE_D", 0)]
    if damped:
        found.append(
            f"D ({', '.join(axis.lower() for axis in damped)}): PX4 differentiates and filters at the sensor's rate, "
            "ours at the control rate, with the same first-order cut-off"
        )
    if damped and exact:
        found[-1] = f"{found[-1].partition(':')[0]}: PX4 filters at the gyro's rate, here at the control rate"
    ours = "" if exact else "; ours does not"
    found.append(f"PX4 integrates less when the rate error is large (none at 400 deg/s){ours}")
    found += _gyro(_PX4_GYRO, values)
    return found


def _of_ardupilot(values: Mapping[str, float], exact: bool) -> list[str]:
    found = [
        text
        for axis in ARDUPILOT.axes
        for text in _named({f"ATC_RAT_{axis}_{name}": what for name, what in _ARDUPILOT_AXIS.items()}, values)
    ]
    own = values.get("ATC_RAT_RLL_FLTD")
    for axis in () if exact else ARDUPILOT.axes[1:]:
        name = f"ATC_RAT_{axis}_FLTD"
        if values.get(f"ATC_RAT_{axis}_D", 0) and values.get(name, own) != own:
            found.append(f"{name} {values[name]:g} Hz: our law has one derivative filter, that of roll ({own:g} Hz)")
    if not exact and any(values.get(f"ATC_RAT_{axis}_D", 0) for axis in ARDUPILOT.axes):
        found.append("D: ArduPilot's acts on the error, ours on the measured rate")
    found += _named(_ARDUPILOT, values)
    for axis, limit in zip("RPY", ARDUPILOT.unlimited["rate_max"], strict=True):
        if values.get(f"ATC_RATE_{axis}_MAX") == 0:
            found.append(f"ATC_RATE_{axis}_MAX 0: no limit; our law needs one, {limit:g} rad/s")
    if not exact:
        found.append(f"yaw_weight {YAW_WEIGHT:g}: our default; ArduPilot has another law for tilt and yaw together")
    found.append("ArduPilot scales torque with battery voltage and air density in its motor library")
    found += _gyro(_ARDUPILOT_GYRO, values)
    return found


def _named(table: Effects, values: Mapping[str, float]) -> list[str]:
    return [
        f"{name} {values[name]:g}{f' {unit}' if unit else ''}: {what}"
        for name, (unit, what) in table.items()
        if values.get(name)
    ]


def _gyro(names: tuple[str, ...], values: Mapping[str, float]) -> list[str]:
    active = [f"{name} {values[name]:g}" for name in names if values.get(name)]
    text = "filters of the gyro are not part of the gains; they must stay as they are on the vehicle"
    return [f"{', '.join(active)}: {text}"] if active else []
