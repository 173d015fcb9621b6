"""The check flight's manoeuvre: doublets of the attitude setpoint on one axis after the other, sent to the vehicle.

The setpoints are timed by the vehicle's clock, and the collective holds the altitude: that of the hover, and a
correction from the height that the vehicle reports. See `sitl.mavlink.ground_station.events` for how an exchange is
run.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from mimopilot.sitl.field.flight_watch import not_followed, trip
from mimopilot.sitl.mavlink.ground_station.events import (
    ARDUPILOT,
    AttitudeTarget,
    Exchange,
    Outgoing,
    SendCommand,
)
from mimopilot.sitl.mavlink.ground_station.flight_monitor import FlightMonitor
from mimopilot.sitl.mavlink.ground_station.vehicle_link_state import TRY_S
from mimopilot.sitl.mavlink.wire.dialect import mavlink
from mimopilot.sitl.physics.rigid_body import GRAVITY

# All chosen, unless a source is given:
#: Whole length of a doublet of roll, pitch (of `tuning.analysis.manoeuvres.ROLL_PITCH_FAMILY`) and yaw, slower,
#: s; their number on each axis, and level flight after each, s.
DOUBLET_S, DOUBLETS, LEVEL_S = (1.2, 1.2, 4.0), 2, 1.8
#: Level flight before the first doublet, s: the torque of hover is measured in it.
BEFORE_S = 4.0
#: Largest amplitude (rad), that of the predictions; and the least, which noise and gusts do not hide.
LARGEST, LEAST = math.radians(10.0), math.radians(3.0)
#: Setpoints before the mode is asked for, s: PX4 wants them for longer than a second.
FIRST_S = 1.2
#: Interval between two setpoints, s.
SETPOINT_S = 0.02
#: Until the vehicle is in the mode, s.
MODE_TIMEOUT_S = 10.0
#: Silence of the vehicle's clock after which the setpoint is level, s.
CLOCK_S = 0.5
#: Bandwidth (rad/s) of the altitude hold: slow against the delay of a radio; and its largest share of the hover thrust.
HEIGHT_RATE, HEIGHT_SHARE = 0.8, 0.25
#: Mode of attitude setpoints, main and sub mode and custom_mode: PX4's Offboard; ArduCopter's Guided_NoGPS.
OFFBOARD, GUIDED_NOGPS = (6.0, 0.0, 6 << 16), (20.0, 0.0, 20)
#: ArduCopter takes the collective as a climb rate: this one is level (GUID_OPTIONS, its default).
NO_CLIMB = 0.5


@dataclass(frozen=True)
class DoubletPlan:
    """Doublets on one axis after the other.

    Attributes
    ----------
    amplitude : float, rad
    axes : int
        2: roll and pitch; 3: and yaw.
    """

    amplitude: float
    axes: int = 2

    @property
    def seconds(self) -> float:
        """Length of the flight, s."""
        return BEFORE_S + DOUBLETS * sum(length + LEVEL_S for length in DOUBLET_S[: self.axes])

    def setpoint(self, time: float) -> tuple[float, float, float]:
        """Roll, pitch and change of the heading (rad) at a time (s) since the beginning."""
        angles = [0.0, 0.0, 0.0]
        begin = BEFORE_S
        for axis, length in enumerate(DOUBLET_S[: self.axes]):
            within = (time - begin) % (length + LEVEL_S)
            end = begin + DOUBLETS * (length + LEVEL_S)
            if begin <= time < end and within < length:
                angles[axis] = self.amplitude if within < length / 2 else -self.amplitude
            begin = end
        return angles[0], angles[1], angles[2]


def doublet_plan(flown: float | None, yaw: bool) -> DoubletPlan:
    """Doublets within what an experiment has flown.

    Parameters
    ----------
    flown : float or None, rad
        Size of its manoeuvres; None: not known.
    yaw : bool
        Also of the heading.
    """
    return DoubletPlan(min(LARGEST, max(LEAST, flown or LEAST)), 3 if yaw else 2)


def fly_doublets(watch: FlightMonitor, plan: DoubletPlan) -> Exchange[tuple[str, bool]]:
    """Fly the doublets from hover. The vehicle is left in the mode of setpoints: the caller lands it or hands it back.

    Returns
    -------
    reason : str
        Why they were ended early; empty: they were not.
    tripped : bool
        Because of what the vehicle did under these gains.
    """
    client = watch.client
    assert client.vehicle is not None
    address = client.vehicle.system, client.vehicle.component
    guided = client.vehicle.autopilot == ARDUPILOT
    *mode, number = GUIDED_NOGPS if guided else OFFBOARD
    hover, height, yaw = watch.thrust, watch.altitude, watch.yaw
    begin, ask_at, send_at = client.now, client.now + FIRST_S, client.now
    started: float | None = None
    while True:
        late = client.now - watch.seen["ATTITUDE"] > CLOCK_S
        time = 0.0 if started is None else watch.clock - started
        send: list[Outgoing] = []
        if client.now >= send_at:
            send_at = client.now + SETPOINT_S
            roll, pitch, turn = (0.0, 0.0, 0.0) if late or started is None else plan.setpoint(time)
            thrust = NO_CLIMB if guided else _collective(watch, hover, height)
            send.append(AttitudeTarget(*address, roll, pitch, yaw + turn, thrust))
        if started is None and client.now >= ask_at:
            ask_at = client.now + TRY_S
            parameters = (float(mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED), *mode)
            send.append(SendCommand(*address, mavlink.MAV_CMD_DO_SET_MODE, parameters))
        yield from client.send_and_wait(send, send_at)
        reason = trip(watch, height)
        if reason:
            return reason, True
        reason = "interrupted" if client.interrupted else not_followed(watch)
        if not reason and not client.vehicle.armed:
            reason = "the vehicle was disarmed"
        elif not reason and started is not None and client.vehicle.mode != number:
            reason = "the vehicle left its mode"
        elif not reason and started is None and client.now > begin + FIRST_S + MODE_TIMEOUT_S:
            said = f": {watch.text}" if watch.text else ""
            reason = f"the vehicle does not take attitude setpoints{said}"
        if reason:
            return reason, False
        if started is None and client.vehicle.mode == number:
            started = watch.clock
        if time > plan.seconds:
            return "", False
        client.progress("check flight", round(time), round(plan.seconds))


def _collective(watch: FlightMonitor, hover: float, height: float) -> float:
    """Collective that holds a height (m) from the vehicle's own: a critically damped second-order loop."""
    acceleration = HEIGHT_RATE**2 * (height - watch.altitude) - 2 * HEIGHT_RATE * watch.climb
    share = min(max(acceleration / GRAVITY, -HEIGHT_SHARE), HEIGHT_SHARE)
    return min(max(hover * (1 + share), 0.0), 1.0)
