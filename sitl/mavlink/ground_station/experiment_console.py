"""The command `experiment --connect`: settings table, confirmation, experiment, result, and where the log is."""

from __future__ import annotations

import math
import sys
from collections.abc import Mapping
from dataclasses import asdict, dataclass

import typer

from mimopilot.common.console import print_json, print_table
from mimopilot.sitl.autopilot.excitation_injector import AXIS
from mimopilot.sitl.errors import SitlError
from mimopilot.sitl.flight.excitation_flight import VEHICLE_YAW_AMPLITUDE
from mimopilot.sitl.mavlink.ground_station.session import LinkOptions, Session, open_session
from mimopilot.sitl.mavlink.ground_station.vehicle_experiment import (
    INTEGERS,
    NAMES,
    ExperimentResult,
    check_settings,
    excite,
    start_monitor,
)
from mimopilot.sitl.mavlink.wire.float32 import shortest, single
from mimopilot.sitl.mavlink.wire.px4_modes import EXCITED_MODES
from mimopilot.tuning.excitation import hold_from_bandwidth
from mimopilot.tuning.parameters import EXCITATION

PX4 = 12  # MAV_AUTOPILOT_PX4
#: Bits of SDLOG_PROFILE that tuning from a log needs: default, high rate, debug topics.
LOG_PROFILE, NEEDED = "SDLOG_PROFILE", 1 | 16 | 32
#: --axis -> value of `AXIS`.
AXES = {"roll": 1, "pitch": 2, "both": 3, "yaw": 4, "all": 5}


@dataclass(frozen=True)
class ExcitationOptions:
    """Options of the command; see their help."""

    axis: str
    seconds_per_axis: float
    amplitude: float
    bandwidth: float
    seed: int
    mode: str
    tilt_deg: float
    yaw_amplitude: float = VEHICLE_YAW_AMPLITUDE


def settings(excitation: ExcitationOptions, Ts: float) -> dict[str, float]:
    """The injector's parameters, name -> value in single precision, for a control period (s).

    Raises
    ------
    SitlError
        Naming the first option or parameter that is wrong.
    TuningError
        If the bandwidth is wrong.
    """
    for option, value, known in (("--axis", excitation.axis, AXES), ("--mode", excitation.mode, EXCITED_MODES)):
        if value not in known:
            raise SitlError(f"{option}: got {value!r}, expected one of {', '.join(known)}")
    hold_min, hold_max = hold_from_bandwidth(excitation.bandwidth, Ts)
    values = {
        AXIS: AXES[excitation.axis],
        "MIMO_EX_AMP": excitation.amplitude,
        "MIMO_EX_AMPY": excitation.yaw_amplitude,
        "MIMO_EX_HMIN": hold_min,
        "MIMO_EX_HMAX": hold_max,
        "MIMO_EX_DUR": excitation.seconds_per_axis,
        "MIMO_EX_SEED": excitation.seed,
        "MIMO_EX_MODE": EXCITED_MODES[excitation.mode][0],
        "MIMO_EX_TILT": math.radians(excitation.tilt_deg),
    }
    wanted = {name: single(values[name]) for name in NAMES}
    check_settings(wanted)
    return wanted


def experiment(options: LinkOptions, excitation: ExcitationOptions) -> None:
    """Run the experiment on a hovering vehicle.

    Parameters
    ----------
    options : LinkOptions
        How to reach it.
    excitation : ExcitationOptions
        What to inject.

    Raises
    ------
    SitlError
        Unless it ran to its planned end and all settings were restored.
    """
    if not options.yes and (options.as_json or not sys.stdin.isatty()):
        raise SitlError("no terminal to ask for confirmation: give --yes to excite the vehicle")
    with open_session(options, INTEGERS | {LOG_PROFILE}) as vehicle:
        Ts = vehicle.read(["MIMO_TS"])["MIMO_TS"]
        wanted = settings(excitation, Ts)
        monitor = vehicle.run(start_monitor(vehicle.client, round(wanted["MIMO_EX_MODE"])))
        on_px4 = vehicle.vehicle.autopilot == PX4
        check_log(vehicle)
        if not options.as_json:
            rows = [[s.name, shortest(wanted[s.name]), s.unit, s.description] for s in EXCITATION]
            print_table(f"vehicle {vehicle.vehicle.system} hovers", ["parameter", "value", "unit", "description"], rows)
        if not options.yes:
            typer.confirm("Excite it?", abort=True)
            vehicle.link.discard()
            vehicle.client.resume(vehicle.link.now())
            monitor = vehicle.run(start_monitor(vehicle.client, round(wanted["MIMO_EX_MODE"])))
        result = vehicle.run(excite(vehicle.client, monitor, wanted))
    _report(result, wanted, on_px4, options)


def check_log(vehicle: Session) -> None:
    """Refuse a PX4 whose log would be too slow for tuning.

    Raises
    ------
    SitlError
        With the parameter and its value.
    """
    profile = round(vehicle.read([LOG_PROFILE])[LOG_PROFILE]) if vehicle.vehicle.autopilot == PX4 else NEEDED
    if profile & NEEDED != NEEDED:
        raise SitlError(
            f"{LOG_PROFILE} is {profile}: the log rate would be too low for tuning; land, set it to {NEEDED}, and "
            "take off again",
            exit_code=1,
        )


def _report(result: ExperimentResult, wanted: Mapping[str, float], on_px4: bool, options: LinkOptions) -> None:
    where = (
        "the log is on the vehicle: land, disarm, download it with: mimopilot logs --last --connect ..."
        if on_px4
        else "the vehicle writes its log when it disarms after landing: the file of `mimopilot sitl --log`"
    )
    if options.as_json:
        print_json({**asdict(result), "parameters": wanted})
    elif result.complete:
        print(f"excited for {result.seconds:.1f} s; {where}; then: mimopilot tune LOG")
    problems = [] if result.complete else [result.reason]
    if not result.stopped:
        problems.append(f"the excitation may still be running: set {AXIS} to 0, leave the mode, or move a stick")
    if not result.restored:
        problems.append("not all MIMO_EX_ parameters were read back as before; check them")
    if problems:
        raise SitlError("; ".join(problems), exit_code=1)
