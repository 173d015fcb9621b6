"""What a ground station knows of a flying vehicle during an experiment, and when it must stop it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

from mimopilot.sitl.mavlink.ground_station.events import (
    AltitudeReport,
    AttitudeReport,
    Exchange,
    FlightReport,
    InjectorState,
    LandedState,
    Outgoing,
    PowerReport,
    RequestMessage,
    SetMessageInterval,
    StatusText,
    StorageReport,
    TransferReport,
)
from mimopilot.sitl.mavlink.ground_station.parameter_protocol import ParameterClient

IN_AIR = 2  # MAV_LANDED_STATE_IN_AIR
#: Message -> (number, interval in us) that the vehicle is requested to stream.
Streams = Mapping[str, tuple[int, int]]
FLIGHT_STREAMS: Streams = {"ATTITUDE": (30, 50_000), "EXTENDED_SYS_STATE": (245, 200_000)}
ALTITUDE_STREAM: Streams = {"VFR_HUD": (74, 200_000)}
SYS_STATUS, STORAGE_INFORMATION = 1, 261  # message numbers
# Times and limits are chosen, unless a source is given.
FIRST_STREAM_TIMEOUT_S, REPEAT_REQUEST_S = 5.0, 1.0  # until all streams arrive; between their requests
POLL_S = 0.1  # between two checks of the flight state
STREAM_TIMEOUT_S = 1.0  # without a message of a stream, and at least so many intervals of it:
MISSED_MESSAGES = 12  # at 30 % loss a stream at 5 Hz misses as many in a row once in 150 hours
HEARTBEAT_TIMEOUT_S = 5.0  # HEARTBEAT comes once a second and may be lost
HOVER_TILT = math.radians(15.0)  # rad; a hovering vehicle tilts less
HOVER_RATE = 0.5  # rad/s; a hovering vehicle turns slower
WIND_S = 3.0  # of hover that is watched for wind
#: rad that the excitation adds to the tilt in hover: the recorded flight of a stock PX4 stayed below 13 degrees.
EXCITED_TILT = math.radians(13.0)
MIN_CHARGE = 30  # %; an experiment and the landing take some minutes
MIN_FREE_MIB = 100.0  # on the card; PX4 logs about 10 MiB a minute at full rate


@dataclass
class FlightMonitor:
    """Latest flight state that the vehicle reported; times by our clock, s.

    Attributes
    ----------
    client : ParameterClient
    streams : mapping
        Messages without which the flight is not monitored.
    tilt, largest_tilt : float, rad
        Last roll or pitch, and the largest since `watch_hover` began.
    turn : float, rad/s
        Largest body rate since then.
    clock : float, s
        Vehicle's time since boot.
    altitude : float, m
    charge : int, %
        Of the battery; -1: unknown.
    logging : bool or None
        Whether the vehicle logs; None: not reported.
    free : float or None, MiB
        On its card; None: not reported.
    phase : int
        Of our injector.
    stamp : int, us
        Of the injector's state, by the vehicle's clock.
    text : str
        Last STATUSTEXT.
    seen : dict
        Stream -> time of its last message.
    """

    client: ParameterClient
    streams: Streams
    tilt: float = 0.0
    largest_tilt: float = 0.0
    turn: float = 0.0
    clock: float = 0.0
    in_air: bool = False
    altitude: float = 0.0
    charge: int = -1
    logging: bool | None = None
    free: float | None = None
    phase: int = -1
    stamp: int = 0
    text: str = ""
    seen: dict[str, float] = field(default_factory=dict)

    def __call__(self, report: FlightReport | TransferReport) -> None:
        """Record a report."""
        now = self.client.now
        if isinstance(report, AttitudeReport):
            self.tilt = max(abs(report.roll), abs(report.pitch))
            self.largest_tilt = max(self.largest_tilt, self.tilt)
            self.turn = max(self.turn, *map(abs, report.rates))
            self.clock = report.time
            self.seen["ATTITUDE"] = now
        elif isinstance(report, LandedState):
            self.in_air = report.state == IN_AIR
            self.seen["EXTENDED_SYS_STATE"] = now
        elif isinstance(report, AltitudeReport):
            self.altitude = report.altitude
            self.seen["VFR_HUD"] = now
        elif isinstance(report, PowerReport):
            self.charge, self.logging = report.charge, report.logging
            self.seen["SYS_STATUS"] = now
        elif isinstance(report, StorageReport):
            self.free = report.free
        elif isinstance(report, InjectorState):
            self.phase, self.stamp = report.phase, report.time
            self.seen["DEBUG_VECT"] = now
        elif isinstance(report, StatusText):
            self.text = report.behind(self.text)

    def overdue(self, seconds: float) -> list[str]:
        """Streams without a message for more than `seconds`, and `MISSED_MESSAGES` of their intervals."""
        return [
            kind
            for kind, (_, interval) in self.streams.items()
            if self.client.now - self.seen.get(kind, -math.inf) > max(seconds, 1e-6 * MISSED_MESSAGES * interval)
        ]


def request_streams(client: ParameterClient, streams: Streams) -> Exchange[FlightMonitor]:
    """Request streams and wait until all have arrived, or the time is up; see `FlightMonitor.overdue`."""
    assert client.vehicle is not None
    target = client.vehicle.system, client.vehicle.component
    monitor = client.on_report = FlightMonitor(client, streams)
    next_request, deadline = client.now, client.now + FIRST_STREAM_TIMEOUT_S
    while monitor.overdue(STREAM_TIMEOUT_S) and client.now < deadline and not (client.interrupted or client.closed):
        requests: list[Outgoing] = []
        if client.now >= next_request:
            next_request = client.now + REPEAT_REQUEST_S
            requests += [SetMessageInterval(*target, *streams[kind]) for kind in monitor.overdue(REPEAT_REQUEST_S)]
        yield from client.send_and_wait(requests, client.now + POLL_S)
    return monitor


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
    monitor.largest_tilt = monitor.turn = 0.0
    while client.now < end and not (client.interrupted or client.closed):
        yield from client.send_and_wait([], client.now + POLL_S)
    degrees = math.degrees(monitor.largest_tilt)
    if monitor.largest_tilt + EXCITED_TILT > largest_tilt:
        return (
            f"the vehicle tilts by up to {degrees:.0f} degrees in hover and the excitation adds about "
            f"{math.degrees(EXCITED_TILT):.0f}, more than the limit of {math.degrees(largest_tilt):.0f}: it is too "
            "windy, or it does not hover"
        )
    return "" if monitor.turn <= HOVER_RATE else f"the vehicle turns at {monitor.turn:.1f} rad/s: let it hover first"


def not_hovering(client: ParameterClient, monitor: FlightMonitor) -> str:
    """Why the vehicle is not known to hover; empty: it does."""
    assert client.vehicle is not None
    missing = monitor.overdue(STREAM_TIMEOUT_S)
    if client.interrupted:
        return "interrupted"
    if missing:
        return f"the vehicle does not send {', '.join(missing)}"
    if not client.vehicle.armed:
        return "the vehicle is not armed: take off and hover first"
    return "" if monitor.in_air else "the vehicle is on the ground: take off and hover first"


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
    if client.closed:
        return "the link was lost"
    if client.failure:
        return client.failure
    if client.heartbeat_age > HEARTBEAT_TIMEOUT_S:
        return f"no HEARTBEAT for {HEARTBEAT_TIMEOUT_S:g} s"
    if not client.vehicle.armed:
        return "the vehicle was disarmed"
    if client.vehicle.mode != mode:
        return "the vehicle left its mode"
    if not monitor.tilt <= largest_tilt:
        return f"the vehicle tilts by {math.degrees(monitor.tilt):.0f} degrees"
    if not monitor.in_air:
        return "the vehicle is on the ground"
    missing = monitor.overdue(STREAM_TIMEOUT_S)
    return f"the vehicle no longer sends {', '.join(missing)}" if missing else ""
