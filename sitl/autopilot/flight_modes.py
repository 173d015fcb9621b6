"""Arming, flight modes and failsafes of one vehicle, as PX4's commander has them.

There are no sockets and no clock: time is an argument. The owner calls `Commander.step` once in each control period and
passes its texts on.
"""

from __future__ import annotations

import math
from enum import Enum
from typing import NamedTuple

from mimopilot.sitl.autopilot.failure_detector import MAX_TILT, MAX_TILT_SECONDS
from mimopilot.sitl.autopilot.setpoints import (
    STALE_SECONDS,
    AttitudeSetpoint,
    Pose,
    Sticks,
    Stream,
    earth_to_heading,
)
from mimopilot.sitl.autopilot.vertical import Estimate, VerticalControl
from mimopilot.sitl.physics.rigid_body import GRAVITY

# Chosen, unless another source is given.
LEVEL_SECONDS = 2.0  # level flight after the setpoint timeout, in case setpoints return; then the vehicle lands
MAX_ARM_TILT = math.radians(15.0)  # a slope from which the vehicle takes off safely
MAX_ARM_RATE = 0.5  # rad/s; far above the noise of the estimate
STICK_TILT = math.radians(35.0)  # rad at full deflection; PX4's default of MPC_MAN_TILT_MAX
STICK_YAW, STICK_CLIMB = 1.5, 1.5  # rad/s, m/s at full deflection
CLIMB_SPEED, SINK_SPEED = 1.0, 1.0  # m/s
TOUCHDOWN_SPEED, TOUCHDOWN_HEIGHT = 0.4, 3.0  # m/s below this height, m
MIN_HEIGHT, MAX_HEIGHT = 0.5, 100.0  # m, of a take-off
ARRIVED = 0.2  # m, from the take-off height
HOLD_TILT = math.radians(10.0)  # largest tilt of the position hold: 1.7 m/s^2
MAX_PERIOD = 0.1  # s; a longer gap in the clock counts as this


class Mode(Enum):
    """Flight modes by name."""

    HOLD = "hold"
    TAKEOFF = "take-off"
    LAND = "land"
    ALTITUDE = "altitude"
    OFFBOARD = "offboard"


class Severity(Enum):
    """Severity of a text, numbered as MAV_SEVERITY."""

    EMERGENCY, CRITICAL, WARNING, INFO = 0, 2, 4, 6


class Refused(Exception):  # noqa: N818 - an answer, not an error
    """The vehicle refuses a command now; the message gives the reason (MAV_RESULT_TEMPORARILY_REJECTED)."""


class Denied(Refused):
    """The vehicle refuses a command now and later (MAV_RESULT_DENIED)."""


class Failed(Refused):
    """A command was tried and failed (MAV_RESULT_FAILED)."""


class Demand(NamedTuple):
    """Demand of one period: setpoint, altitude to hold (m; NaN: none) and collective (thrust fraction)."""

    setpoint: AttitudeSetpoint
    altitude: float
    collective: float


class Commander:
    """Arming state and flight mode of one vehicle.

    Parameters
    ----------
    hover : float
        Collective that carries the weight, thrust fraction.

    Attributes
    ----------
    armed, mode
        As ground stations show them.
    arming_blockers : dict
        Reasons against arming that only the owner knows (no plant, a bad parameter): subject -> reason.
    said : list of (Severity, text)
        For the pilot; the owner empties it.
    """

    def __init__(self, hover: float) -> None:
        self.vertical = VerticalControl(hover)
        self.mode = Mode.HOLD
        self.armed = False
        self.arming_blockers: dict[str, str] = {}
        self.said: list[tuple[Severity, str]] = []
        self.attitude = Stream(AttitudeSetpoint(0.0, 0.0, 0.0, None))
        self.sticks = Stream(Sticks(0.0, 0.0, 0.0, 0.0))
        self.pose = Stream(Pose(0.0, 0.0, 0.0, 0.0))
        self.estimate = Estimate()
        self.now = -math.inf
        self._reset_manoeuvre()

    def _reset_manoeuvre(self) -> None:
        """Clear the state of the previous manoeuvre."""
        self._yaw = self.estimate.yaw  # rad, to hold
        self._takeoff_altitude = 0.0  # m
        self._held: tuple[float, float] | None = None  # m, position to hold
        self._timed_out = False
        self._tilted = 0.0  # s, beyond `MAX_TILT`

    @property
    def in_failsafe(self) -> bool:
        """Whether a failsafe flies the vehicle."""
        return self._timed_out

    def say(self, severity: Severity, text: str) -> None:
        """Add a text for the pilot."""
        self.said.append((severity, text))

    # Commands of the pilot.

    def arming_problems(self) -> list[str]:
        """Reasons against arming, the most fundamental first; empty: the vehicle can be armed."""
        found = list(self.arming_blockers.values())
        if found or self.armed:
            return found
        if not self._within_tilt(MAX_ARM_TILT):
            tilt = math.degrees(max(abs(self.estimate.roll), abs(self.estimate.pitch)))
            found.append(f"not level: tilted by {tilt:.0f} degrees, expected at most {math.degrees(MAX_ARM_TILT):.0f}")
        if not all(abs(rate) <= MAX_ARM_RATE for rate in self.estimate.rates):
            found.append(f"rotating faster than {MAX_ARM_RATE:g} rad/s")
        if not self.vertical.landed:
            found.append("not on the ground, or moving")
        if self._lacks_setpoints(self.mode):
            found.append(f"mode {self.mode.value}, but no setpoints arrive")
        return found

    def arm(self, force: bool = False) -> None:
        """Start the rotors; `force` overrides all reasons but those in `arming_blockers`.

        Raises
        ------
        Refused
            With the reason.
        """
        if self.armed:
            return
        found = list(self.arming_blockers.values()) if force else self.arming_problems()
        if found:
            raise Refused(f"not armed: {found[0]}")
        if self.mode in (Mode.TAKEOFF, Mode.LAND):
            self.mode = Mode.HOLD
        self._reset_manoeuvre()
        self.armed = True
        self.say(Severity.INFO, "armed")

    def disarm(self, force: bool = False, why: str = "") -> None:
        """Stop the rotors; in the air only with `force`.

        Raises
        ------
        Refused
            With the reason.
        """
        if not self.armed:
            return
        if not (self.vertical.landed or force):
            raise Refused("not disarmed: in the air; land, or force it (21196)")
        self.armed = False
        self.mode = Mode.HOLD if self.mode in (Mode.TAKEOFF, Mode.LAND) else self.mode
        self.say(Severity.INFO, f"disarmed{why}")

    def take_off(self, height: float) -> None:
        """Climb to a height above the ground, m, and hold it.

        Raises
        ------
        Refused
            With the reason.
        """
        if not MIN_HEIGHT <= height <= MAX_HEIGHT:
            raise Denied(f"no take-off to {height:g} m: expected {MIN_HEIGHT:g} to {MAX_HEIGHT:g} m")
        if not self.armed:
            raise Refused("no take-off: not armed")
        if not self.vertical.landed:
            raise Refused("no take-off: already in the air")
        self._enter(Mode.TAKEOFF)
        self._takeoff_altitude = self.vertical.ground + height

    def enter(self, mode: Mode) -> None:
        """Change the flight mode.

        Raises
        ------
        Refused
            With the reason.
        """
        if mode is Mode.TAKEOFF:
            raise Denied("mode take-off refused: send the command NAV_TAKEOFF with a height")
        if mode is Mode.LAND and not self.armed:
            raise Refused("no landing: not armed")
        if self._lacks_setpoints(mode):
            raise Refused(f"mode {mode.value} refused: no setpoints arrive; send them first")
        self._enter(mode)

    def _setpoints_of(self, mode: Mode) -> Stream[AttitudeSetpoint] | Stream[Sticks] | None:
        """The setpoints that a mode flies by; None: the vehicle flies by itself."""
        if mode is Mode.OFFBOARD:
            return self.attitude
        return self.sticks if mode is Mode.ALTITUDE else None

    def _lacks_setpoints(self, mode: Mode) -> bool:
        """Whether a mode flies by setpoints and they have timed out."""
        stream = self._setpoints_of(mode)
        return stream is not None and not stream.fresh(self.now)

    def _enter(self, mode: Mode) -> None:
        if mode is not self.mode:
            self.say(Severity.INFO, f"mode {mode.value}")
        self.mode = mode
        self._reset_manoeuvre()

    def plant_lost(self, why: str) -> None:
        """Disarm, because the plant is gone."""
        self.arming_blockers["plant"] = why
        self.say(Severity.CRITICAL, f"{why}{', in flight' if self.armed and not self.vertical.landed else ''}")
        self.armed = False
        self.mode = Mode.HOLD
        self.vertical = VerticalControl(self.vertical.hover)

    def plant_back(self) -> None:
        """Start again with a plant, whose clock may differ."""
        self.arming_blockers.pop("plant", None)
        self.now = -math.inf
        for stream in (self.attitude, self.sticks, self.pose):
            stream.time = -math.inf
        self.say(Severity.INFO, "plant connected")

    # Once in each period.

    def step(self, now: float, estimate: Estimate) -> Demand:
        """One control period.

        Parameters
        ----------
        now : float, s
            Clock of the vehicle.
        estimate : Estimate
            Its estimated motion.
        """
        dt = min(max(now - self.now, 0.0), MAX_PERIOD)
        self.now, self.estimate = now, estimate
        if self.armed:
            self._stop_when_lost(dt)
        if not self.armed:
            self.vertical.rest(dt, estimate)
            self._reset_manoeuvre()
            return self._at_rest()
        attitude, speed = self._update_setpoint(dt)
        if attitude.thrust is not None:
            altitude, collective = self.vertical.thrust(dt, estimate, attitude.thrust)
        else:
            altitude, collective = self.vertical.climb(dt, estimate, speed)
        if self.mode is Mode.LAND and self.vertical.landed:
            self.disarm(why=": landed")
            return self._at_rest()
        return Demand(attitude, altitude, collective)

    def _at_rest(self) -> Demand:
        return Demand(AttitudeSetpoint(0.0, 0.0, self.estimate.yaw, None), math.nan, 0.0)

    def _stop_when_lost(self, dt: float) -> None:
        """Stop the rotors when the vehicle is lost, see `sitl.autopilot.failure_detector`."""
        # As in PX4, any tilt is allowed in rate mode.
        flies_rates = self.mode is Mode.OFFBOARD and self.attitude.value.rate_mode and not self._timed_out
        self._tilted = 0.0 if flies_rates or self._within_tilt(MAX_TILT) else self._tilted + dt
        if self._tilted >= MAX_TILT_SECONDS:
            self.say(Severity.EMERGENCY, f"lost: tilted beyond {math.degrees(MAX_TILT):.0f} degrees, rotors stopped")
            self.disarm(force=True)

    def _within_tilt(self, limit: float) -> bool:
        """Whether roll and pitch are within a limit, rad; values that are not finite are not."""
        return abs(self.estimate.roll) <= limit and abs(self.estimate.pitch) <= limit

    def _update_setpoint(self, dt: float) -> tuple[AttitudeSetpoint, float]:
        """Attitude setpoint of this period, and the climb speed (m/s) when it gives no thrust."""
        stream = self._setpoints_of(self.mode)
        if stream is not None and not stream.fresh(self.now):
            self._handle_timeout(stream.time)
        elif stream is not None:
            self._timed_out = False
            return self._follow_sticks(dt) if self.mode is Mode.ALTITUDE else self._follow_attitude()
        roll, pitch = (0.0, 0.0) if self._timed_out else self._update_position_hold()
        return AttitudeSetpoint(roll, pitch, self._yaw, None), self._update_climb()

    def _follow_attitude(self) -> tuple[AttitudeSetpoint, float]:
        given = self.attitude.value
        self._yaw = self.estimate.yaw if given.rate_mode else given.yaw
        return given, 0.0

    def _follow_sticks(self, dt: float) -> tuple[AttitudeSetpoint, float]:
        sticks = self.sticks.value
        self._yaw = math.remainder(self._yaw + dt * STICK_YAW * sticks.yaw, math.tau)
        tilt, yaw_rate = STICK_TILT, STICK_YAW * sticks.yaw
        setpoint = AttitudeSetpoint(tilt * sticks.roll, tilt * sticks.pitch, self._yaw, None, yaw_rate)
        return setpoint, STICK_CLIMB * sticks.climb

    def _handle_timeout(self, last: float) -> None:
        """Failsafe when no setpoint has arrived since `last` (s): level, then land."""
        if not self._timed_out:
            self._timed_out = True
            self.say(Severity.CRITICAL, f"no setpoints for {STALE_SECONDS:g} s: level")
        elif self.now - last > STALE_SECONDS + LEVEL_SECONDS:
            self.say(Severity.CRITICAL, f"no setpoints for {STALE_SECONDS + LEVEL_SECONDS:g} s: landing")
            self._enter(Mode.LAND)

    def _update_climb(self) -> float:
        """Climb speed (m/s) in the modes that the vehicle flies by itself; ends a take-off that has arrived."""
        if self.mode is Mode.TAKEOFF:
            if abs(self._takeoff_altitude - self.estimate.altitude) > ARRIVED:
                return min(CLIMB_SPEED, self._takeoff_altitude - self.vertical.target)
            self.vertical.target = self._takeoff_altitude
            self._enter(Mode.HOLD)
        if self.mode is Mode.LAND:
            high = self.estimate.altitude - self.vertical.ground > TOUCHDOWN_HEIGHT
            return -SINK_SPEED if high else -TOUCHDOWN_SPEED
        return 0.0

    def _update_position_hold(self) -> tuple[float, float]:
        """Roll and pitch (rad) that hold the position seen by motion capture; level without it."""
        if not self.pose.fresh(self.now) or self.vertical.landed:
            self._held = None
            return 0.0, 0.0
        pose, estimate = self.pose.value, self.estimate
        self._held = self._held or (pose.x, pose.y)
        x, y = earth_to_heading(self._held[0] - pose.x, self._held[1] - pose.y, pose.yaw)
        u, v = earth_to_heading(estimate.north, estimate.east, estimate.yaw)
        # 1 rad/s, critically damped, like the altitude hold.
        forward, right = x - 2.0 * u, y - 2.0 * v

        def tilt(acceleration: float) -> float:
            return min(max(acceleration / GRAVITY, -HOLD_TILT), HOLD_TILT)

        return tilt(right), -tilt(forward)
