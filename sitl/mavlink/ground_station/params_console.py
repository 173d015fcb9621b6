"""The command `params`: gains or a vehicle's parameters as a file, or a comparison of the two."""

from __future__ import annotations

import sys
from pathlib import Path

from mimopilot.codegen.firmware_number import firmware_number
from mimopilot.common.console import print_json, print_table
from mimopilot.common.errors import check_choice
from mimopilot.common.files import write_atomically
from mimopilot.common.verbosity import warn
from mimopilot.sitl.errors import SitlError
from mimopilot.sitl.mavlink.ground_station.betaflight_lines import betaflight_lines
from mimopilot.sitl.mavlink.ground_station.profiles import (
    UploadPlan,
    make_plan,
    module_parameters,
)
from mimopilot.sitl.mavlink.ground_station.session import LinkOptions, open_session
from mimopilot.sitl.mavlink.ground_station.transaction import read_binding
from mimopilot.sitl.mavlink.wire.float32 import shortest
from mimopilot.sitl.mavlink.wire.parameter_files import FORMATS, parameter_text
from mimopilot.tuning.acceptance import check_verdict
from mimopilot.tuning.gains import Gains
from mimopilot.tuning.gains_file import load_gains
from mimopilot.tuning.law_filters import BETAFLIGHT, MIMO

#: Format -> code generation target that emits it, and its path there.
GENERATED = {
    "c-header": ("native", "core/parameters.h"),
    "px4-yaml": ("px4", "px4/src/modules/mc_mimo_pid/module.yaml"),
}


def compare(file: Path, options: LinkOptions, profile: str | None = None) -> None:
    """Compare a gains file with the vehicle's parameters; by default with those of the controller that it is for.

    The number of the vehicle's firmware must stand with them, else they would not fly.

    Raises
    ------
    SitlError
        With exit code 1 if they differ.
    """
    gains = load_gains(file)
    plan = make_plan(gains, profile or gains.controller)
    wanted, units = plan.values | plan.fixed, {setting.name: setting.unit for setting in plan.settings}
    with open_session(options, crazyflie=True) as vehicle:
        held = vehicle.read(list(wanted), profile or "")
        if plan.binding is not None:
            held |= read_binding(plan.binding, vehicle)
            number = held[plan.binding.firmware]
            if number != firmware_number(gains):  # else they are the firmware's own, which need no number
                wanted[plan.binding.stored] = number
    differ = [name for name, value in wanted.items() if held[name] != value]
    if options.as_json:
        both = {name: {"file": value, "vehicle": held[name]} for name, value in wanted.items()}
        print_json({"equal": not differ, "parameters": both})
    else:
        rows = [
            [
                *(name, units.get(name, ""), shortest(value), shortest(held[name])),
                f"{held[name] - value:+.6g}" if name in differ else "",
            ]
            for name, value in wanted.items()
        ]
        print_table(str(file), ["parameter", "unit", "in the file", "on the vehicle", "difference"], rows)
    if differ:
        raise SitlError(f"{len(differ)} of {len(wanted)} parameters differ", exit_code=1)


def export(
    file: Path | None,
    options: LinkOptions,
    form: str,
    out: Path | None,
    uncertified: bool = False,
    profile: str | None = None,
) -> None:
    """Write a gains file, or a vehicle's parameters, as a parameter file.

    Its parameters are those that an upload with the profile writes; by default with that of the gains' controller.

    Raises
    ------
    SitlError
        If the format is unknown, or there is nothing to export.
    """
    from_gains = (*GENERATED, BETAFLIGHT)
    check_choice("--format", form, (*FORMATS, *from_gains), SitlError)
    if form in from_gains and profile is not None:
        raise SitlError(f"--format {form}: is for one controller only; leave out --profile")
    if file is not None:
        gains = load_gains(file)
        warning = check_verdict(gains, allow=uncertified)
        if form == BETAFLIGHT:
            text = betaflight_lines(gains)
        elif form in GENERATED:
            text = _generated(gains, form)
        else:
            plan = make_plan(gains, profile or gains.controller)
            text = parameter_text(form, plan.values, comments=_comments(plan, gains))
        if warning:
            warn(file, [warning])
    elif not options.connect:
        raise SitlError("give a gains file to write, --connect to read from a vehicle, or both to compare them")
    elif form in from_gains:
        raise SitlError(f"--format {form}: needs a gains file; a vehicle cannot be written in this format")
    else:
        with open_session(options, crazyflie=True) as vehicle:
            names, binding = module_parameters(profile or MIMO)
            held = vehicle.read(names, profile or "")
            found = vehicle.run(vehicle.client.read(binding, "reading"))  # older firmware does not have it
        held |= {name: answer.value for name, answer in found.items() if answer.value is not None}
        text = parameter_text(form, held, vehicle.vehicle.system, vehicle.vehicle.component)
    if out is None:
        sys.stdout.write(text)
    else:
        write_atomically(out, text)
        print(f"{out}: {len(text.splitlines())} lines")


def _comments(plan: UploadPlan, gains: Gains) -> list[str]:
    """What whoever loads a parameter file has to check and to do, which `upload` does by itself."""
    unit = dict(zip(plan.scale, gains.moment_scale or (), strict=False))
    held = ", ".join(f"{name} {shortest(value)}" for name, value in {**plan.requires, **plan.fixed, **unit}.items())
    comments = [f"load only into a vehicle that holds {held}"] if held else []
    if plan.binding:
        comments.append(f"then set {plan.binding.stored} to what the vehicle has as {plan.binding.firmware}")
    return comments


def _generated(gains: Gains, form: str) -> str:
    from mimopilot.codegen.render import render

    target, path = GENERATED[form]
    return render(gains, target)[path]
