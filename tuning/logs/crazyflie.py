"""Readers of Crazyflie logs: what the firmware's variables mean, in SI units and body FRD.

The firmware's gyro is in deg/s, x forward, y left, z up. Its roll, pitch and yaw are in degrees, pitch positive with
the nose up and yaw positive to the left ("legacy" frame, pitch inverted). Our controller's group ``mimo`` is in SI
units and body FRD already, see `tuning.crazyflie_names`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mimopilot.tuning.crazyflie_names import GROUP, ControllerState
from mimopilot.tuning.errors import TuningError
from mimopilot.tuning.logs.crazyflie_file import (
    FIXED_FREQUENCY,
    LogBlock,
    is_cfclient_csv,
    read_cfclient_csv,
    read_usd_log,
)
from mimopilot.tuning.logs.flight_phase import intersection, intervals
from mimopilot.tuning.logs.formats import HEAD_BYTES
from mimopilot.tuning.logs.recording import Recording
from mimopilot.tuning.logs.resample import Interval, Series

DEGREE = math.pi / 180
#: Torque (normalised) of the stock PID's output: a motor gets half of that of roll or pitch, all of that of yaw, of
#: 65535 (powerDistributionLegacy); u = 1 is half of a motor's thrust.
COMMAND, YAW_COMMAND = 1 / 65535, 2 / 65535

#: A signal's variables, one for each axis, and the factor of each; the first line that a log block holds is used.
Layout = tuple[tuple[str, float], ...]
#: Roll and pitch.
LAYOUTS: Mapping[str, tuple[Layout, ...]] = {
    "u": (
        (("mimo.uR", 1.0), ("mimo.uP", 1.0)),
        (("controller.cmd_roll", COMMAND), ("controller.cmd_pitch", COMMAND)),
    ),
    "y_i": (
        (("mimo.p", 1.0), ("mimo.q", 1.0)),
        (("gyro.x", DEGREE), ("gyro.y", -DEGREE)),
        (("controller.r_roll", 1.0), ("controller.r_pitch", 1.0)),
    ),
    "y_o": (
        (("mimo.roll", 1.0), ("mimo.pitch", 1.0)),
        (("stabilizer.roll", DEGREE), ("stabilizer.pitch", DEGREE)),
        (("stateEstimate.roll", DEGREE), ("stateEstimate.pitch", DEGREE)),
    ),
    "r_o": (
        (("mimo.rollSp", 1.0), ("mimo.pitchSp", 1.0)),
        (("controller.roll", DEGREE), ("controller.pitch", DEGREE)),
    ),
    "r_i": (
        (("mimo.pSp", 1.0), ("mimo.qSp", 1.0)),
        (("controller.rollRate", DEGREE), ("controller.pitchRate", DEGREE)),
    ),
    "u_bar": ((("mimo.ubR", 1.0), ("mimo.ubP", 1.0)),),
}
YAW_LAYOUTS: Mapping[str, tuple[Layout, ...]] = {
    "u": ((("mimo.uY", 1.0),), (("controller.cmd_yaw", YAW_COMMAND),)),
    "y_i": ((("mimo.r", 1.0),), (("gyro.z", -DEGREE),), (("controller.r_yaw", -1.0),)),
    "y_o": ((("mimo.yaw", 1.0),), (("stabilizer.yaw", -DEGREE),), (("stateEstimate.yaw", -DEGREE),)),
    "r_o": ((("mimo.yawSp", 1.0),), (("controller.yaw", -DEGREE),)),
    "r_i": ((("mimo.rSp", 1.0),), (("controller.yawRate", -DEGREE),)),
    "u_bar": ((("mimo.ubY", 1.0),),),
}
#: Signals of what flew: not those of our controller while the stock one flies. Rates and angles are the same.
FLOWN = ("u", "u_bar", "r_o", "r_i")
#: Variables that tell whether the vehicle flies, and the bit (supervisor.info: bit 4; sys.isFlying before 2024).
FLYING = (("supervisor.info", 4), ("sys.isFlying", 0))

USD_ADVICE = (
    f"name all of them below on:{FIXED_FREQUENCY}, 500, 1 in the card's config.txt (docs/crazyflie.md has it) and fly "
    "again"
)
CSV_ADVICE = (
    "write the blocks with these variables to files in the same connection; the radio carries at most 26 bytes a block "
    "and 100 Hz: the uSD deck logs all of them at 500 Hz (docs/crazyflie.md)"
)
NOTE = (
    "a Crazyflie's log holds neither the flown gains nor the unit of torque: give moment_scale, [yaw] and "
    "derivative_cutoff_hz in a --spec file"
)
STOCK_NOTE = (
    "the torque is the stock PID's output over 65535, that of yaw over half of it: a share of thrust only if the "
    "firmware compensates the battery"
)
RADIO_NOTE = "each log block over the radio is a sample at 100 Hz or less of a loop at 500 Hz, without a filter before"
#: States in which the stock PID flies.
STOCK_FLIES = (ControllerState.STOCK, ControllerState.OTHER_FIRMWARE)
#: Our controller's setpoint of roll, NaN while rates are flown, and its rate, which is not.
SETPOINT, RATE = f"{GROUP}.rollSp", f"{GROUP}.p"
#: What flies, as our controller logs it; and the whole log.
STATUS, ALWAYS = f"{GROUP}.state", ((-math.inf, math.inf),)
STOCK_FLEW = (
    f"according to {STATUS} the stock PID flew, our controller gave no torque; set {GROUP}.EN to 1 on the ground, "
    f"and see that {STATUS} is {ControllerState.FLIES.value} before the take-off"
)
UNKNOWN_FLEW = (
    f"{STATUS} is {ControllerState.WAITING.value} from the begin of the log on, so it does not tell whether our "
    "controller flew; start logging (usd.logging 1) on the ground"
)
ANOTHER_SET = {
    ControllerState.CHANGED: "a parameter had changed since",
    ControllerState.REFUSED: "the parameters were refused",
}
NO_TORQUE = f"{STATUS} is {ControllerState.WRONG_PERIOD.value}: the gains are for another rate, so there was no torque"


def record_usd(path: Path) -> Recording:
    """Read the log of a Crazyflie's uSD deck.

    Raises
    ------
    TuningError
        When the file is damaged.
    """
    blocks = read_usd_log(path)
    return _record(path, "Crazyflie uSD log", blocks, USD_ADVICE)


def record_cfclient_csv(path: Path) -> Recording:
    """Read cfclient's CSV file of a log block, and those of the other blocks of the connection beside it.

    A log block holds 26 bytes, so that one file cannot hold all signals.

    Raises
    ------
    TuningError
        When the file is damaged.
    """
    block, damage = read_cfclient_csv(path)
    blocks, beside, warnings = [block], [], []
    for other in sorted(path.parent.glob("*.csv")):
        if other.name != path.name and _is_csv(other):
            try:
                found, cut = read_cfclient_csv(other)
            except TuningError as error:
                warnings.append(f"a file beside it is not read: {str(error).removeprefix(f'{path.parent}/')}")
                continue
            overlaps = found.time[0] < block.time[-1] and block.time[0] < found.time[-1]
            known = {name for one in blocks for name in one.variables}
            if overlaps and not known.intersection(found.variables):
                blocks.append(found)
                beside.append(other)
                damage = damage or cut
    notes = [RADIO_NOTE]
    notes += [f"read with the log blocks beside it: {', '.join(one.name for one in beside)}"] if beside else []
    warnings += [damage] if damage else []
    return _record(path, "Crazyflie CSV (cfclient)", blocks, CSV_ADVICE, notes, warnings, tuple(beside))


def _is_csv(path: Path) -> bool:
    with path.open("rb") as stream:
        return is_cfclient_csv(stream.read(HEAD_BYTES))


def _record(
    path: Path,
    kind: str,
    blocks: Sequence[LogBlock],
    advice: str,
    notes: Sequence[str] = (),
    warnings: Sequence[str] = (),
    beside: tuple[Path, ...] = (),
) -> Recording:
    """The recording of log blocks."""
    airborne, evidence = _airborne(blocks)
    faults, warned, flown = _what_flew(blocks, airborne)
    ours = flown != ()
    if flown and flown != ALWAYS:
        airborne = flown if airborne is None else intersection(airborne, flown)
        evidence = f"{evidence} and {STATUS}".removeprefix(" and ")
    if ours:
        parts = [_attitude_flown(block) for block in blocks]
        blocks, warned = [block for block, _ in parts], [*warned, *(one for _, some in parts for one in some)]
    signals, yaw = _signals(blocks, LAYOUTS, ours), _signals(blocks, YAW_LAYOUTS, ours)
    wanted = {
        signal: " or ".join(" and ".join(name for name, _ in layout) for layout in _allowed(signal, layouts, ours))
        for signal, layouts in LAYOUTS.items()
    }
    stock = "u" in signals and not signals["u"].topic.startswith(GROUP)
    return Recording(
        path=path,
        format=kind,
        signals=signals,
        wanted=wanted,
        contents=sorted({name for block in blocks for name in block.variables}),
        advice=advice,
        airborne=airborne,
        evidence=evidence,
        faults=faults,
        warnings=(*warnings, *warned),
        notes=(NOTE, *([STOCK_NOTE] if stock else []), *notes),
        yaw=yaw,
        span=(min(float(block.time[0]) for block in blocks), max(float(block.time[-1]) for block in blocks)),
        beside=beside,
    )


def _allowed(signal: str, layouts: Sequence[Layout], ours: bool) -> list[Layout]:
    """Layouts of a signal, without those of our controller if the stock one flew."""
    return [one for one in layouts if ours or signal not in FLOWN or not one[0][0].startswith(f"{GROUP}.")]


def _signals(blocks: Sequence[LogBlock], layouts: Mapping[str, tuple[Layout, ...]], ours: bool) -> dict[str, Series]:
    """The first layout of each signal that one log block holds."""
    signals = {}
    for signal, places in layouts.items():
        for layout in _allowed(signal, places, ours):
            names = [name for name, _ in layout]
            block = next((one for one in blocks if one.variables.keys() >= set(names)), None)
            if block is not None:
                values = np.column_stack([factor * block.variables[name] for name, factor in layout])
                signals[signal] = Series(block.time, values, ", ".join(names))
                break
    return signals


def _what_flew(
    blocks: Sequence[LogBlock], airborne: tuple[Interval, ...] | None
) -> tuple[list[str], list[str], tuple[Interval, ...]]:
    """Faults, warnings, and when our controller flew; without its state in the log, always.

    Parameters
    ----------
    blocks : sequence of LogBlock
    airborne : tuple of (begin, end) or None, s
        None: not known, then in the whole log.
    """
    block = next((one for one in blocks if STATUS in one.variables), None)
    if block is None:
        return [], [], ALWAYS
    state = block.variables[STATUS]
    if (state == ControllerState.WRONG_PERIOD).any():
        return [NO_TORQUE], [], ALWAYS
    # While a switch of EN waits for the ground, what flew before still flies; what flew before the log is not known.
    told = np.maximum.accumulate(np.where(state != ControllerState.WAITING, np.arange(len(state)), 0))
    state = state[told]
    unknown = state == ControllerState.WAITING
    used = np.any([(a <= block.time) & (block.time <= b) for a, b in airborne or ALWAYS], axis=0)
    if not used.any():
        return [], [], ALWAYS
    stock = np.isin(state, STOCK_FLIES)
    if stock[used].all():
        return [], [STOCK_FLEW], ()
    if (stock | unknown)[used].all():
        return [], [UNKNOWN_FLEW], ()
    warnings = []
    if unknown[used].any():
        warnings.append(f"{UNKNOWN_FLEW}, for {_share(unknown[used]):.0f} % of the flight: not used")
    if stock[used].any():
        share = _share(stock[used])
        warnings.append(f"according to {STATUS} the stock PID flew for {share:.0f} % of the flight: not used")
    for other, why in ANOTHER_SET.items():
        share = _share(state[used] == other)
        if share:
            warnings.append(
                f"{STATUS} is {other.value} for {share:.0f} % of the flight: {why}, and the set that was taken before "
                "flew; give that set's values in the --spec file"
            )
    others = stock | unknown
    return [], warnings, intervals(block.time, ~others) if others.any() else ALWAYS


def _attitude_flown(block: LogBlock) -> tuple[LogBlock, list[str]]:
    """The samples in which our controller flew an attitude setpoint, and a warning if it flew rates in others."""
    rates = np.isnan(block.variables.get(SETPOINT, np.zeros(1))) & np.isfinite(block.variables.get(RATE, np.zeros(1)))
    if not rates.any():
        return block, []
    warning = f"{SETPOINT} is NaN for {_share(rates):.0f} % of the log: rates were flown, without an attitude setpoint"
    if rates.all():
        return block, [warning]
    kept = {name: values[~rates] for name, values in block.variables.items()}
    return LogBlock(block.name, block.time[~rates], kept), [f"{warning}; not used"]


def _share(flag: NDArray[np.bool_]) -> float:
    """How many percent are true."""
    return 100.0 * float(np.mean(flag))


def _airborne(blocks: Sequence[LogBlock]) -> tuple[tuple[Interval, ...] | None, str]:
    """When the vehicle flew, and the variable that says so."""
    for name, bit in FLYING:
        for block in blocks:
            if name in block.variables:
                values = block.variables[name]
                bits = np.where(np.abs(values) < 1 << 16, values, 0.0).astype(np.int64)  # text may hold anything
                flying = (bits >> bit) & 1 == 1
                return intervals(block.time, flying), name
    return None, ""
