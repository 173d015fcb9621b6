"""When a flight in the field must be ended: the vehicle cannot be followed any more, or leaves its limits."""

from __future__ import annotations

import math

from mimopilot.sitl.errors import SitlError
from mimopilot.sitl.mavlink.ground_station.events import Exchange
from mimopilot.sitl.mavlink.ground_station.flight_monitor import FlightMonitor, Streams, request_streams
from mimopilot.sitl.mavlink.ground_station.vehicle_link_state import VehicleLinkState

# All chosen:
#: Message -> (number, interval in us) that the vehicle is requested to stream.
STREAMS: Streams = {
    "ATTITUDE": (30, 20_000),
    "EXTENDED_SYS_STATE": (245, 200_000),
    "VFR_HUD": (74, 100_000),
    "ATTITUDE_TARGET": (83, 100_000),
}
#: Silence (s) of a stream before the flight after which it counts as missing: at 30 % loss five in a row are lost once
#: in 400.
SLOW_STREAM_S = 3.0
#: Largest tilt (rad), body rate (rad/s) and distance from the height of hover (m) in a check flight. The doublets ask
#: for 10 degrees at most, and for 2 rad/s.
TRIP_TILT, TRIP_RATE, TRIP_HEIGHT = math.radians(30.0), 5.0, 4.0


def start_watch(client: VehicleLinkState) -> Exchange[FlightMonitor]:
    """Request the vehicle's streams, and wait until all have come.

    Raises
    ------
    SitlError
        Naming those that do not come.
    """
    watch = yield from request_streams(client, STREAMS, SLOW_STREAM_S)
    if client.interrupted:
        raise SitlError("interrupted", exit_code=1)
    if missing := watch.overdue(SLOW_STREAM_S):
        raise SitlError(f"the vehicle does not send {', '.join(missing)}", exit_code=1)
    return watch


def no_answer(watch: FlightMonitor) -> str:
    """Why the vehicle cannot be reached any more; empty: it can, or may be busy, as with writing its log."""
    client = watch.client
    if client.closed:
        return "the link was lost"
    if client.failure:
        return client.failure
    return f"no message from the vehicle for {client.timeout:g} s" if client.lost else ""


def not_followed(watch: FlightMonitor) -> str:
    """Why the flight cannot be followed any more; empty: it can."""
    if lost := watch.link_problem():
        return lost
    missing = watch.overdue(streams=["ATTITUDE"])
    return f"the vehicle no longer sends {', '.join(missing)}" if missing else ""


def trip(watch: FlightMonitor, height: float) -> str:
    """Why a check flight must be ended for what the vehicle does; empty: it may go on.

    Parameters
    ----------
    watch : FlightMonitor
    height : float, m
        Altitude of the hover.
    """
    if not watch.tilt <= TRIP_TILT:
        return f"it tilted by {math.degrees(watch.tilt):.0f} degrees"
    if not watch.rate <= TRIP_RATE:
        return f"it turned at {watch.rate:.1f} rad/s"
    if not abs(watch.altitude - height) <= TRIP_HEIGHT:
        return f"it left its height by {watch.altitude - height:+.1f} m"
    return ""
