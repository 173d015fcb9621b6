"""The first gains file of a vehicle, from the stock gains in its parameters.

The mapping is that of the logs, `tuning.logs.flown_gains`. Here every parameter that it needs must be known: none gets
a default unless the user names a set of defaults.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from mimopilot.common.errors import check_choice
from mimopilot.common.files import check_file, read_bytes, sha256
from mimopilot.tuning.acceptance import check_ranges
from mimopilot.tuning.errors import TuningError
from mimopilot.tuning.gains import Gains, Triple
from mimopilot.tuning.law_filters import MIMO
from mimopilot.tuning.logs.flown_gains import flown_gains
from mimopilot.tuning.logs.formats import log_format
from mimopilot.tuning.logs.parameter_file import read_parameter_file
from mimopilot.tuning.logs.reader import open_log
from mimopilot.tuning.logs.resample import sampling_period
from mimopilot.tuning.logs.stock_controllers import ARDUPILOT, PX4, StockController
from mimopilot.tuning.logs.stock_differences import differences, optional_names
from mimopilot.tuning.logs.vehicle_type import ardupilot_vehicle, px4_vehicle
from mimopilot.tuning.parameter_row import PREFIX, Shape
from mimopilot.tuning.parameters import IDENTITY, ROWS
from mimopilot.tuning.provenance import Provenance

#: Sets of defaults that a user may name -> the parameters of PX4's reference (v1.16.2, parameters.json; the rate is
#: that of rc.mc_defaults for multirotors). Airframes set others.
DEFAULTS: dict[str, dict[str, float]] = {
    "px4-v1.16": {
        **{f"MC_{axis}_P": 6.5 for axis in ("ROLL", "PITCH")},
        "MC_YAW_P": 2.8,
        "MC_YAW_WEIGHT": 0.4,
        **{f"MC_{axis}RATE_P": 0.15 for axis in ("ROLL", "PITCH")},
        **{f"MC_{axis}RATE_I": 0.2 for axis in ("ROLL", "PITCH")},
        **{f"MC_{axis}RATE_D": 0.003 for axis in ("ROLL", "PITCH")},
        **{f"MC_{axis}RATE_MAX": 220.0 for axis in ("ROLL", "PITCH")},
        "MC_YAWRATE_P": 0.2,
        "MC_YAWRATE_I": 0.1,
        "MC_YAWRATE_D": 0.0,
        "MC_YAWRATE_MAX": 200.0,
        **{f"MC_{axis}RATE_{term}": value for axis in PX4.axes for term, value in (("FF", 0.0), ("K", 1.0))},
        **dict.fromkeys(("MC_RR_INT_LIM", "MC_PR_INT_LIM", "MC_YR_INT_LIM"), 0.3),
        "MC_YAW_TQ_CUTOFF": 2.0,
        "IMU_DGYRO_CUTOFF": 30.0,
        "IMU_GYRO_CUTOFF": 40.0,
        "IMU_GYRO_RATEMAX": 800.0,
    }
}
#: Parameters that are whole numbers on a vehicle.
INTEGERS = frozenset(
    {PX4.rate, ARDUPILOT.rate, "MC_BAT_SCALE_EN", "IMU_GYRO_DNF_EN", "MAV_TYPE", "FRAME_CLASS", "ATC_RATE_FF_ENAB"}
    | {"INS_HNTCH_ENABLE", "INS_HNTC2_ENABLE", "INS_GYRO_FILTER"}
    | {f"ATC_RAT_{axis}_{notch}" for axis in ARDUPILOT.axes for notch in ("NTF", "NEF")}
)
#: Largest relative difference of the rate in the parameters from that of a log: loggers' clocks differ by less.
SAME_RATE = 0.02
#: Parameters that only ArduPlane and ArduSub have.
_PLANE, _SUB = ("RLL2SRV_TCONST", "RLL_RATE_P", "Q_ENABLE"), ("JS_GAIN_DEFAULT", "FRAME_CONFIG")


@dataclass(frozen=True)
class ParameterSource:
    """Parameters of a vehicle, and where they come from.

    Attributes
    ----------
    name : str
        File, or address of the vehicle.
    kind : str
        ``parameter file``, ``flight log`` or ``vehicle``.
    values : mapping
        Name -> value.
    sha256 : str
        Hash of the file; of a vehicle of the parameters that were read.
    period : float or None, s
        Period at which a log holds the body rates.
    warnings : tuple of str
    """

    name: str
    kind: str
    values: Mapping[str, float]
    sha256: str
    period: float | None = None
    warnings: tuple[str, ...] = ()


@dataclass(frozen=True)
class ImportedGains:
    """The gains of a stock controller.

    Attributes
    ----------
    gains : Gains
    stock : StockController
    used : mapping
        Parameter -> value, of all that the gains are made of.
    defaults : tuple of str
        Those of them that are a default.
    not_carried : tuple of str
        What the stock controller does that the gains do not hold.
    warnings : tuple of str
    """

    gains: Gains
    stock: StockController
    used: Mapping[str, float]
    defaults: tuple[str, ...]
    not_carried: tuple[str, ...]
    warnings: tuple[str, ...]


def read_source(path: Path) -> ParameterSource:
    """Parameters in a flight log or a parameter file; the content decides, not the name.

    Raises
    ------
    Error
        When the file cannot be read, is neither, or is a log of another vehicle than a multirotor.
    """
    check_file(path, "a parameter file or a flight log", TuningError)
    found, _ = log_format(path)
    if found is None or (found.takes_columns and ".csv" in found.suffixes):  # parameter files have commas, too
        values = {name: entry.value for name, entry in read_parameter_file(path).items()}
        return ParameterSource(path.name, "parameter file", values, sha256(read_bytes(path, "parameter file")))
    if found.takes_columns:
        raise TuningError(f"{path}: a {found.name} file holds no parameters; give a parameter file, a ULog or a .bin")
    return _read_log(path)


def _read_log(path: Path) -> ParameterSource:
    log = open_log(path)
    if log.faults:
        raise TuningError(f"{path}: {'; '.join(log.faults)}")
    values, used = dict(log.parameters), {*needed_names(PX4), *needed_names(ARDUPILOT)}
    changed = []
    for _, name, value in log.changes:
        if name in used and values.get(name) != value:
            changed.append(f"{name} from {values.get(name, np.nan):.6g} to {value:.6g}")
        values[name] = value
    rates = log.signals.get("y_i")
    period = sampling_period(rates.time) if rates is not None and len(rates.time) > 2 else None
    text = f"parameters changed in the log, the last values are used: {'; '.join(changed)}"
    warnings = (*log.warnings, *((text,) if changed else ()))
    return ParameterSource(path.name, "flight log", values, sha256(path.read_bytes()), period, warnings)


def needed_names(stock: StockController) -> list[str]:
    """Every parameter that the gains are made of, the control rate last."""
    names = [name for row in ROWS for code in row.codes for name in stock.names(row, code)]
    return [*dict.fromkeys(names), stock.rate]


def vehicle_names(stock: StockController) -> tuple[list[str], list[str]]:
    """Parameters to read from a vehicle: those that it must have, and others."""
    others = [name for name in stock.filter_names if name not in needed_names(stock)]
    return needed_names(stock), [*others, *optional_names(stock), *(parameter.name for parameter in IDENTITY)]


def import_gains(
    source: ParameterSource,
    *,
    defaults: str | None = None,
    rate: float | None = None,
    moment_scale: Triple | None = None,
    profile: str = MIMO,
) -> ImportedGains:
    """The gains of a stock controller, for our law or as the stock set itself.

    Parameters
    ----------
    source : ParameterSource
    defaults : str, optional
        Key of `DEFAULTS`, for parameters that the source does not have.
    rate : float, optional, Hz
        Control rate; by default that of the parameters.
    moment_scale : tuple of 3 float, optional, N m
        Torque of u = 1 on the vehicle. By default what it publishes, else not known.
    profile : str
        ``mimo``: for our law. Else the stock set, in its own law; it must be that of the source.

    Raises
    ------
    TuningError
        When the source holds no gains of a multirotor, lacks a parameter, or a value is not possible.
    """
    if defaults is not None:
        check_choice("--defaults", defaults, DEFAULTS, TuningError)
    # The module's own gains may be on the vehicle, too: it is the stock ones that are wanted.
    values = {name: float(str(np.float32(v))) for name, v in source.values.items() if not name.startswith(PREFIX)}
    stock = _stock_controller(values, source)
    if defaults is not None and stock is not PX4:
        raise TuningError(f"--defaults {defaults}: {source.name} is of {stock.name}; leave it out")
    if profile not in (MIMO, stock.profile):
        known = f"{MIMO} or {stock.profile}"
        raise TuningError(f"--profile: got {profile!r}, but {source.name} is of {stock.name}: give {known}")
    exact = profile != MIMO
    wanted = [*needed_names(stock), *(stock.filter_names if exact else ())]
    needed = [name for name in dict.fromkeys(wanted) if not (rate is not None and name == stock.rate)]
    missing = [name for name in needed if name not in values]
    if missing and defaults is None:
        advice = "read it from the vehicle (--connect), or save all parameters, not only those that were changed"
        known = f", or accept the autopilot's own with --defaults {' or '.join(DEFAULTS)}" if stock is PX4 else ""
        raise TuningError(f"{source.name}: lacks {', '.join(missing)}; no gain gets a silent default: {advice}{known}")
    complete = {**DEFAULTS.get(defaults or "", {}), **values}
    hertz = complete[stock.rate] if rate is None else rate
    if not 0 < hertz < np.inf:
        raise TuningError(f"{'--rate' if rate else stock.rate}: got {hertz:g} Hz, expected more than 0")
    _check_values(stock, complete, source)
    found = flown_gains(complete, 1 / hertz)
    if found is not None and not exact:
        found = found.for_our_law()
    if found is None:
        raise TuningError(f"{source.name}: {hertz:g} Hz: our law cannot run at this control rate; give another --rate")
    warnings = [*source.warnings, *_doubts(source, stock, hertz, rate is not None)]
    not_carried = differences(stock, complete, exact)
    scale = moment_scale or _published_scale(source.values)
    if scale is None:
        warnings.append("the torque of u = 1 is not known: moment_scale is unknown, and fly and upload ask for it")
    details: dict[str, Any] = {"source": f"{stock.name}, {source.kind} {source.name}", "source_sha256": source.sha256}
    if missing:
        details |= {"defaults": defaults, "defaulted": missing}
        warnings.append(f"{len(missing)} values are defaults of {defaults}; those of the vehicle's airframe may differ")
    details["not_carried"] = not_carried
    gains = replace(found, moment_scale=scale, provenance=Provenance("imported", details=details))
    try:
        check_ranges(gains.for_our_law())
    except TuningError as error:
        warnings.append(f"{error}: generate and upload will refuse it")
    used = {name: complete[name] for name in needed}
    return ImportedGains(gains, stock, used, tuple(missing), tuple(not_carried), tuple(warnings))


def _stock_controller(values: Mapping[str, float], source: ParameterSource) -> StockController:
    """The controller that the parameters belong to; refuses those of other vehicles."""
    no_gains = f"{source.name}: holds no gains of a multirotor (MC_ROLLRATE_P of PX4, ATC_RAT_RLL_P of ArduPilot)"
    if any(name.startswith(PREFIX) for name in source.values):
        no_gains += f"; those of our own module ({PREFIX}*) are not imported"
    if any(name in values for name in _PLANE):
        raise TuningError(f"{source.name}: parameters of ArduPlane; gains are for multirotors (ArduCopter, PX4) only")
    if any(name in values for name in _SUB):
        raise TuningError(f"{source.name}: parameters of ArduSub; gains are for multirotors (ArduCopter, PX4) only")
    gains = {
        stock.name: stock
        for stock in (PX4, ARDUPILOT)
        if any(name in values for name in needed_names(stock) if name.startswith(("MC_", "ATC_")))
    }
    if len(gains) != 1:
        both = f"{source.name}: holds gains of PX4 and of ArduPilot; give the parameters of one vehicle"
        raise TuningError(both if gains else no_gains)
    (stock,) = gains.values()
    if source.kind != "flight log":  # the reader of logs has looked at the messages, too
        kind = px4_vehicle({}, values) if stock is PX4 else ardupilot_vehicle((), values, None)
        if kind.fault and "VTOL" not in kind.fault:
            raise TuningError(f"{source.name}: of {kind.fault}; gains are for multirotors only")
    return stock


def _check_values(stock: StockController, values: Mapping[str, float], source: ParameterSource) -> None:
    """Refuse a value that our law cannot have, by the name of its parameter."""
    for row in ROWS:
        for code in row.codes:
            names = stock.names(row, code)
            if not names:
                continue
            value = stock.value(row, code, values)
            holds = np.isfinite(value) and value >= 0 if row.shape is Shape.POLE else row.valid.holds(value)
            if not holds:
                expected = "at least 0" if row.shape is Shape.POLE else str(row.valid)
                raise TuningError(
                    f"{source.name}: {names[0]}: got {values[names[0]]:g}, expected {expected} ({row.description})"
                )


def _doubts(source: ParameterSource, stock: StockController, hertz: float, given: bool) -> list[str]:
    if given or source.period is None or abs(source.period * hertz - 1) <= SAME_RATE:
        return []
    return [
        f"the rates are logged every {source.period:g} s, {stock.rate} is {hertz:g} Hz: the log leaves out samples, or "
        f"the vehicle is slower, as simulators are; if so give --rate {1 / source.period:.0f}"
    ]


def _published_scale(values: Mapping[str, float]) -> Triple | None:
    known = [float(str(np.float32(values[p.name]))) for p in IDENTITY if p.name in values]
    return None if len(known) < len(IDENTITY) else (known[0], known[1], known[2])
