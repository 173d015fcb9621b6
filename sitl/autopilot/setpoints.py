"""Inputs that arrive repeatedly from outside: attitude setpoints, sticks, motion capture; each with its age."""

from __future__ import annotations

import math
from typing import Generic, NamedTuple, TypeVar

STALE_SECONDS = 0.5  # timeout; PX4 too needs offboard setpoints at 2 Hz or more

T = TypeVar("T")


class AttitudeSetpoint(NamedTuple):
    """Angles (rad), collective (thrust fraction; None: hold the altitude) and yaw rate (rad/s).

    In rate mode, body rates (rad/s) take the place of the angles.
    """

    roll: float
    pitch: float
    yaw: float
    thrust: float | None
    yaw_rate: float = 0.0
    rate_mode: bool = False


class Sticks(NamedTuple):
    """Stick deflections -1..1: roll right, nose up, nose right, climb."""

    roll: float
    pitch: float
    yaw: float
    climb: float


class Pose(NamedTuple):
    """Pose from motion capture: position (m, in its own frame, down positive) and heading in that frame (rad)."""

    x: float
    y: float
    z: float
    yaw: float


class Stream(Generic[T]):
    """The latest value of a repeated input and its time of arrival (s); nothing is taken over while it is cut."""

    def __init__(self, value: T) -> None:
        self.value = value
        self.time = -math.inf
        self.cut = False

    def put(self, value: T, now: float) -> None:
        """Take over a new value."""
        if not self.cut:
            self.value, self.time = value, now

    def fresh(self, now: float) -> bool:
        """Whether the value has not timed out."""
        return now - self.time <= STALE_SECONDS


def earth_to_heading(north: float, east: float, yaw: float) -> tuple[float, float]:
    """Rotate a horizontal vector from earth axes into the heading: forward and right."""
    c, s = math.cos(yaw), math.sin(yaw)
    return c * north + s * east, c * east - s * north
