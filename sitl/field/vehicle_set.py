"""Which set of gains a vehicle holds, the old or the new one, and the way from one to the other.

Nothing is believed that is not read from the vehicle. Values are written to a disarmed vehicle only, by
`sitl.mavlink.ground_station.upload.write_and_verify`.
"""

from __future__ import annotations

from mimopilot.common.files import write_atomically
from mimopilot.sitl.errors import SitlError
from mimopilot.sitl.field.autotune_run import GAINS, SNAPSHOT, AutotuneRun
from mimopilot.sitl.field.flight_commands import wait_until_disarmed
from mimopilot.sitl.field.flight_watch import start_watch
from mimopilot.sitl.mavlink.ground_station.profiles import (
    MODULE_BINDING,
    UploadPlan,
    make_plan,
    make_restore_plan,
)
from mimopilot.sitl.mavlink.ground_station.session import Session
from mimopilot.sitl.mavlink.ground_station.stock_parameters import read_stock_parameters
from mimopilot.sitl.mavlink.ground_station.transaction import Upload, check_firmware, read_binding
from mimopilot.sitl.mavlink.ground_station.upload import write_and_verify
from mimopilot.sitl.mavlink.wire.parameter_files import parameter_text, read_parameters
from mimopilot.tuning.gains_file import load_gains
from mimopilot.tuning.law_filters import MIMO
from mimopilot.tuning.logs.imported_gains import import_gains
from mimopilot.tuning.parameters import PARAMETERS

OLD, NEW, NEITHER = "old", "new", "neither"


def _set_names(run: AutotuneRun) -> list[str]:
    """Parameters of a set of gains; those of a stock controller differ between versions of its firmware."""
    profile = run.options.profile
    if profile == MIMO:
        return [parameter.name for parameter in PARAMETERS if parameter.writable]
    flown = import_gains(read_stock_parameters(run.link()), profile=profile).gains
    return list(make_plan(flown, profile).values)


def save_snapshot(run: AutotuneRun) -> dict[str, float]:
    """Save the vehicle's set to the folder.

    Raises
    ------
    SitlError
        If it cannot be read, or is not what the file holds afterwards.
    """
    names = _set_names(run)
    with run.vehicle() as session:
        held = session.read(names, run.options.profile)
        if run.options.profile == MIMO:
            held |= read_binding(MODULE_BINDING, session)
        vehicle = session.vehicle
    path = run.file(SNAPSHOT)
    write_atomically(path, parameter_text("qgc", held, vehicle.system, vehicle.component))
    if read_parameters(path) != held:
        raise SitlError(f"{path}: does not read back as written; check the disk", exit_code=1)
    make_restore_plan(held, str(path))  # refuses what could not be restored
    return held


def old_plan(run: AutotuneRun) -> UploadPlan:
    """The old set, from the snapshot."""
    path = run.file(SNAPSHOT)
    return make_restore_plan(read_parameters(path), str(path))


def new_plan(run: AutotuneRun) -> UploadPlan:
    """The new set, from the gains file, for the firmware that the snapshot is of."""
    plan = make_plan(load_gains(run.file(GAINS)), run.options.profile)
    if plan.binding is None:
        return plan
    path = run.file(SNAPSHOT)
    number = read_parameters(path).get(plan.binding.firmware)
    if number is None:
        raise SitlError(f"{path}: lacks {plan.binding.firmware}: an older mimopilot wrote it; give another --out")
    return plan.bound(number)


def compare_set(run: AutotuneRun, session: Session) -> str:
    """Read which set the vehicle holds: `OLD`, `NEW` or `NEITHER`."""
    old = old_plan(run).values
    held = session.read(list(old), run.options.profile)
    if held == old:
        return OLD
    if run.file(GAINS).exists() and held == {**held, **new_plan(run).values}:
        return NEW
    return NEITHER


def held_set(run: AutotuneRun) -> str:
    """Open a link and read which set the vehicle holds; see `compare_set`."""
    with run.vehicle() as session:
        return compare_set(run, session)


def write_set(run: AutotuneRun, plan: UploadPlan) -> None:
    """Write a set to the disarmed vehicle, verified and stored; wait for a pilot to disarm it.

    Raises
    ------
    SitlError
        Unless every value was read back and stored; the message says what the vehicle holds.
    """
    with run.vehicle() as session:
        session.run(session.client.await_heartbeat())
        if session.vehicle.armed:
            run.dialogue.tell("the vehicle is armed: land and disarm it")
            session.run(wait_until_disarmed(session.run(start_watch(session.client))))
    with run.vehicle(armed=False) as session:
        held = session.read([*plan.values, *plan.fixed], run.options.profile)
        check_firmware(plan, held)
        outcome = session.run(write_and_verify(session.client, plan.values, held, lock=plan.lock))
        done = Upload(plan, held, session.vehicle, outcome, run.file(SNAPSHOT), run.options.connect)
    done.check()
