"""What a user of `experiment --connect` sees: the settings, the question, the flight, and where its log is."""

from __future__ import annotations

import math
import sys
from collections.abc import Mapping
from dataclasses import asdict, dataclass

import typer
from mimopilot.sitl.autopilot.excitation_injector import AXIS
from mimopilot.sitl.errors import SitlError
from mimopilot.sitl.mavlink.ground_station.experiment import INTEGERS, NAMES, Result, check, excite, observe
from mimopilot.sitl.mavlink.ground_station.session import Options, session
from mimopilot.sitl.mavlink.wire.float32 import shortest, single
from mimopilot.sitl.mavlink.wire.px4_modes import EXCITED_MODES
from mimopilot.tuning.excitation import hold_from_bandwidth
from mimopilot.tuning.parameters import EXCITATION

from mimopilot.common.console import print_json, print_table

PX4 = 12  # MAV_AUTOPILOT
#: Bits of SDLOG_PROFILE without which a log cannot be tuned from: default, high rate, debug topics.
LOG_PROFILE, NEEDED = "SDLOG_PROFILE", 1 | 16 | 32
AXES = {"roll": 1, "pitch": 2, "both": 3}


@dataclass(frozen=True)
class Choice:
    """The options of the command; see their help."""

    axis: str
    seconds_per_axis: float
    amplitude: float
    bandwidth: float
    seed: int
    mode: str
    tilt_deg: float


def settings(choice: Choice, Ts: float) -> dict[str, float]:
    """The injector's parameters, name -> value in single precision, for a control period (s).

    Raises
    ------
    SitlError
        Naming the first option or parameter that is wrong.
    TuningError
        When the bandwidth is.
    """
    for option, value, known in (("--axis", choice.axis, AXES), ("--mode", choice.mode, EXCITED_MODES)):
        if value not in known:
            raise SitlError(f"{option}: got {value!r}, expected one of {', '.join(known)}")
    hold_min, hold_max = hold_from_bandwidth(choice.bandwidth, Ts)
    values = {
        AXIS: AXES[choice.axis],
        "MIMO_EX_AMP": choice.amplitude,
        "MIMO_EX_HMIN": hold_min,
        "MIMO_EX_HMAX": hold_max,
        "MIMO_EX_DUR": choice.seconds_per_axis,
        "MIMO_EX_SEED": choice.seed,
        "MIMO_EX_MODE": EXCITED_MODES[choice.mode][0],
        "MIMO_EX_TILT": math.radians(choice.tilt_deg),
    }
    wanted = {name: single(values[name]) for name in NAMES}
    check(wanted)
    return wanted


def experiment(options: Options, choice: Choice) -> None:
    """Fly the experiment on a vehicle that hovers already.

    Parameters
    ----------
    options : Options
        How to reach it.
    choice : Choice
        What to fly.

    Raises
    ------
    SitlError
        Unless it went to its planned end and all is as before.
    """
    if not options.yes and (options.as_json or not sys.stdin.isatty()):
        raise SitlError("there is nobody to ask: give --yes to excite the vehicle")
    with session(options, INTEGERS | {LOG_PROFILE}) as vehicle:
        Ts = vehicle.read(["MIMO_TS"])["MIMO_TS"]
        wanted = settings(choice, Ts)
        sights = vehicle.run(observe(vehicle.talk, round(wanted["MIMO_EX_MODE"])))
        on_px4 = vehicle.vehicle.autopilot == PX4
        if on_px4:
            _check_log(round(vehicle.read([LOG_PROFILE])[LOG_PROFILE]))
        if not options.as_json:
            rows = [[s.name, shortest(wanted[s.name]), s.unit, s.description] for s in EXCITATION]
            print_table(f"vehicle {vehicle.vehicle.system} hovers", ["parameter", "value", "unit", "what"], rows)
        if not options.yes:
            typer.confirm("Excite it?", abort=True)
            vehicle.link.discard()
            vehicle.talk.resume(vehicle.link.now())
            sights = vehicle.run(observe(vehicle.talk, round(wanted["MIMO_EX_MODE"])))
        result = vehicle.run(excite(vehicle.talk, sights, wanted))
    _report(result, wanted, on_px4, options)


def _check_log(profile: int) -> None:
    if profile & NEEDED != NEEDED:
        raise SitlError(
            f"{LOG_PROFILE} is {profile}: the log would be too slow to tune from; land, set it to {NEEDED}, and take "
            "off again",
            exit_code=1,
        )


def _report(result: Result, wanted: Mapping[str, float], on_px4: bool, options: Options) -> None:
    where = (
        "the vehicle holds the log: land, disarm and fetch its last one (QGroundControl: Analyze Tools, Log Download)"
        if on_px4
        else "the vehicle writes the log as it disarms after landing: the file of `mimopilot sitl --log`"
    )
    if options.as_json:
        print_json({**asdict(result), "parameters": wanted})
    elif result.complete:
        print(f"excited for {result.seconds:.1f} s; {where}; then: mimopilot tune LOG")
    problems = [] if result.complete else [result.reason]
    if not result.stopped:
        problems.append(f"the vehicle may still be exciting: set {AXIS} to 0, leave the mode, or move a stick")
    if not result.restored:
        problems.append("its MIMO_EX_ parameters were not all read back as they were before")
    if problems:
        raise SitlError("; ".join(problems), exit_code=1)
