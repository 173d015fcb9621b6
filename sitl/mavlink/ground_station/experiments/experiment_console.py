"""The command `experiment --connect`: preparation, settings table, confirmation, experiment, result, restoration."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path

import typer

from mimopilot.common.console import print_json, print_table, print_text
from mimopilot.common.files import write_atomically
from mimopilot.sitl.autopilot.excitation_injector import AXIS
from mimopilot.sitl.errors import SitlError
from mimopilot.sitl.mavlink.ground_station.events import GENERIC
from mimopilot.sitl.mavlink.ground_station.experiments.experiment_profile import (
    ExcitationOptions,
    ExperimentProfile,
    ExperimentResult,
    Restoration,
)
from mimopilot.sitl.mavlink.ground_station.experiments.experiments_by_name import experiment_profile
from mimopilot.sitl.mavlink.ground_station.experiments.module_profile import ModuleInjection
from mimopilot.sitl.mavlink.ground_station.experiments.vehicle_setup import identify, wait
from mimopilot.sitl.mavlink.ground_station.flight_monitor import FlightMonitor
from mimopilot.sitl.mavlink.ground_station.session import LinkOptions, Session, open_session
from mimopilot.sitl.mavlink.ground_station.transaction import snapshot_path
from mimopilot.sitl.mavlink.wire.parameter_files import parameter_text

#: For the take-off after the preparation, s; chosen. And between two looks whether the vehicle hovers.
TAKEOFF_TIMEOUT_S, LOOK_S = 300.0, 2.0


class _Snapshot:
    """File of the values that the vehicle had before; written before the first change."""

    def __init__(self, options: LinkOptions) -> None:
        self.options = options
        self.path: Path | None = None
        self.session: Session | None = None
        self.integers: frozenset[str] = frozenset()

    def __call__(self, values: Mapping[str, float]) -> None:
        assert self.session is not None
        first = self.path is None
        self.path = self.path or snapshot_path(self.options)
        vehicle = self.session.vehicle
        text = parameter_text("qgc", values, vehicle.system, vehicle.component, integers=self.integers)
        write_atomically(self.path, text)
        if first and not self.options.as_json:
            print_text(f"old values saved: {self.path}")


def experiment(options: LinkOptions, name: str, excitation: ExcitationOptions) -> None:
    """Run the experiment of a profile on a vehicle; a stock one that stands on the ground is prepared first.

    Parameters
    ----------
    options : LinkOptions
        How to reach it.
    name : str
        Key of `EXPERIMENTS`.
    excitation : ExcitationOptions
        What to excite.

    Raises
    ------
    SitlError
        Unless it ran to its planned end and all parameters were restored.
    """
    if not options.yes and (options.as_json or not sys.stdin.isatty()):
        raise SitlError("no terminal to ask for confirmation: give --yes to excite the vehicle")
    snapshot = _Snapshot(options)
    profile = experiment_profile(name, excitation, snapshot)
    snapshot.integers = profile.integers
    restored = Restoration()
    with open_session(options, profile.integers) as session:
        snapshot.session = session
        ours = isinstance(profile, ModuleInjection)
        vehicle = identify(session, "" if ours else profile.name)
        if ours:
            session.read(["MIMO_TS"])  # says what is wrong with a vehicle that lacks our module
        try:
            monitor = profile.check(session) if ours or vehicle.armed else _prepare(session, profile, options)
            if not options.as_json:
                title = f"vehicle {session.vehicle.system} hovers"
                print_table(title, ["parameter", "value", "unit", "description"], profile.describe())
            if not options.yes:
                typer.confirm("Excite it?", abort=True)
                session.link.discard()
                session.client.resume(session.link.now())
                monitor = profile.check(session)
            result = profile.excite(session, monitor)
        finally:
            # In every case, with Ctrl-C and an error of ours as well.
            restored = profile.restore(session)
            _tell_left(restored, snapshot.path, options)
        generic = session.vehicle.autopilot == GENERIC
    _report(result, restored, profile, generic, options)


def _prepare(session: Session, profile: ExperimentProfile, options: LinkOptions) -> FlightMonitor:
    """Prepare the vehicle on the ground, and wait until it hovers."""
    if not options.yes:
        typer.confirm("Set the parameters of the experiment, and reboot the vehicle if they need it?", abort=True)
        session.link.discard()
        session.client.resume(session.link.now())
    done = profile.prepare(session)
    what = f"{len(done.changed)} parameters set" if done.changed else "prepared already"
    print(
        f"{what}{', rebooted' if done.rebooted else ''}; take off and hover now (Ctrl-C puts all back)", file=sys.stderr
    )
    deadline, shown = session.link.now() + TAKEOFF_TIMEOUT_S, ""
    while True:
        try:
            return profile.check(session)
        except SitlError as error:
            if session.client.interrupted or session.client.closed or session.link.now() > deadline:
                raise
            if str(error) != shown:
                shown = str(error)
                print(f"waiting: {shown.removesuffix('; nothing was written')}", file=sys.stderr)
        session.run(wait(session.client, LOOK_S))


def _tell_left(restored: Restoration, snapshot: Path | None, options: LinkOptions) -> None:
    """Say what could not be restored, also when another error ends the command."""
    if restored.left:
        print(
            f"mimopilot: warning: not read back as before: {', '.join(restored.left)}; land, disarm, and restore with: "
            f"mimopilot restore {snapshot} --connect {options.connect}",
            file=sys.stderr,
        )


def _report(
    result: ExperimentResult, restored: Restoration, profile: ExperimentProfile, generic: bool, options: LinkOptions
) -> None:
    where = (
        "the vehicle writes its log when it disarms after landing: the file of `mimopilot sitl --log`"
        if generic
        else "the log is on the vehicle: land, disarm, download it with: mimopilot logs --last --connect ..."
    )
    notes = (*result.notes, *restored.notes)
    if options.as_json:
        print_json({**asdict(result), "notes": notes, "left": dict(restored.left), "parameters": profile.settings})
    elif result.complete:
        print_text(f"excited for {result.seconds:.1f} s; {where}; then: mimopilot tune LOG")
        for note in notes:
            print_text(f"note: {note}")
    problems = [] if result.complete else [result.reason]
    if not result.stopped:
        stop = f"set {AXIS} to 0, leave the mode, or move a stick"
        if not isinstance(profile, ModuleInjection):
            stop = "move a stick, and change the mode"
        problems.append(f"the excitation may still be running: {stop}")
    if not result.restored:
        problems.append("not all MIMO_EX_ parameters were read back as before; check them")
    if not restored.complete:
        problems.append(f"{len(restored.left)} parameters were not read back as before")
    if problems:
        raise SitlError("; ".join(problems), exit_code=1)
