"""The vehicle as its pilot meets it: armed or not, flight modes, refusals and what it does when nobody steers.

No sockets and no clock: time is given. Whoever owns the vehicle calls `Vehicle.step` once a control period and
hands on what it says.
"""

from __future__ import annotations

import math
from enum import Enum
from typing import NamedTuple

from mimopilot.sitl.autopilot.setpoints import STALE_SECONDS, Attitude, Pose, Sticks, Stream, turned
from mimopilot.sitl.autopilot.vertical import Estimate, Lift
from mimopilot.sitl.physics.rigid_body import GRAVITY

LEVEL_SECONDS = 2.0  # without set-points the vehicle is kept level for so long, and lands
MAX_ARM_TILT = math.radians(15.0)
MAX_ARM_RATE = 0.5  # rad/s
MAX_TILT = math.radians(60.0)  # of a set-point, and of a vehicle that is not lost
LOST_SECONDS = 0.3
STICK_TILT, STICK_YAW, STICK_CLIMB = math.radians(35.0), 1.5, 1.5  # rad, rad/s, m/s at full deflection
CLIMB_SPEED, SINK_SPEED = 1.0, 1.0  # m/s
TOUCHDOWN_SPEED, TOUCHDOWN_HEIGHT = 0.4, 3.0  # m/s below this height, m
MIN_HEIGHT, MAX_HEIGHT = 0.5, 100.0  # m, of a take-off
ARRIVED = 0.2  # m
HOLD_TILT = math.radians(10.0)  # farthest that it leans to hold a position


class Mode(Enum):
    """Flight modes by name."""

    HOLD = "hold"
    TAKEOFF = "take-off"
    LAND = "land"
    ALTITUDE = "altitude"
    OFFBOARD = "offboard"


class Severity(Enum):
    """How urgent a text is, by MAVLink's numbers."""

    EMERGENCY, CRITICAL, WARNING, INFO = 0, 2, 4, 6


class Refused(Exception):  # noqa: N818 - an answer, not an error
    """The vehicle does not do that now: the message says why."""


class Denied(Refused):
    """Neither now nor later."""


class Failed(Refused):
    """It was tried, in vain."""


class Demand(NamedTuple):
    """What one period is to fly: angles (rad), altitude to hold (m; NaN: none) and collective."""

    roll: float
    pitch: float
    yaw: float
    altitude: float
    collective: float


class Vehicle:
    """State of one vehicle.

    Parameters
    ----------
    hover : float
        Collective that carries its weight, thrust fraction.

    Attributes
    ----------
    armed, mode
        As ground stations show them.
    obstacles : dict
        What forbids arming and is known outside only (no plant, a bad parameter): subject -> reason.
    said : list of (Severity, text)
        For the pilot; whoever owns the vehicle empties it.
    """

    def __init__(self, hover: float) -> None:
        self.lift = Lift(hover)
        self.mode = Mode.HOLD
        self.armed = False
        self.obstacles: dict[str, str] = {}
        self.said: list[tuple[Severity, str]] = []
        self.attitude = Stream(Attitude(0.0, 0.0, 0.0, None))
        self.sticks = Stream(Sticks(0.0, 0.0, 0.0, 0.0))
        self.pose = Stream(Pose(0.0, 0.0, 0.0, 0.0))
        self.estimate = Estimate()
        self.now = -math.inf
        self._forget()

    def _forget(self) -> None:
        """Leave what belonged to the manoeuvre before."""
        self._yaw = self.estimate.yaw
        self._height = 0.0
        self._place: tuple[float, float] | None = None
        self._stale = False
        self._tilted = 0.0

    @property
    def in_trouble(self) -> bool:
        """Whether it flies otherwise than it was told."""
        return self._stale

    def say(self, severity: Severity, text: str) -> None:
        """Tell the pilot."""
        self.said.append((severity, text))

    # What the pilot asks for.

    def complaints(self) -> list[str]:
        """Why the vehicle cannot be armed, the most fundamental reason first; empty: it can."""
        found = list(self.obstacles.values())
        if found or self.armed:
            return found
        if not self._upright(MAX_ARM_TILT):
            tilt = math.degrees(max(abs(self.estimate.roll), abs(self.estimate.pitch)))
            found.append(f"not level: tilted by {tilt:.0f} degrees, at most {math.degrees(MAX_ARM_TILT):.0f}")
        if not all(abs(rate) <= MAX_ARM_RATE for rate in self.estimate.rates):
            found.append("it turns")
        if not self.lift.landed:
            found.append("not on the ground, or it moves")
        if self._unsteered(self.mode):
            found.append(f"mode {self.mode.value}, but no set-points arrive")
        return found

    def arm(self, force: bool = False) -> None:
        """Start the rotors; `force` overrides all complaints but those of `obstacles`.

        Raises
        ------
        Refused
            With the reason.
        """
        if self.armed:
            return
        found = list(self.obstacles.values()) if force else self.complaints()
        if found:
            raise Refused(f"not armed: {found[0]}")
        if self.mode in (Mode.TAKEOFF, Mode.LAND):
            self.mode = Mode.HOLD
        self._forget()
        self.armed = True
        self.say(Severity.INFO, "armed")

    def disarm(self, force: bool = False, why: str = "") -> None:
        """Stop the rotors; in the air only by `force`.

        Raises
        ------
        Refused
            With the reason.
        """
        if not self.armed:
            return
        if not (self.lift.landed or force):
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
        if not self.lift.landed:
            raise Refused("no take-off: in the air already")
        self._enter(Mode.TAKEOFF)
        self._height = self.lift.ground + height

    def enter(self, mode: Mode) -> None:
        """Change the flight mode.

        Raises
        ------
        Refused
            With the reason.
        """
        if mode is Mode.TAKEOFF:
            raise Denied("take-off is a command, with a height: NAV_TAKEOFF")
        if mode is Mode.LAND and not self.armed:
            raise Refused("no landing: not armed")
        if self._unsteered(mode):
            raise Refused(f"mode {mode.value} refused: no set-points arrive, send them first")
        self._enter(mode)

    def _unsteered(self, mode: Mode) -> bool:
        """Whether a mode flies by set-points and there are none."""
        return (mode is Mode.OFFBOARD and not self.attitude.fresh(self.now)) or (
            mode is Mode.ALTITUDE and not self.sticks.fresh(self.now)
        )

    def _enter(self, mode: Mode) -> None:
        if mode is not self.mode:
            self.say(Severity.INFO, f"mode {mode.value}")
        self.mode = mode
        self._forget()

    def plant_lost(self, why: str) -> None:
        """The body is gone: whatever flew flies no more."""
        self.obstacles["plant"] = why
        self.say(Severity.CRITICAL, f"{why}{', in flight' if self.armed and not self.lift.landed else ''}")
        self.armed = False
        self.mode = Mode.HOLD
        self.lift = Lift(self.lift.hover)

    def plant_back(self) -> None:
        """A body is there, its clock may be another one."""
        self.obstacles.pop("plant", None)
        self.now = -math.inf
        for stream in (self.attitude, self.sticks, self.pose):
            stream.time = -math.inf
        self.say(Severity.INFO, "plant connected")

    # What happens once a period.

    def step(self, now: float, estimate: Estimate) -> Demand:
        """One control period.

        Parameters
        ----------
        now : float, s
            The vehicle's clock.
        estimate : Estimate
            Its motion.
        """
        dt = min(max(now - self.now, 0.0), 0.1)
        self.now, self.estimate = now, estimate
        if self.armed:
            self._watch(dt)
        if not self.armed:
            self.lift.rest(dt, estimate)
            self._forget()
            return Demand(0.0, 0.0, estimate.yaw, math.nan, 0.0)
        attitude, speed = self._steer(dt)
        if attitude.thrust is not None:
            altitude, collective = self.lift.thrust(dt, estimate, attitude.thrust)
        else:
            altitude, collective = self.lift.climb(dt, estimate, speed)
        if self.mode is Mode.LAND and self.lift.landed:
            self.disarm(why=": landed")
            return Demand(0.0, 0.0, estimate.yaw, math.nan, 0.0)
        return Demand(attitude.roll, attitude.pitch, attitude.yaw, altitude, collective)

    def _watch(self, dt: float) -> None:
        """Stop the rotors of a vehicle that is lost."""
        self._tilted = 0.0 if self._upright(MAX_TILT) else self._tilted + dt
        if self._tilted >= LOST_SECONDS:
            self.say(Severity.EMERGENCY, "lost: tilted too far for too long, rotors stopped")
            self.disarm(force=True)

    def _upright(self, limit: float) -> bool:
        """Whether it tilts by no more than a limit, rad; what is not finite does."""
        return abs(self.estimate.roll) <= limit and abs(self.estimate.pitch) <= limit

    def _steer(self, dt: float) -> tuple[Attitude, float]:
        """Attitude set-point of the mode, and the speed to climb with where it gives no thrust."""
        if self.mode is Mode.OFFBOARD and self._alive(self.attitude):
            self._yaw = self.attitude.value.yaw
            return self.attitude.value, 0.0
        if self.mode is Mode.ALTITUDE and self._alive(self.sticks):
            sticks = self.sticks.value
            self._yaw = math.remainder(self._yaw + dt * STICK_YAW * sticks.yaw, math.tau)
            return Attitude(STICK_TILT * sticks.roll, STICK_TILT * sticks.pitch, self._yaw, None), (
                STICK_CLIMB * sticks.climb
            )
        roll, pitch = (0.0, 0.0) if self._stale else self._stay()
        return Attitude(roll, pitch, self._yaw, None), self._speed()

    def _speed(self) -> float:
        """Of climbing, in the modes that the vehicle flies by itself."""
        if self.mode is Mode.TAKEOFF:
            if abs(self._height - self.estimate.altitude) > ARRIVED:
                return min(CLIMB_SPEED, self._height - self.lift.target)
            self.lift.target = self._height
            self._enter(Mode.HOLD)
        if self.mode is Mode.LAND:
            high = self.estimate.altitude - self.lift.ground > TOUCHDOWN_HEIGHT
            return -SINK_SPEED if high else -TOUCHDOWN_SPEED
        return 0.0

    def _alive(self, stream: Stream[Attitude] | Stream[Sticks]) -> bool:
        """Whether set-points arrive; when not, the vehicle levels, and lands when that lasts."""
        if stream.fresh(self.now):
            self._stale = False
            return True
        if not self._stale:
            self._stale = True
            self.say(Severity.CRITICAL, f"no set-points for {STALE_SECONDS:g} s: level")
        elif self.now - stream.time > STALE_SECONDS + LEVEL_SECONDS:
            self.say(Severity.CRITICAL, f"no set-points for {STALE_SECONDS + LEVEL_SECONDS:g} s: landing")
            self._enter(Mode.LAND)
        return False

    def _stay(self) -> tuple[float, float]:
        """Roll and pitch that hold the place where motion capture sees the vehicle; level without it."""
        if not self.pose.fresh(self.now) or self.lift.landed:
            self._place = None
            return 0.0, 0.0
        pose, estimate = self.pose.value, self.estimate
        self._place = self._place or (pose.x, pose.y)
        x, y = turned(self._place[0] - pose.x, self._place[1] - pose.y, pose.yaw)
        u, v = turned(estimate.north, estimate.east, estimate.yaw)
        # 1 rad/s, critically damped, as the altitude is held.
        ahead, right = x - 2.0 * u, y - 2.0 * v

        def lean(acceleration: float) -> float:
            return min(max(acceleration / GRAVITY, -HOLD_TILT), HOLD_TILT)

        return lean(right), -lean(ahead)
