"""Hardware in the loop: the simulated vehicle for a real board on a serial port, in real time.

A board does not answer frame by frame, so the plant steps by the wall clock, under the latest motor commands.
HIL_STATE_QUATERNION is not sent, because PX4 on a board would use it as its own estimate.
"""

from __future__ import annotations

import select
import time
from typing import Any

from pymavlink.dialects.v20 import common as mavlink

from mimopilot.sitl.errors import SitlError
from mimopilot.sitl.mavlink.simulator_api.simulated_vehicle import MAX_CATCH_UP_S, SimulatedVehicle
from mimopilot.sitl.mavlink.wire.codec import MAVLINK_VERSION
from mimopilot.sitl.mavlink.wire.fast_codec import ACTUATORS, READ_BYTES
from mimopilot.sitl.mavlink.wire.serial_ports import open_serial
from mimopilot.sitl.physics.rigid_body import MAX_ROTORS

STALE_S = 0.5  # s without commands after which the motors stop, as speed controllers do; chosen
REOPEN_S = 0.5  # s between attempts to reopen a disconnected port; chosen
HEARTBEAT_S = 1.0  # s, MAVLink's heartbeat interval
WRITE_S = 1.0  # s, write timeout; chosen


class SerialPlant:
    """Serves a simulated vehicle to a board.

    Parameters
    ----------
    vehicle : SimulatedVehicle
        Reset to its start whenever the board disconnects.
    url : str
        ``DEVICE,BAUD``.

    Raises
    ------
    SitlError
        When the port cannot be opened.
    """

    def __init__(self, vehicle: SimulatedVehicle, url: str) -> None:
        self.vehicle = vehicle
        self.device, _, baud = url.partition(",")
        if not self.device or not (baud.isascii() and baud.isdigit()):
            raise SitlError(f"--serial {url}: expected DEVICE,BAUD such as /dev/ttyACM0,921600")
        self.baud = int(baud)
        self.url = url
        self.port = self._open()

    def _open(self) -> Any:
        return open_serial("--serial", self.url, self.device, self.baud, WRITE_S, exclusive=True)

    def serve(self) -> None:
        """Serve for ever; a board that disconnects (they do when they reboot) may reconnect."""
        while True:
            try:
                self._fly()
            except OSError:
                self.port.close()
                self.vehicle.restart()
                self.vehicle.report(f"{self.device} disconnected; the vehicle is reset to its start")
            self._reopen()

    def _reopen(self) -> None:
        while True:
            try:
                self.port = self._open()
                return
            except SitlError:
                time.sleep(REOPEN_S)

    def _fly(self) -> None:
        vehicle = self.vehicle
        controls, mode = (0.0,) * MAX_ROTORS, 0
        heard, stale = -1.0, False
        begin, count = time.monotonic(), 0
        while True:
            self._write(count)
            now = time.monotonic()
            for kind, fields in vehicle.codec.parse(self.port.read(READ_BYTES)):
                if kind is ACTUATORS:
                    controls, mode, heard = fields[2:18], fields[18], now
            if heard < 0:
                vehicle.hold()
            else:
                if stale != (now - heard > STALE_S):
                    stale = not stale
                    self._report_stale(stale)
                vehicle.fly(controls, 0 if stale else mode)
            count += 1
            ahead = begin + count * vehicle.Ts - time.monotonic()
            if ahead > 0:
                time.sleep(ahead)
            elif ahead < -MAX_CATCH_UP_S:
                vehicle.report(f"late by {-ahead:.2f} s, not caught up: this machine is too busy for real time")
                begin, count = time.monotonic(), 0

    def _report_stale(self, stale: bool) -> None:
        when = f"at {self.vehicle.seconds:.2f} s of flight"
        if stale:
            self.vehicle.report(f"no motor commands from the board for {STALE_S:g} s, {when}: the motors stop")
        else:
            self.vehicle.report(f"motor commands resumed, {when}")

    def _write(self, count: int) -> None:
        """Send the messages of this period; a board that does not read misses them."""
        data = self.vehicle.pack_messages(estimate=False)
        if count % round(HEARTBEAT_S / self.vehicle.Ts) == 0:
            state = mavlink.MAV_STATE_ACTIVE
            beat = (0, mavlink.MAV_TYPE_GENERIC, mavlink.MAV_AUTOPILOT_INVALID, 0, state, MAVLINK_VERSION)
            data = self.vehicle.codec.pack(mavlink.MAVLink_heartbeat_message, *beat) + data
        if select.select([], [self.port], [], 0)[1]:
            self.port.write(data * self.vehicle.copies)
