"""Server of the plant under ArduPilot's own simulator, by its JSON protocol over UDP, in lockstep.

Each servo packet is one period of the plant, answered by the motion at its end. ArduPilot waits for the answer, and
sends the packet again when none comes. Its frame count tells a repeated packet from a new one, and falls when it
restarts. See `sitl.mavlink.simulator_api.ardupilot_json` for the format.
"""

from __future__ import annotations

import contextlib
import os
import select
import socket
import sys
import time
from collections.abc import Iterable
from typing import Any

from mimopilot.sitl.errors import SitlError
from mimopilot.sitl.faults.kinds import Fault
from mimopilot.sitl.mavlink.simulator_api.ardupilot_json import LONGEST, ServoPacket, motion_line, parse_servos
from mimopilot.sitl.mavlink.simulator_api.plant_server import Pace, ParentGoneError, end_with_parent
from mimopilot.sitl.mavlink.simulator_api.simulated_vehicle import SimulatedVehicle
from mimopilot.sitl.mavlink.wire.fast_codec import ARMED

#: UDP port of the first instance; ArduPilot adds 10 for each further one.
PORT = 9002
#: ArduPilot's own frame rate, SIM_RATE_HZ, Hz; the first packet tells the true one.
FRAME_RATE = 1200.0
#: Silence of one ArduPilot after which another may take its place, s; it sends again after 1 s, and a restarted one
#: has another port. Chosen.
SILENT_S = 2.0
#: Faults that this protocol cannot carry, and why.
IMPOSSIBLE = {
    "gyro-nan": "ArduPilot does not read numbers that are not finite",
    "gyro-noise": "ArduPilot's simulator adds the noise: set SIM_GYR1_RND",
    "clock": "a clock that goes back counts as a restart of the plant",
    **dict.fromkeys(("loss", "duplicate", "skip", "link"), "ArduPilot's simulator waits for every answer"),
}


def check_json_faults(faults: Iterable[Fault]) -> None:
    """Refuse faults that this protocol cannot carry.

    Raises
    ------
    SitlError
        With the fault and the reason.
    """
    for fault in faults:
        if fault.kind in IMPOSSIBLE:
            raise SitlError(f"fault {str(fault)!r}: not with ardupilot-json: {IMPOSSIBLE[fault.kind]}")


class JsonServer:
    """Serves a simulated vehicle at a UDP socket.

    Parameters
    ----------
    vehicle : SimulatedVehicle
        On the ground, with exact sensors; reset to its start for each ArduPilot.
    link : socket
        Bound.
    speed : float or None
        Largest speed, times real time; None: as fast as ArduPilot asks.
    child : bool
        End when standard input is closed.

    Attributes
    ----------
    ignored : int
        Packets that were not from an ArduPilot, or from a second one.
    """

    def __init__(self, vehicle: SimulatedVehicle, link: socket.socket, speed: float | None, child: bool) -> None:
        self.vehicle, self.link, self.speed = vehicle, link, speed
        self.watched: list[Any] = [link, sys.stdin] if child else [link]
        self.ignored = 0
        self._reported: set[str] = set()
        self._peer: Any = None
        self._heard = 0.0
        link.setblocking(False)

    def serve(self) -> None:
        """Serve for ever; as a child, end this process when the parent ends."""
        try:
            while True:
                ready, _, _ = select.select(self.watched, [], [])
                end_with_parent(ready)
                if self.link in ready:
                    self.answer_one()
        except ParentGoneError:
            os._exit(0)  # at once, as `PlantServer`
        finally:
            if self.ignored:
                self.vehicle.report(f"{self.ignored} packets were ignored")

    def answer_one(self) -> None:
        """Read one packet, and answer it if it is ArduPilot's."""
        try:
            data, peer = self.link.recvfrom(LONGEST + 1)
        except OSError:  # nothing that could be read
            return
        packet = parse_servos(data)
        if packet is None:
            self._ignore(
                "packets that are not ArduPilot's servo outputs are ignored; is another program using this port?"
            )
            return
        now = time.monotonic()
        if peer != self._peer:
            if self._peer is not None and now < self._heard + SILENT_S:
                self._ignore("a second ArduPilot is ignored: this vehicle has one already")
                return
            self._begin(packet)
        elif packet.number < self._count:
            self._begin(packet)
        self._peer, self._heard = peer, now
        if packet.number != self._count:
            self._fly(packet)
        with contextlib.suppress(OSError):  # a lost answer is asked for again
            self.link.sendto(self._answer, peer)

    def _ignore(self, text: str) -> None:
        self.ignored += 1
        if text not in self._reported:
            self._reported.add(text)
            self.vehicle.report(text)

    def _begin(self, packet: ServoPacket) -> None:
        """Reset the vehicle for an ArduPilot that starts."""
        vehicle = self.vehicle
        if self._peer is not None:
            vehicle.report(
                f"ArduPilot restarted at {vehicle.seconds:.2f} s of flight; the vehicle is reset to its start"
            )
        self._rate, self._count, self._seconds, self._answer = packet.rate, -1, 0.0, b""
        vehicle.Ts = 1.0 / packet.rate
        vehicle.restart()
        self._pace = Pace(self.speed)

    def _fly(self, packet: ServoPacket) -> None:
        """Fly one period and make its answer."""
        vehicle = self.vehicle
        if packet.rate != self._rate:  # ArduPilot moves to a new SIM_RATE_HZ by 1 Hz in a frame
            vehicle.change_period(1.0 / packet.rate)
        self._rate, self._count = packet.rate, packet.number
        vehicle.fly(packet.controls, ARMED)
        self._seconds += vehicle.Ts
        self._pace.wait(vehicle.Ts)
        self._answer = motion_line(self._seconds, vehicle.read_sensors(), vehicle.simulator.state[:10].tolist())
