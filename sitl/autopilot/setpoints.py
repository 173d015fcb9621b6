"""What arrives from outside again and again: set-points, sticks, motion capture; each with its age."""

from __future__ import annotations

import math
from typing import Generic, NamedTuple, TypeVar

STALE_SECONDS = 0.5  # older ones count no more

T = TypeVar("T")


class Attitude(NamedTuple):
    """Set-point from outside: angles (rad) and collective (thrust fraction; None: hold the altitude)."""

    roll: float
    pitch: float
    yaw: float
    thrust: float | None


class Sticks(NamedTuple):
    """Deflections -1..1: roll right, nose up, nose right, climb."""

    roll: float
    pitch: float
    yaw: float
    climb: float


class Pose(NamedTuple):
    """From motion capture: position (m, its own frame, down positive) and heading in it (rad)."""

    x: float
    y: float
    z: float
    yaw: float


class Stream(Generic[T]):
    """The latest of what arrives again and again, and when (s) it did; nothing arrives while it is cut."""

    def __init__(self, value: T) -> None:
        self.value = value
        self.time = -math.inf
        self.cut = False

    def put(self, value: T, now: float) -> None:
        """A new one."""
        if not self.cut:
            self.value, self.time = value, now

    def fresh(self, now: float) -> bool:
        """Whether it still counts."""
        return now - self.time <= STALE_SECONDS


def turned(north: float, east: float, yaw: float) -> tuple[float, float]:
    """A level vector seen from the vehicle: ahead and to the right."""
    c, s = math.cos(yaw), math.sin(yaw)
    return c * north + s * east, c * east - s * north
