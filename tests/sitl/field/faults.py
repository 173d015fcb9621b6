"""Faults of link, vehicle, user and disk at a moment of an autotune, and what must be true afterwards."""

import errno
import signal
import tempfile

from mimopilot.sitl.field.autotune_run import GAINS
from mimopilot.sitl.field.vehicle_set import NEITHER, NEW, OLD
from mimopilot.sitl.field.workflow import SETS, UNKNOWN
from mimopilot.sitl.mavlink.ground_station.profiles import make_plan
from mimopilot.tuning.gains_file import load_gains
from tests.sitl.field.field_vehicle import LANDING

#: Length of an autotune without faults, s of simulated time.
WHOLE_S = 98.0


def link_lost(field, at, generator):
    field.link.plan(at, lambda link: setattr(link, "up", False))
    field.link.plan(at + generator.uniform(2.0, 40.0), lambda link: setattr(link, "up", True))


def loss(field, at, generator):
    field.link.loss = 0.3


def reboots(field, at, generator):
    field.link.plan(at, lambda link: field.vehicle.reboot())


def refuses_a_parameter(field, at, generator):
    faulty = str(generator.choice(["MIMO_AP_RR", "MIMO_RP_RP", "MIMO_RI_PP", "MIMO_RD_PR"]))

    def refuse(link):
        field.vehicle.fault, field.vehicle.faulty = "denies", faulty

    field.link.plan(0.6 * at, refuse)


def arms_by_itself(field, at, generator):
    vehicle = field.vehicle

    def arm(link):
        if not vehicle.armed:
            vehicle.armed, vehicle.content = True, ""
            link.plan(link.time + 20.0, lambda link: vehicle.disarm() if vehicle.landed == 1 else None)

    field.link.plan(at, arm)


def tilts_in_the_check_flight(field, at, generator):
    field.link.plan(0.8 * at, lambda link: setattr(field.vehicle, "stuck", 0.7))


def disk_full(field, at, generator):
    def no_space(*_, **__):
        raise OSError(errno.ENOSPC, "No space left on device")

    field.link.plan(at, lambda link: field.patch.setattr(tempfile, "mkstemp", no_space))


def ctrl_c(field, at, generator):
    field.link.plan(at, lambda link: signal.raise_signal(signal.SIGINT))


def log_missing(field, at, generator):
    field.link.plan(0.9 * at, lambda link: setattr(field.vehicle, "logging", False))


def mode_change(field, at, generator):
    vehicle = field.vehicle

    def take_over(link):
        if vehicle.armed and vehicle.landed != 1:
            vehicle.mode = 2 << 16
            link.plan(link.time + 10.0, lambda link: setattr(vehicle, "mode", LANDING) if vehicle.armed else None)

    field.link.plan(at, take_over)


FAULTS = (
    link_lost,
    loss,
    reboots,
    refuses_a_parameter,
    arms_by_itself,
    tilts_in_the_check_flight,
    disk_full,
    ctrl_c,
    log_missing,
    mode_change,
)


def mend(field):
    """End the fault: the same command is then given again."""
    field.link.up, field.link.loss = True, 0.0
    field.link.events = []
    vehicle = field.vehicle
    vehicle.fault, vehicle.stuck, vehicle.logging, vehicle.mute_until = "", None, True, 0.0
    if vehicle.armed:
        vehicle.disarm()
    field.patch.undo()


def told_set(field, message):
    """Which set the program says that the vehicle holds."""
    found = [held for held, text in SETS.items() if text in message]
    assert len(found) <= 1, message
    if found:
        return found[0]
    return OLD if message else NEW


def check_set(field, message, old):
    """The vehicle holds the old or the new set, and the program has said which, or that it does not know."""
    held = field.vehicle.set
    told = told_set(field, message)
    if told == UNKNOWN:
        return
    assert told != NEITHER, message
    wanted = old if told == OLD else make_plan(load_gains(field.options.folder / GAINS)).values
    assert held == wanted, (message, [name for name in held if held[name] != wanted[name]])


def run_with_fault(field, fault, at, generator):
    """One autotune with a fault, and the same command again until it has ended; returns all messages."""
    old = dict(field.vehicle.set)
    fault(field, at, generator)
    messages = [field.run()]
    check_set(field, messages[0], old)
    for _ in range(3):
        mend(field)
        messages.append(field.run())
        assert told_set(field, messages[-1]) != UNKNOWN, messages
        check_set(field, messages[-1], old)
        if not messages[-1] or "give another --out" in messages[-1]:
            break
    assert not messages[-1] or "give another --out" in messages[-1], messages
    assert not field.vehicle.armed
    return messages
