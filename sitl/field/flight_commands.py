"""Commands to a vehicle in the field: arm, take off, land, and wait for what the pilot does.

Landing goes on after Ctrl-C. See `sitl.mavlink.ground_station.events` for how an exchange is run.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

from mimopilot.sitl.errors import SitlError
from mimopilot.sitl.field.flight_watch import no_answer
from mimopilot.sitl.mavlink.ground_station.events import (
    ACCEPTED,
    IN_PROGRESS,
    CommandAck,
    Exchange,
)
from mimopilot.sitl.mavlink.ground_station.flight_monitor import POLL_S, FlightMonitor
from mimopilot.sitl.mavlink.ground_station.vehicle_link_state import VehicleLinkState
from mimopilot.sitl.mavlink.wire.dialect import mavlink

NAN = math.nan
# Times are chosen.
READY_TIMEOUT_S = 30.0  # until a vehicle that has just started lets itself be armed
HOVERED_S = 1.0  # of a hover, until it counts as one
CLIMB_S_PER_M, CLIMB_MARGIN_S = 4.0, 20.0  # of a take-off: at least 0.25 m/s
ARRIVED = 0.3  # m, from the asked height; and m/s
LAND_TIMEOUT_S = 180.0  # from the command to the disarmed vehicle
PILOT_TIMEOUT_S = 600.0  # for a pilot to take off, or to land and disarm


def send_command(
    client: VehicleLinkState, number: int, parameters: Sequence[float], what: str, retry_s: float = 0.0
) -> Exchange[None]:
    """Send a command until it is accepted.

    Parameters
    ----------
    client : VehicleLinkState
    number : int
        MAV_CMD.
    parameters : sequence of float
        The first of its seven parameters.
    what : str
        For messages: ``arm``.
    retry_s : float, s
        How long to repeat a command that the vehicle refuses for now.

    Raises
    ------
    SitlError
        If it is refused, or not answered.
    """
    begin = client.now

    def is_final(ack: CommandAck) -> bool:
        refused = ack.result not in (ACCEPTED, IN_PROGRESS)
        return ack.result == ACCEPTED or (refused and client.now >= begin + retry_s)

    ack = yield from client.command(number, parameters, is_final)
    if ack is None and client.closed:
        raise SitlError(f"the link was lost on the command to {what}", exit_code=1)
    if ack is None:
        raise SitlError(f"no answer to the command to {what} in {client.timeout:g} s", exit_code=1)
    if ack.result != ACCEPTED:
        raise SitlError(f"the vehicle refused to {what} (MAV_RESULT {ack.result})", exit_code=1)


def wait_for(
    watch: FlightMonitor, condition: Callable[[], bool], seconds: float, what: str, careful: bool = True
) -> Exchange[None]:
    """Wait until a condition is true.

    Parameters
    ----------
    watch : FlightMonitor
    condition : callable
    seconds : float, s
        Time limit.
    what : str
        For messages: ``reach its height``.
    careful : bool
        True: end at Ctrl-C, too.

    Raises
    ------
    SitlError
        If it does not come true in time, the link is lost, or the user interrupts.
    """
    client = watch.client
    deadline = client.now + seconds
    while not condition():
        reason = no_answer(watch)
        if careful and client.interrupted:
            reason = "interrupted"
        elif client.now > deadline:
            reason = f"the vehicle did not {what} in {seconds:.0f} s"
        if reason:
            said = f": {watch.text}" if watch.text and reason.startswith("the vehicle did not") else ""
            raise SitlError(reason + said, exit_code=1)
        yield from client.send_and_wait([], client.now + POLL_S)


def take_off(watch: FlightMonitor, height: float) -> Exchange[None]:
    """Arm, climb to a height above the ground (m), and wait until it hovers there.

    Raises
    ------
    SitlError
        If the vehicle refuses, does not arrive, or the user interrupts.
    """
    client = watch.client
    assert client.vehicle is not None
    if not client.vehicle.armed:
        try:
            yield from send_command(client, mavlink.MAV_CMD_COMPONENT_ARM_DISARM, [1], "arm", READY_TIMEOUT_S)
        except SitlError as error:
            said = f": {watch.text}" if watch.text else ""
            raise SitlError(f"{error}{said}", exit_code=1) from error
    ground = watch.altitude
    # PX4 takes an altitude above mean sea level, the others a height above the ground.
    above_sea = client.vehicle.autopilot == mavlink.MAV_AUTOPILOT_PX4
    target = ground + height if above_sea else height
    place = (0.0, 0.0, 0.0, NAN, NAN, NAN, target)
    yield from send_command(client, mavlink.MAV_CMD_NAV_TAKEOFF, place, "take off")
    yield from wait_for(
        watch,
        lambda: abs(watch.altitude - ground - height) < ARRIVED and abs(watch.climb) < ARRIVED and watch.in_air,
        CLIMB_MARGIN_S + CLIMB_S_PER_M * height,
        f"climb to {height:g} m",
    )


def land(watch: FlightMonitor) -> Exchange[None]:
    """Land, and wait until the vehicle has disarmed; Ctrl-C does not end it.

    Raises
    ------
    SitlError
        If it does not land, or the link is lost.
    """
    client = watch.client
    assert client.vehicle is not None
    if client.vehicle.armed:
        yield from send_command(client, mavlink.MAV_CMD_NAV_LAND, (0.0, 0.0, 0.0, NAN, NAN, NAN), "land")
    yield from wait_until_disarmed(watch, LAND_TIMEOUT_S)


def wait_until_disarmed(
    watch: FlightMonitor, seconds: float = PILOT_TIMEOUT_S, careful: bool = False
) -> Exchange[None]:
    """Wait until the vehicle stands and is disarmed."""
    client = watch.client

    def disarmed() -> bool:
        return client.vehicle is not None and not client.vehicle.armed

    yield from wait_for(watch, disarmed, seconds, "land and disarm", careful)


def wait_until_hovering(watch: FlightMonitor) -> Exchange[None]:
    """Wait until a pilot has taken off and has hovered for a while: a vehicle that lifts off climbs slowly, too."""
    since = math.inf

    def hovers() -> bool:
        nonlocal since
        still = watch.flying and watch.in_air and abs(watch.climb) < ARRIVED
        since = min(since, watch.client.now) if still else math.inf
        return watch.client.now - since >= HOVERED_S

    yield from wait_for(watch, hovers, PILOT_TIMEOUT_S, "take off and hover")
