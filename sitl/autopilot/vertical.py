"""Vertical control: spin-up, climb and altitude targets, hover thrust, ground detection."""

from __future__ import annotations

import math
from dataclasses import dataclass

from mimopilot.sitl.physics.rigid_body import GRAVITY

# All are chosen; a reason that is not obvious is given.
IDLE = 0.2  # share of the hover collective, of rotors that idle on the ground
SPOOL_SECONDS = 1.0  # from stopped rotors to the hover collective
STILL_CLIMB, STILL_RATE = 0.1, 0.15  # m/s, rad/s, above the noise of the estimate: less is no motion
AIRBORNE_CLIMB, AIRBORNE_HEIGHT = 0.2, 0.15  # m/s, m: more than either is flight; above `STILL_CLIMB`
DESCENT_SECONDS = 2.0  # time constants of the altitude hold (1 rad/s) after which a descent has begun
STILL_SECONDS = 0.5  # without motion, after which a vehicle has landed, or a descending one may have
PROBE_SECONDS = 0.7  # to reduce thrust then: a vehicle in the air falls by more than `STILL_CLIMB` within it
LOW_THRUST = 0.7  # share of the hover collective; no level vehicle keeps its altitude on less, see `MAX_TRIM`
MAX_TARGET_LEAD = 3.0  # m, between the altitude target and the vehicle
TRIM_RATE = 0.2  # 1/s, integral gain of the hover thrust: slow against the altitude hold (1 rad/s)
MAX_TRIM = 0.3  # share of the hover collective


@dataclass(slots=True)
class Estimate:
    """Estimated motion of the vehicle.

    Attributes
    ----------
    roll, pitch, yaw : float, rad
    rates : (p, q, r), rad/s
    altitude, climb : float, m, m/s
        Up, from any origin.
    north, east : float, m/s
        Velocity.
    """

    roll: float = 0.0
    pitch: float = 0.0
    yaw: float = 0.0
    rates: tuple[float, float, float] = (0.0, 0.0, 0.0)
    altitude: float = 0.0
    climb: float = 0.0
    north: float = 0.0
    east: float = 0.0


class VerticalControl:
    """Vertical control of one vehicle. Each period calls one of `rest`, `climb` and `thrust`.

    Parameters
    ----------
    hover : float
        Collective that carries the weight, thrust fraction.

    Attributes
    ----------
    landed : bool
        Whether the vehicle stands on something.
    ground : float, m
        Altitude at which it last stood.
    target : float, m
        Altitude to hold.
    ceiling : float
        Largest collective during spin-up, thrust fraction.
    trim : float
        Share that is added to `hover`, learned in the air; a weak motor or a load needs it.
    """

    def __init__(self, hover: float) -> None:
        self.hover = hover
        self.landed = False
        self.ground = 0.0
        self.target = 0.0
        self.ceiling = 0.0
        self.trim = 0.0
        self._still = 0.0  # s, without motion
        self._descent = 0.0  # s, since a descent was commanded

    def rest(self, dt: float, estimate: Estimate) -> None:
        """One period without thrust: a vehicle that does not move has landed."""
        self.ceiling = self.trim = 0.0
        still = abs(estimate.climb) <= STILL_CLIMB and all(abs(rate) <= STILL_RATE for rate in estimate.rates)
        self._still = self._still + dt if still else 0.0
        self.landed = self._still >= STILL_SECONDS
        self._update_ground(estimate)

    def climb(self, dt: float, estimate: Estimate, speed: float) -> tuple[float, float]:
        """One period of climbing at a speed (m/s; negative: descending); 0 holds the altitude.

        Returns
        -------
        altitude : float, m
            To hold; NaN: none, the collective is given.
        collective : float
            Of hover, or the given one; thrust fraction.
        """
        if self.landed and speed <= 0:
            return math.nan, self._idle(dt, estimate)
        self.ceiling += dt * self.hover / SPOOL_SECONDS
        self._detect_takeoff(estimate)
        if self.ceiling < self.hover:
            self._reset_target(estimate)
            return math.nan, self.ceiling
        self.target += speed * dt
        self.target = min(max(self.target, estimate.altitude - MAX_TARGET_LEAD), estimate.altitude + MAX_TARGET_LEAD)
        self._descent = self._descent + dt if speed < 0 else 0.0
        collective = self._probe_ground(dt, estimate, descending=self._descent >= DESCENT_SECONDS)
        if not self.landed and self._still == 0.0:
            # `altitude_hold` adds an acceleration, whose integral over a manoeuvre from rest to rest is zero.
            asked = ((self.target - estimate.altitude) - 2.0 * estimate.climb) / GRAVITY
            self.trim = min(max(self.trim + dt * TRIM_RATE * asked, -MAX_TRIM), MAX_TRIM)
        return (self.target if self._still <= STILL_SECONDS else math.nan), collective

    def thrust(self, dt: float, estimate: Estimate, thrust: float) -> tuple[float, float]:
        """One period with a given collective; returns as `climb` does."""
        if self.landed and thrust <= IDLE * self.hover:
            return math.nan, self._idle(dt, estimate)
        self.ceiling += dt * self.hover / SPOOL_SECONDS
        self._reset_target(estimate)
        self._detect_takeoff(estimate)
        self._probe_ground(dt, estimate, descending=thrust < LOW_THRUST * self.hover)
        return math.nan, min(thrust, self.ceiling)

    def _idle(self, dt: float, estimate: Estimate) -> float:
        """Collective of idling rotors on the ground, after spin-up."""
        self.ceiling = min(self.ceiling + dt * self.hover / SPOOL_SECONDS, IDLE * self.hover)
        self._update_ground(estimate)
        return self.ceiling

    def _update_ground(self, estimate: Estimate) -> None:
        if self.landed:
            self.ground = estimate.altitude
        self._reset_target(estimate)

    def _reset_target(self, estimate: Estimate) -> None:
        """Hold the present altitude."""
        self.target = estimate.altitude
        self._descent = 0.0

    def _detect_takeoff(self, estimate: Estimate) -> None:
        if self.landed and (estimate.climb > AIRBORNE_CLIMB or estimate.altitude > self.ground + AIRBORNE_HEIGHT):
            self.landed = False
            self._still = 0.0

    def _probe_ground(self, dt: float, estimate: Estimate, descending: bool) -> float:
        """Detect the ground: reduce the collective when a descending vehicle does not sink; returns the collective."""
        if self.landed or not descending or abs(estimate.climb) > STILL_CLIMB:
            if self._still > STILL_SECONDS:
                self._reset_target(estimate)  # it sank under reduced thrust, so it is in the air
            self._still = 0.0
            return self.hover * (1 + self.trim)
        self._still += dt
        progress = (self._still - STILL_SECONDS) / PROBE_SECONDS
        if progress >= 1:
            self.landed = True
            self._update_ground(estimate)
        return self.hover * (1 + self.trim) * (1 - (1 - IDLE) * min(max(progress, 0.0), 1.0))
