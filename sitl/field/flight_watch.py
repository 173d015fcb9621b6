"""The state of a vehicle in flight, as it reports it, and when a flight must be ended."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

from mimopilot.sitl.errors import SitlError
from mimopilot.sitl.mavlink.ground_station.events import (
    AltitudeReport,
    AttitudeReport,
    Exchange,
    FlightReport,
    LandedState,
    SetMessageInterval,
    StatusText,
    ThrustReport,
    TransferReport,
)
from mimopilot.sitl.mavlink.ground_station.vehicle_link_state import VehicleLinkState

#: MAV_LANDED_STATE.
ON_GROUND, IN_AIR = 1, 2
# All chosen:
#: Message -> (number, interval in us) that the vehicle is requested to stream.
STREAMS = {
    "ATTITUDE": (30, 20_000),
    "EXTENDED_SYS_STATE": (245, 200_000),
    "VFR_HUD": (74, 100_000),
    "ATTITUDE_TARGET": (83, 100_000),
}
FIRST_STREAM_TIMEOUT_S, REPEAT_REQUEST_S, POLL_S = 6.0, 1.0, 0.1
#: Silence (s) of the attitude, and of HEARTBEAT, after which the link counts as lost.
STREAM_TIMEOUT_S, HEARTBEAT_TIMEOUT_S = 1.0, 5.0
#: Silence (s) of any other stream after which it counts as missing: at 30 % loss five in a row are lost once in 400.
SLOW_STREAM_S = 3.0
#: Share of a new report in the mean of the collective, which is reported at 10 Hz.
THRUST_SHARE = 0.1
#: Largest tilt (rad), body rate (rad/s) and distance from the height of hover (m) in a check flight. The doublets ask
#: for 10 degrees at most, and for 2 rad/s.
TRIP_TILT, TRIP_RATE, TRIP_HEIGHT = math.radians(30.0), 5.0, 4.0


@dataclass
class FlightWatch:
    """Latest flight state that the vehicle reported.

    Attributes
    ----------
    roll, pitch, yaw : float, rad
    rate : float, rad/s
        Largest body rate.
    time : float, s
        Of the last attitude, by the vehicle's clock.
    landed : int
        MAV_LANDED_STATE.
    altitude, climb : float, m, m/s
    thrust : float
        Collective, 0 to 1, mean of the last second.
    text : str
        Last text of the vehicle.
    seen : dict
        Stream -> our time (s) of its last message.
    """

    client: VehicleLinkState
    roll: float = 0.0
    pitch: float = 0.0
    yaw: float = 0.0
    rate: float = 0.0
    time: float = 0.0
    landed: int = 0
    altitude: float = 0.0
    climb: float = 0.0
    thrust: float = 0.0
    text: str = ""
    seen: dict[str, float] = field(default_factory=dict)

    def __call__(self, report: FlightReport | TransferReport) -> None:
        """Record a report."""
        if isinstance(report, AttitudeReport):
            self.roll, self.pitch, self.yaw, self.time = report.roll, report.pitch, report.yaw, report.time
            self.rate = max(map(abs, report.rates))
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
    def flying(self) -> bool:
        """Whether it is armed and off the ground."""
        vehicle = self.client.vehicle
        return vehicle is not None and vehicle.armed and self.landed != ON_GROUND

    def silent(self, streams: Sequence[str], seconds: float) -> list[str]:
        """Those of some streams without a message for more than `seconds`."""
        return [kind for kind in streams if self.client.now - self.seen.get(kind, -math.inf) > seconds]

    def contact_problem(self) -> str:
        """Why the vehicle cannot be reached any more; empty: it can, or may be busy, as with writing its log."""
        client = self.client
        if client.closed:
            return "the link was lost"
        if client.failure:
            return client.failure
        return f"no message from the vehicle for {client.timeout:g} s" if client.lost else ""

    def link_problem(self) -> str:
        """Why the flight cannot be followed any more; empty: it can."""
        client = self.client
        if client.closed:
            return "the link was lost"
        if client.failure:
            return client.failure
        if client.heartbeat_age > HEARTBEAT_TIMEOUT_S:
            return f"no HEARTBEAT for {HEARTBEAT_TIMEOUT_S:g} s"
        missing = self.silent(["ATTITUDE"], STREAM_TIMEOUT_S)
        return f"the vehicle no longer sends {', '.join(missing)}" if missing else ""

    def trip(self, height: float) -> str:
        """Why a check flight must be ended for what the vehicle does; empty: it may go on.

        Parameters
        ----------
        height : float, m
            Altitude of the hover.
        """
        if not self.tilt <= TRIP_TILT:
            return f"it tilted by {math.degrees(self.tilt):.0f} degrees"
        if not self.rate <= TRIP_RATE:
            return f"it turned at {self.rate:.1f} rad/s"
        if not abs(self.altitude - height) <= TRIP_HEIGHT:
            return f"it left its height by {self.altitude - height:+.1f} m"
        return ""


def start_watch(client: VehicleLinkState) -> Exchange[FlightWatch]:
    """Request the vehicle's streams, and wait until all have come.

    Raises
    ------
    SitlError
        Naming those that do not come.
    """
    assert client.vehicle is not None
    watch = client.on_report = FlightWatch(client)
    next_request, deadline = client.now, client.now + FIRST_STREAM_TIMEOUT_S
    streams = list(STREAMS)
    while watch.silent(streams, SLOW_STREAM_S) and client.now < deadline and not (client.interrupted or client.closed):
        requests = []
        if client.now >= next_request:
            next_request = client.now + REPEAT_REQUEST_S
            requests = [
                SetMessageInterval(client.vehicle.system, client.vehicle.component, *STREAMS[kind])
                for kind in watch.silent(streams, REPEAT_REQUEST_S)
            ]
        yield from client.send_and_wait(requests, client.now + POLL_S)
    missing = watch.silent(streams, SLOW_STREAM_S)
    if client.interrupted:
        raise SitlError("interrupted", exit_code=1)
    if missing:
        raise SitlError(f"the vehicle does not send {', '.join(missing)}", exit_code=1)
    return watch
