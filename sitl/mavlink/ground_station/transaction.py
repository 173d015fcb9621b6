"""One upload from beginning to end: check the vehicle, save its old values, write, verify; without a terminal."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, Protocol

from mimopilot.common.files import write_atomically
from mimopilot.sitl.errors import SitlError
from mimopilot.sitl.mavlink.ground_station.events import Heartbeat
from mimopilot.sitl.mavlink.ground_station.parameter_protocol import AUTOSAVE_S
from mimopilot.sitl.mavlink.ground_station.profiles import Binding, UploadPlan, violated_range
from mimopilot.sitl.mavlink.ground_station.session import LinkOptions, Session, open_session
from mimopilot.sitl.mavlink.ground_station.set_switch import SWITCHES
from mimopilot.sitl.mavlink.ground_station.upload import (
    NoParametersError,
    UploadOutcome,
    read_values,
    write_and_verify,
)
from mimopilot.sitl.mavlink.wire.float32 import shortest
from mimopilot.sitl.mavlink.wire.parameter_files import parameter_text, read_parameters
from mimopilot.sitl.physics.moment_scale import check_moment_scale
from mimopilot.tuning.gains import Gains, Triple
from mimopilot.tuning.law_filters import MIMO
from mimopilot.tuning.parameters import FIRMWARE_NUMBER

STORAGE = {
    "acknowledged": "stored: the vehicle acknowledged it",
    "autosave": f"storage was not acknowledged: waited {AUTOSAVE_S:g} s, in which PX4 and ArduPilot save by themselves",
    "denied": "not stored: the vehicle refused it (PREFLIGHT_STORAGE: MAV_RESULT_DENIED)",
    "failed": "not stored: the vehicle failed to (over MAVLink: MAV_RESULT_FAILED)",
    "": "the link was lost before storage was acknowledged",
}
#: Results of storage after which the vehicle loses the values when it restarts.
UNSTORED = ("denied", "failed")


class UploadDialogue(Protocol):
    """What a user is shown and asked on the way."""

    def show_plan(self, plan: UploadPlan, held: Mapping[str, float], vehicle: Heartbeat) -> None:
        """Old and new values."""

    def confirm(self, changes: int, system: int) -> None:
        """Ask whether to write; raises where the answer is no."""

    def saved(self, path: Path) -> None:
        """The old values were saved."""


@dataclass(frozen=True)
class Upload:
    """A finished upload.

    Attributes
    ----------
    plan : UploadPlan
    held : mapping
        Parameter -> value that the vehicle had before.
    vehicle : Heartbeat
    outcome : UploadOutcome
    snapshot : Path or None
        Where the old values were saved; None: nothing was written.
    connect : str
        The link.
    """

    plan: UploadPlan
    held: Mapping[str, float]
    vehicle: Heartbeat
    outcome: UploadOutcome
    snapshot: Path | None
    connect: str

    def check(self) -> None:
        """Raise unless every value was read back and stored, or it was a dry run.

        Raises
        ------
        SitlError
            With what the vehicle is left with.
        """
        if self.outcome.state == "verified":
            if self.outcome.storage in UNSTORED:
                later = "it loses them when it restarts"
                if self.vehicle.autopilot in SWITCHES:  # the switch was stored as off before the set
                    later = "when it restarts, the stock PID flies; upload again"
                raise SitlError(f"all values were read back, but {STORAGE[self.outcome.storage]}: {later}", exit_code=1)
        elif self.outcome.state != "dry run":
            raise SitlError(_failure(self.outcome, self.held, self.snapshot, self.connect), exit_code=1)


def upload_and_verify(
    plan: UploadPlan,
    options: LinkOptions,
    gains: Gains | None = None,
    scale: Triple | Literal["flown"] | None = None,
    dialogue: UploadDialogue | None = None,
) -> Upload:
    """Read, check, show, confirm, save the old values, write and verify.

    Parameters
    ----------
    plan : UploadPlan
        What to write.
    options : LinkOptions
        How to reach the vehicle, and what to ask.
    gains : Gains, optional
        The gains of the plan: their unit of torque must then be the vehicle's.
    scale : tuple of 3 float (N m), or ``flown``, optional
        The vehicle's unit of torque, or ``flown``: the gains were tuned in it. By default it is read from the vehicle.

    dialogue : UploadDialogue, optional
        What is shown and asked; None: nothing, the values are written.

    Returns
    -------
    Upload
        See `Upload.check`.

    Raises
    ------
    SitlError
        When the vehicle is not the one that the plan is for, or is armed; nothing has been written then.
    """
    if options.snapshot is not None and options.snapshot.exists():
        raise SitlError(
            f"{options.snapshot}: exists already, and may be the only copy of older values; name another file"
        )
    if gains is not None and isinstance(scale, tuple):
        check_moment_scale(gains, scale, "the vehicle")
    ask_scale = gains is not None and scale is None
    if ask_scale and not plan.scale:
        raise SitlError(
            "a stock vehicle does not publish how many N m one unit of its torque is; give --moment-scale "
            "ROLL,PITCH,YAW, or --moment-scale flown if the gains come from a log of this vehicle"
        )
    with open_session(options, plan.integers, crazyflie=True) as vehicle:
        _check_choice(plan, vehicle)
        held = vehicle.read([*plan.values, *plan.fixed], plan.profile)
        if plan.binding is not None:
            held |= read_binding(plan.binding, vehicle)
            plan = plan.bound(held[plan.binding.firmware])
        if plan.unnumbered:
            _check_unnumbered(plan.unnumbered, vehicle)
        if ask_scale:
            held |= _read_scale(plan, vehicle)
        switch = SWITCHES.get(vehicle.vehicle.autopilot)
        if switch is not None and plan.profile == MIMO:
            held |= vehicle.run(read_values(vehicle.client, [switch.enable]))
            if held[switch.enable] not in (0.0, 1.0):
                raise SitlError(
                    f"{switch.enable}: the vehicle holds {held[switch.enable]:.6g}, expected 0 or 1: it could not be "
                    "switched back; set it by hand first"
                )
        _check_vehicle(plan, held, vehicle, options)
        if ask_scale and gains is not None:
            check_moment_scale(gains, [held[name] for name in plan.scale], "the vehicle")
        if dialogue is not None:
            dialogue.show_plan(plan, held, vehicle.vehicle)
        changes = [name for name, value in plan.values.items() if value != held[name]]
        snapshot = None
        if options.dry_run:
            outcome = UploadOutcome("dry run", "", {name: (held[name],) for name in plan.values})
        else:
            if changes and dialogue is not None and not options.yes:
                dialogue.confirm(len(changes), vehicle.vehicle.system)
                vehicle.link.discard()
                vehicle.client.resume(vehicle.link.now())
                if vehicle.read(list(held), plan.profile) != held:
                    raise SitlError(
                        "the vehicle's values changed while waiting for the answer: run it again", exit_code=1
                    )
            snapshot = _save_snapshot(plan, held, vehicle.vehicle, options) if changes else None
            if snapshot is not None and dialogue is not None:
                dialogue.saved(snapshot)
            outcome = vehicle.run(write_and_verify(vehicle.client, plan.values, held, switch=switch, lock=plan.lock))
        return Upload(plan, held, vehicle.vehicle, outcome, snapshot, options.connect)


def _check_choice(plan: UploadPlan, vehicle: Session) -> None:
    """Refuse a vehicle on which another controller is chosen, or none."""
    if not plan.requires:
        return
    firmware = "firmware with what `mimopilot generate --target ardupilot` emits"
    try:
        found = vehicle.read(list(plan.requires), plan.profile)
    except NoParametersError as error:
        raise SitlError(f"{error}; a custom controller needs {firmware}", exit_code=1) from error
    for name, value in plan.requires.items():
        if found[name] != value:
            raise SitlError(
                f"{name}: the vehicle has {found[name]:g}, expected {value:g}, our controller (in {firmware}); "
                f"set it to {value:g}, reboot and upload again; nothing was written"
            )


def read_binding(binding: Binding, vehicle: Session) -> dict[str, float]:
    """The firmware's number, and that of the stored set; the vehicle has our other parameters.

    Raises
    ------
    SitlError
        If its firmware has no number.
    """
    try:
        return vehicle.run(read_values(vehicle.client, binding))
    except NoParametersError as error:
        raise SitlError(
            f"{binding.firmware}: the vehicle does not have it: an older mimopilot generated its firmware, which flies "
            "stored gains of any other; generate it again and flash it; nothing was written",
            exit_code=1,
        ) from error


def _check_unnumbered(number: str, vehicle: Session) -> None:
    """Refuse gains of an unknown firmware, unless the vehicle's has no number either."""
    if vehicle.run(vehicle.client.read([number], "reading"))[number].absent:
        return
    raise SitlError(
        f"the file holds our gains without {number}, so it is not known for which firmware they are; upload gains "
        "instead (mimopilot upload); nothing was written"
    )


def _read_scale(plan: UploadPlan, vehicle: Session) -> dict[str, float]:
    """The vehicle's unit of torque; it has our other parameters."""
    try:
        return vehicle.run(read_values(vehicle.client, plan.scale))
    except NoParametersError as error:
        raise SitlError(
            f"{plan.scale[0]}: the vehicle does not have it, so its unit of torque is not known: its firmware was "
            'generated from gains with moment_scale "unknown"; give --moment-scale flown if the gains come from a log '
            "of this vehicle, else --moment-scale ROLL,PITCH,YAW in N m; nothing was written",
            exit_code=1,
        ) from error


def check_firmware(plan: UploadPlan, held: Mapping[str, float]) -> None:
    """Refuse a vehicle whose firmware was built with other values of what is fixed in it.

    Raises
    ------
    SitlError
        With what differs, and what to do.
    """
    for name, value in plan.fixed.items():
        if held[name] != value:
            if name.endswith(FIRMWARE_NUMBER.code):
                raise SitlError(
                    f"{name}: the vehicle has {held[name]:.6g}, the values are those of a firmware with {value:.6g}: "
                    "upload gains instead (mimopilot upload)"
                )
            raise SitlError(
                f"{name}: the vehicle has {held[name]:.6g}, the gains are for {value:.6g}; generate its firmware "
                "again, or tune for what it has"
            )


def _check_vehicle(plan: UploadPlan, held: Mapping[str, float], vehicle: Session, options: LinkOptions) -> None:
    check_firmware(plan, held)
    for name in plan.values:
        if not abs(held[name]) < float("inf"):
            raise SitlError(
                f"{name}: the vehicle holds {held[name]}, which could not be restored; set it by hand first"
            )
        expected = violated_range(name, held[name])
        if expected:
            raise SitlError(
                f"{name}: the vehicle holds {held[name]:.6g}, expected {expected}: restore would refuse it; set it by "
                "hand first"
            )
    if vehicle.vehicle.armed and not (options.force_armed or options.dry_run):
        raise SitlError("the vehicle is armed: nothing was written; disarm it, or give --force-armed", exit_code=1)


def snapshot_path(options: LinkOptions) -> Path:
    """Path of a new snapshot: that of the options, or the first free one of their stem."""
    path, number = options.snapshot, 0
    while path is None or path.exists():
        number += 1
        path = options.stem.with_name(f"{options.stem.name}.before-{number}.params")
    return path


def _save_snapshot(plan: UploadPlan, held: Mapping[str, float], vehicle: Heartbeat, options: LinkOptions) -> Path:
    """Write the old values to a new file: an older snapshot may be the only copy of its values."""
    path = snapshot_path(options)
    old = {name: held[name] for name in plan.values}
    old |= {name: value for name, value in held.items() if name.endswith(FIRMWARE_NUMBER.code)}
    write_atomically(path, parameter_text("qgc", old, vehicle.system, vehicle.component))
    if read_parameters(path) != old:
        raise SitlError(
            f"{path}: does not read back as written; nothing was sent to the vehicle; check the disk", exit_code=1
        )
    return path


def _failure(outcome: UploadOutcome, held: Mapping[str, float], snapshot: Path | None, connect: str) -> str:
    if outcome.state == "untouched":
        return f"{outcome.reason}; nothing was written"
    armed = ", although the vehicle was armed" if outcome.armed else ""
    stored = f"; {STORAGE[outcome.storage]}" if outcome.storage in UNSTORED else ""
    if outcome.state == "rolled back":
        return f"{outcome.reason}; the old values were restored and read back{armed}{stored}"
    left = [
        f"{name} holds {' or '.join(shortest(value) for value in values)}"
        for name, values in outcome.held.items()
        if values != (held[name],)
    ]
    rest = "the others hold their old values" if left else "the old values were written, but not all were read back"
    sent = f"old values were sent{armed}" if armed else ""
    again = f"restore with: mimopilot restore {snapshot} --connect {connect}"
    return "; ".join(part for part in [outcome.reason, *left, rest, sent, again] if part) + stored
