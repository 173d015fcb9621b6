"""What an experiment asks of the vehicle in hover, and when it must be stopped."""

from __future__ import annotations

import math

from mimopilot.sitl.errors import SitlError
from mimopilot.sitl.mavlink.ground_station.events import Exchange, Outgoing, RequestMessage
from mimopilot.sitl.mavlink.ground_station.flight_monitor import (
    POLL_S,
    REPEAT_REQUEST_S,
    FlightMonitor,
    Streams,
    request_streams,
)
from mimopilot.sitl.mavlink.ground_station.parameter_protocol import ParameterClient

#: Message -> (number, interval in us) that the vehicle is requested to stream.
FLIGHT_STREAMS: Streams = {"ATTITUDE": (30, 50_000), "EXTENDED_SYS_STATE": (245, 200_000)}
ALTITUDE_STREAM: Streams = {"VFR_HUD": (74, 200_000)}
SYS_STATUS, STORAGE_INFORMATION = 1, 261  # message numbers
# Limits are chosen, unless a source is given.
HOVER_TILT = math.radians(15.0)  # rad; a hovering vehicle tilts less
HOVER_RATE = 0.5  # rad/s; a hovering vehicle turns slower
WIND_S = 3.0  # of hover that is watched for wind
#: rad that the excitation adds to the tilt in hover: the recorded flight of a stock PX4 stayed below 13 degrees.
EXCITED_TILT = math.radians(13.0)
MIN_CHARGE = 30  # %; an experiment and the landing take some minutes
MIN_FREE_MIB = 100.0  # on the card; PX4 logs about 10 MiB a minute at full rate


def request_status(client: ParameterClient, monitor: FlightMonitor) -> Exchange[None]:
    """Ask for the battery and the card; a vehicle may know neither."""
    assert client.vehicle is not None
    target = client.vehicle.system, client.vehicle.component
    next_request, deadline = client.now, client.now + 2 * REPEAT_REQUEST_S
    while client.now < deadline and not (client.interrupted or client.closed):
        if "SYS_STATUS" in monitor.seen and monitor.free is not None:
            return
        requests: list[Outgoing] = []
        if client.now >= next_request:
            next_request = client.now + REPEAT_REQUEST_S / 2
            requests += [RequestMessage(*target, number) for number in (SYS_STATUS, STORAGE_INFORMATION)]
        yield from client.send_and_wait(requests, client.now + POLL_S)


def supplies_problem(monitor: FlightMonitor) -> str:
    """Why battery or card do not allow an experiment; empty: they do, or the vehicle does not tell."""
    if 0 <= monitor.charge < MIN_CHARGE:
        return f"the battery is at {monitor.charge} %, expected {MIN_CHARGE} % or more: charge it"
    if monitor.free is not None and monitor.free < MIN_FREE_MIB:
        return f"the card has {monitor.free:.0f} MiB left, the log needs {MIN_FREE_MIB:.0f} MiB: delete old logs"
    return "the vehicle reports that it cannot log: check its card" if monitor.logging is False else ""


def watch_hover(client: ParameterClient, monitor: FlightMonitor, largest_tilt: float) -> Exchange[str]:
    """Watch the hover; returns why it is not steady enough for an excitation, empty: it is.

    Parameters
    ----------
    client : ParameterClient
    monitor : FlightMonitor
    largest_tilt : float, rad
        At which the experiment would be stopped.
    """
    end = client.now + WIND_S
    monitor.largest_tilt = monitor.largest_rate = 0.0
    while client.now < end and not (client.interrupted or client.closed):
        yield from client.send_and_wait([], client.now + POLL_S)
    degrees = math.degrees(monitor.largest_tilt)
    if monitor.largest_tilt + EXCITED_TILT > largest_tilt:
        return (
            f"the vehicle tilts by up to {degrees:.0f} degrees in hover and the excitation adds about "
            f"{math.degrees(EXCITED_TILT):.0f}, more than the limit of {math.degrees(largest_tilt):.0f}: it is too "
            "windy, or it does not hover"
        )
    return (
        ""
        if monitor.largest_rate <= HOVER_RATE
        else f"the vehicle turns at {monitor.largest_rate:.1f} rad/s: let it hover first"
    )


def not_hovering(client: ParameterClient, monitor: FlightMonitor) -> str:
    """Why the vehicle is not known to hover; empty: it does."""
    assert client.vehicle is not None
    missing = monitor.overdue()
    if client.interrupted:
        return "interrupted"
    if missing:
        return f"the vehicle does not send {', '.join(missing)}"
    if not client.vehicle.armed:
        return "the vehicle is not armed: take off and hover first"
    return "" if monitor.in_air else "the vehicle is on the ground: take off and hover first"


def check_hover(
    client: ParameterClient, streams: Streams, wrong_mode: str, largest_tilt: float
) -> Exchange[FlightMonitor]:
    """Request the vehicle's streams; check that it hovers in calm air, with battery and card for an experiment.

    Parameters
    ----------
    client : ParameterClient
    streams : mapping
    wrong_mode : str
        Why its mode does not allow the experiment; empty: it does.
    largest_tilt : float, rad
        At which the experiment would be stopped.

    Raises
    ------
    SitlError
        If it does not.
    """
    monitor = yield from request_streams(client, streams)
    yield from request_status(client, monitor)
    problem = not_hovering(client, monitor) or wrong_mode or supplies_problem(monitor)
    problem = problem or (yield from watch_hover(client, monitor, largest_tilt))
    if problem:
        raise SitlError(f"{problem}; nothing was written", exit_code=1)
    return monitor


def stop_reason(client: ParameterClient, monitor: FlightMonitor, mode: int, largest_tilt: float) -> str:
    """Why the experiment must be stopped now; empty: it may continue.

    Parameters
    ----------
    client : ParameterClient
    monitor : FlightMonitor
    mode : int
        HEARTBEAT.custom_mode of the experiment.
    largest_tilt : float, rad
    """
    assert client.vehicle is not None
    if client.interrupted:
        return "interrupted"
    if lost := monitor.link_problem():
        return lost
    if not client.vehicle.armed:
        return "the vehicle was disarmed"
    if client.vehicle.mode != mode:
        return "the vehicle left its mode"
    if not monitor.tilt <= largest_tilt:
        return f"the vehicle tilts by {math.degrees(monitor.tilt):.0f} degrees"
    if not monitor.in_air:
        return "the vehicle is on the ground"
    missing = monitor.overdue()
    return f"the vehicle no longer sends {', '.join(missing)}" if missing else ""
