"""Parameters, commands and the reboot around an experiment."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence

from pymavlink.dialects.v20 import common as mavlink

from mimopilot.sitl.errors import SitlError
from mimopilot.sitl.mavlink.ground_station.events import CommandAck, Exchange, Heartbeat, Outgoing
from mimopilot.sitl.mavlink.ground_station.experiments.experiment_profile import VehicleSession
from mimopilot.sitl.mavlink.ground_station.experiments.hover_checks import (
    FLIGHT_STREAMS,
    request_status,
    supplies_problem,
)
from mimopilot.sitl.mavlink.ground_station.flight_monitor import FlightMonitor, request_streams
from mimopilot.sitl.mavlink.ground_station.parameter_protocol import Answer, ParameterClient
from mimopilot.sitl.mavlink.ground_station.upload import write_and_verify
from mimopilot.sitl.mavlink.ground_station.vehicle_kinds import check_kind

#: From the command to reboot until the vehicle must be back, s; chosen: a Pixhawk with many sensors takes 20.
BOOT_S = 60.0
#: The same where the user has to reboot it, and between two looks whether it is back, s; chosen.
HAND_S, LOOK_S = 180.0, 1.0
#: Tries for a parameter that a vehicle may lack: at 30 % loss each way one answer in 3000 is missed.
PROBE_TRIES = 12


def read_known(
    client: ParameterClient, names: Sequence[str], optional: Sequence[str] = ()
) -> Exchange[dict[str, Answer]]:
    """Parameters of the vehicle, with their index; those of `optional` that it lacks are left out.

    Raises
    ------
    SitlError
        If one of `names` is not read.
    """
    answers = yield from client.read(names, "reading", keep_going=True)
    for name, answer in answers.items():
        if answer.problem:
            raise SitlError(f"{name}: {answer.problem}; nothing was written", exit_code=1)
    if optional:
        tries, client.tries = client.tries, min(client.tries, PROBE_TRIES)
        more = yield from client.read(optional, "reading", keep_going=True)
        client.tries = tries
        answers |= {name: answer for name, answer in more.items() if answer.value is not None}
    return answers


def values_of(answers: Mapping[str, Answer]) -> dict[str, float]:
    """Name -> value of what was read."""
    return {name: answer.value for name, answer in answers.items() if answer.value is not None}


def set_values(
    client: ParameterClient, new: Mapping[str, float], old: Mapping[str, float], store: bool
) -> Exchange[None]:
    """Write what differs, and read it back.

    Raises
    ------
    SitlError
        If that fails; the old values are then written back.
    """
    changes = {name: value for name, value in new.items() if value != old[name]}
    if not changes:
        return
    outcome = yield from write_and_verify(client, changes, {name: old[name] for name in changes}, store)
    if outcome.state != "verified":
        back = {
            "untouched": "nothing was written",
            "rolled back": "the old values were restored and read back",
        }.get(outcome.state, "not all old values were read back")
        raise SitlError(f"{outcome.reason}; {back}", exit_code=1)


def write_back(client: ParameterClient, old: Mapping[str, float]) -> Exchange[dict[str, float]]:
    """Write old values, also after Ctrl-C; returns those that were not read back."""
    if client.lost:
        return dict(old)
    yield from client.write(old, "restoring", keep_going=True)
    yield from client.wait_until_quiet()
    answers = yield from client.read(list(old), "restoring", keep_going=True)
    left = {name: value for name, value in old.items() if answers[name].value != value}
    if client.vehicle is not None and not client.vehicle.armed and not client.lost:
        yield from client.store()
    return left


def identify(session: VehicleSession, profile: str) -> Heartbeat:
    """The vehicle's HEARTBEAT, once it is found to fit a profile.

    Raises
    ------
    SitlError
        If it does not.
    """
    vehicle = session.run(session.client.await_heartbeat())
    check_kind(vehicle, profile)
    return vehicle


def on_the_ground(session: VehicleSession, profile: str) -> FlightMonitor:
    """Check that the vehicle fits a profile, stands disarmed on the ground, and has battery and card for a flight.

    Raises
    ------
    SitlError
        If not.
    """
    client = session.client
    identify(session, profile)
    monitor = session.run(request_streams(client, FLIGHT_STREAMS))
    session.run(request_status(client, monitor))
    missing = monitor.overdue()
    assert client.vehicle is not None
    if client.interrupted:
        problem = "interrupted"
    elif client.vehicle.armed or monitor.in_air:
        problem = "the vehicle is armed or in the air: land and disarm it to prepare it"
    elif missing:
        problem = f"the vehicle does not send {', '.join(missing)}"
    else:
        problem = supplies_problem(monitor)
    if problem:
        raise SitlError(f"{problem}; nothing was written", exit_code=1)
    return monitor


def reboot(session: VehicleSession, monitor: FlightMonitor) -> FlightMonitor:
    """Reboot the vehicle and wait until it is back.

    Returns
    -------
    FlightMonitor
        Of the vehicle after the reboot.

    Raises
    ------
    SitlError
        If it refuses, or does not come back.
    """
    before, begin, ack = monitor.clock, session.client.now, session.run(_command_reboot(session.client, monitor))
    by_hand = ack is not None and ack.result in (mavlink.MAV_RESULT_DENIED, mavlink.MAV_RESULT_UNSUPPORTED)
    if ack is not None and ack.result != mavlink.MAV_RESULT_ACCEPTED and not by_hand:
        why = f": {monitor.text}" if monitor.text else ""
        raise SitlError(f"the vehicle refuses to reboot (MAV_RESULT {ack.result}){why}; reboot it by hand", exit_code=1)
    # A firmware that cannot restart itself, as PX4 in simulation, is restarted by the user.
    timeout, phase = (HAND_S, "reboot the vehicle by hand now") if by_hand else (BOOT_S, "rebooting")
    if by_hand:  # also without a terminal, where no progress is shown
        print(f"mimopilot: {phase}: it refuses the command", file=sys.stderr)
    while session.client.now < begin + timeout and not session.client.interrupted:
        if session.client.closed:
            session.reconnect()
            before = session.client.now - begin  # on a link that has ended, the vehicle's clock must be younger
        session.client.progress(phase, round(session.client.now - begin), round(timeout))
        monitor = session.run(request_streams(session.client, FLIGHT_STREAMS))
        if not monitor.overdue() and monitor.clock < before:
            return monitor
        session.run(wait(session.client, LOOK_S))
    if session.client.interrupted:
        raise SitlError("interrupted while the vehicle rebooted", exit_code=1)
    how = "it refuses the command: switch it off and on" if by_hand else "reboot it by hand"
    raise SitlError(
        f"the vehicle was not seen to reboot within {timeout:g} s; {how}, and run this again: nothing is lost",
        exit_code=1,
    )


def _command_reboot(client: ParameterClient, monitor: FlightMonitor) -> Exchange[CommandAck | None]:
    """Command the reboot until it is acknowledged or the vehicle falls silent: not again once it is back."""
    before = monitor.clock
    return client.command(
        mavlink.MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN,
        (1.0,),
        is_over=lambda: bool(monitor.overdue()) or monitor.clock < before,
    )


def wait(client: ParameterClient, seconds: float) -> Exchange[None]:
    """Listen for some seconds."""
    end, nothing = client.now + seconds, list[Outgoing]()
    while client.now < end and not (client.closed or client.interrupted):
        yield from client.send_and_wait(nothing, end)
