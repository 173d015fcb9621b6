"""How high and how hard: rotors spin up, an altitude is held or left, and the ground is found."""

from __future__ import annotations

import math
from dataclasses import dataclass

from mimopilot.sitl.physics.rigid_body import GRAVITY

IDLE = 0.2  # collective of rotors that turn on the ground, as a share of hover's
SPOOL_SECONDS = 1.0  # from standing rotors to the collective of hover
STILL_CLIMB, STILL_RATE = 0.1, 0.15  # m/s, rad/s: a vehicle that moves less stands
LIFTED_CLIMB, LIFTED_HEIGHT = 0.2, 0.15  # m/s, m: a vehicle that does more has left the ground
DESCENT_SECONDS = 2.0  # a descent has begun for certain
STILL_SECONDS = 0.5  # a vehicle that should sink and does not may stand on something
PROOF_SECONDS = 0.7  # then thrust goes down for so long: one that flies would fall
LOW_THRUST = 0.7  # of hover's: nothing flies on less
LEASH = 3.0  # m, farthest that the altitude to hold may run ahead of the vehicle
TRIM_RATE = 0.2  # 1/s: how fast thrust that is asked for lastingly becomes part of hover's
MAX_TRIM = 0.3  # share of hover's collective


@dataclass(slots=True)
class Estimate:
    """What the vehicle knows of its motion.

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


class Lift:
    """The vertical part of flying.

    Parameters
    ----------
    hover : float
        Collective that carries the weight, thrust fraction.

    Attributes
    ----------
    landed : bool
        The vehicle stands on something.
    ground : float, m
        Altitude where it last stood.
    trim : float
        Learned in the air: how much more than `hover` it takes, as a share. A weak motor or a load asks for it.
    """

    def __init__(self, hover: float) -> None:
        self.hover = hover
        self.landed = False
        self.ground = 0.0
        self.target = 0.0
        self.ceiling = 0.0
        self.trim = 0.0
        self._still = 0.0
        self._descent = 0.0

    def rest(self, dt: float, estimate: Estimate) -> None:
        """One period without thrust: a vehicle that does not move stands."""
        self.ceiling = self.trim = 0.0
        still = abs(estimate.climb) <= STILL_CLIMB and all(abs(rate) <= STILL_RATE for rate in estimate.rates)
        self._still = self._still + dt if still else 0.0
        self.landed = self._still >= STILL_SECONDS
        self._stand(estimate)

    def climb(self, dt: float, estimate: Estimate, speed: float) -> tuple[float, float]:
        """One period of climbing at a speed (m/s, below 0: sinking); 0 holds the altitude.

        Returns
        -------
        altitude : float, m
            To be held; NaN: none, the collective is given.
        collective : float
            To start from, thrust fraction.
        """
        if self.landed and speed <= 0:
            return math.nan, self._idle(dt, estimate)
        self.ceiling += dt * self.hover / SPOOL_SECONDS
        self._leave(estimate)
        if self.ceiling < self.hover:
            self._aim(estimate)
            return math.nan, self.ceiling
        self.target += speed * dt
        self.target = min(max(self.target, estimate.altitude - LEASH), estimate.altitude + LEASH)
        self._descent = self._descent + dt if speed < 0 else 0.0
        collective = self._feel(dt, estimate, sinks=self._descent >= DESCENT_SECONDS)
        if not self.landed and self._still == 0.0:
            # What `altitude_hold` adds is acceleration: over a manoeuvre from rest to rest it comes to nothing.
            asked = ((self.target - estimate.altitude) - 2.0 * estimate.climb) / GRAVITY
            self.trim = min(max(self.trim + dt * TRIM_RATE * asked, -MAX_TRIM), MAX_TRIM)
        return (self.target if self._still <= STILL_SECONDS else math.nan), collective

    def thrust(self, dt: float, estimate: Estimate, thrust: float) -> tuple[float, float]:
        """One period with a given collective; returns as `climb` does."""
        if self.landed and thrust <= IDLE * self.hover:
            return math.nan, self._idle(dt, estimate)
        self.ceiling += dt * self.hover / SPOOL_SECONDS
        self._aim(estimate)
        self._leave(estimate)
        self._feel(dt, estimate, sinks=thrust < LOW_THRUST * self.hover)
        return math.nan, min(thrust, self.ceiling)

    def _idle(self, dt: float, estimate: Estimate) -> float:
        self.ceiling = min(self.ceiling + dt * self.hover / SPOOL_SECONDS, IDLE * self.hover)
        self._stand(estimate)
        return self.ceiling

    def _stand(self, estimate: Estimate) -> None:
        if self.landed:
            self.ground = estimate.altitude
        self._aim(estimate)

    def _aim(self, estimate: Estimate) -> None:
        """Hold from here."""
        self.target = estimate.altitude
        self._descent = 0.0

    def _leave(self, estimate: Estimate) -> None:
        if self.landed and (estimate.climb > LIFTED_CLIMB or estimate.altitude > self.ground + LIFTED_HEIGHT):
            self.landed = False
            self._still = 0.0

    def _feel(self, dt: float, estimate: Estimate, sinks: bool) -> float:
        """Feel for the ground: the collective goes down under a vehicle that should sink and does not."""
        if self.landed or not sinks or abs(estimate.climb) > STILL_CLIMB:
            if self._still > STILL_SECONDS:
                self._aim(estimate)  # it fell: so it flies
            self._still = 0.0
            return self.hover * (1 + self.trim)
        self._still += dt
        proof = (self._still - STILL_SECONDS) / PROOF_SECONDS
        if proof >= 1:
            self.landed = True
            self._stand(estimate)
        return self.hover * (1 + self.trim) * (1 - (1 - IDLE) * min(max(proof, 0.0), 1.0))
