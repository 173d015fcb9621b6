"""What a ground station knows of a flying vehicle, as the vehicle reports it.

See `sitl.mavlink.ground_station.events` for how an exchange is run.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
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
    SetMessageInterval,
    StatusText,
    StorageReport,
    ThrustReport,
    TransferReport,
)
from mimopilot.sitl.mavlink.ground_station.vehicle_link_state import VehicleLinkState

#: MAV_LANDED_STATE.
ON_GROUND, IN_AIR = 1, 2
#: Message -> (number, interval in us) that the vehicle is requested to stream.
Streams = Mapping[str, tuple[int, int]]
# Times are chosen, unless a source is given.
FIRST_STREAM_TIMEOUT_S, REPEAT_REQUEST_S = 6.0, 1.0  # until all streams arrive; between their requests
POLL_S = 0.1  # between two checks of the flight state
STREAM_TIMEOUT_S = 1.0  # without a message of a stream, and at least so many intervals of it:
MISSED_MESSAGES = 12  # at 30 % loss a stream at 5 Hz misses as many in a row once in 150 hours
HEARTBEAT_TIMEOUT_S = 5.0  # HEARTBEAT comes once a second and may be lost
#: Share of a new report in the mean of the collective, which is requested at 10 Hz.
THRUST_SHARE = 0.1


@dataclass
class FlightMonitor:
    """Latest flight state that the vehicle reported.

    Attributes
    ----------
    client : VehicleLinkState
    streams : mapping
        Messages without which the flight is not monitored.
    roll, pitch, yaw : float, rad
    rate : float, rad/s
        Largest body rate.
    largest_tilt, largest_rate : float, rad, rad/s
        Largest tilt and body rate since a caller set them to 0.
    clock : float, s
        Vehicle's time since boot, of its last attitude.
    landed : int
        MAV_LANDED_STATE.
    altitude, climb : float, m, m/s
    thrust : float
        Collective, 0 to 1, mean of the last second.
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
        Stream -> our time (s) of its last message.
    """

    client: VehicleLinkState
    streams: Streams
    roll: float = 0.0
    pitch: float = 0.0
    yaw: float = 0.0
    rate: float = 0.0
    largest_tilt: float = 0.0
    largest_rate: float = 0.0
    clock: float = 0.0
    landed: int = 0
    altitude: float = 0.0
    climb: float = 0.0
    thrust: float = 0.0
    charge: int = -1
    logging: bool | None = None
    free: float | None = None
    phase: int = -1
    stamp: int = 0
    text: str = ""
    seen: dict[str, float] = field(default_factory=dict)

    def __call__(self, report: FlightReport | TransferReport) -> None:
        """Record a report."""
        if isinstance(report, AttitudeReport):
            self.roll, self.pitch, self.yaw, self.clock = report.roll, report.pitch, report.yaw, report.time
            self.rate = max(map(abs, report.rates))
            self.largest_tilt = max(self.largest_tilt, self.tilt)
            self.largest_rate = max(self.largest_rate, self.rate)
            self._note("ATTITUDE")
        elif isinstance(report, LandedState):
            self.landed = report.state
            self._note("EXTENDED_SYS_STATE")
        elif isinstance(report, AltitudeReport):
            self.altitude, self.climb = report.altitude, report.climb
            self._note("VFR_HUD")
        elif isinstance(report, ThrustReport):
            first = "ATTITUDE_TARGET" not in self.seen
            self.thrust += (1.0 if first else THRUST_SHARE) * (report.thrust - self.thrust)
            self._note("ATTITUDE_TARGET")
        elif isinstance(report, PowerReport):
            self.charge, self.logging = report.charge, report.logging
            self._note("SYS_STATUS")
        elif isinstance(report, StorageReport):
            self.free = report.free
        elif isinstance(report, InjectorState):
            self.phase, self.stamp = report.phase, report.time
            self._note("DEBUG_VECT")
        elif isinstance(report, StatusText):
            self.text = report.behind(self.text)

    def _note(self, stream: str) -> None:
        self.seen[stream] = self.client.now

    @property
    def tilt(self) -> float:
        """Larger one of roll and pitch, rad; infinite if either is not finite."""
        if not (math.isfinite(self.roll) and math.isfinite(self.pitch)):
            return math.inf
        return max(abs(self.roll), abs(self.pitch))

    @property
    def in_air(self) -> bool:
        """Whether it reports that it is in the air."""
        return self.landed == IN_AIR

    @property
    def flying(self) -> bool:
        """Whether it is armed and not known to be on the ground."""
        vehicle = self.client.vehicle
        return vehicle is not None and vehicle.armed and self.landed != ON_GROUND

    def overdue(self, seconds: float = STREAM_TIMEOUT_S, streams: Sequence[str] | None = None) -> list[str]:
        """Streams without a message for more than `seconds`, and `MISSED_MESSAGES` of their intervals.

        Of `streams`; by default of all that are requested.
        """
        return [
            kind
            for kind in (self.streams if streams is None else streams)
            if self.client.now - self.seen.get(kind, -math.inf)
            > max(seconds, 1e-6 * MISSED_MESSAGES * self.streams[kind][1])
        ]

    def link_problem(self) -> str:
        """Why the vehicle can be followed no more, whatever its streams; empty: it can."""
        client = self.client
        if client.closed:
            return "the link was lost"
        if client.failure:
            return client.failure
        if client.heartbeat_age > HEARTBEAT_TIMEOUT_S:
            return f"no HEARTBEAT for {HEARTBEAT_TIMEOUT_S:g} s"
        return ""


def request_streams(
    client: VehicleLinkState, streams: Streams, seconds: float = STREAM_TIMEOUT_S
) -> Exchange[FlightMonitor]:
    """Request streams and wait until all have arrived, or the time is up.

    Parameters
    ----------
    client : VehicleLinkState
    streams : mapping
    seconds : float, s
        Age at which a message counts no longer; see `FlightMonitor.overdue`.
    """
    assert client.vehicle is not None
    target = client.vehicle.system, client.vehicle.component
    monitor = client.on_report = FlightMonitor(client, streams)
    next_request, deadline = client.now, client.now + FIRST_STREAM_TIMEOUT_S
    while monitor.overdue(seconds) and client.now < deadline and not (client.interrupted or client.closed):
        requests: list[Outgoing] = []
        if client.now >= next_request:
            next_request = client.now + REPEAT_REQUEST_S
            requests += [SetMessageInterval(*target, *streams[kind]) for kind in monitor.overdue(REPEAT_REQUEST_S)]
        yield from client.send_and_wait(requests, client.now + POLL_S)
    return monitor
