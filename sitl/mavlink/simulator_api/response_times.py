"""How long a frame of the plant waits for its answer, at most; and how much of the time is worked."""

from __future__ import annotations

import time

LATE_S = 1e-3


class ResponseTimes:
    """Times of one loop that waits for a plant and for others.

    Attributes
    ----------
    worst : float, s
        Longest time that a frame can have waited, from when none was there yet to its answer.
    late, periods : int
        Frames that can have waited for more than 1 ms; all frames.
    load : float
        Share of the last second that was worked.
    """

    def __init__(self) -> None:
        self.worst = 0.0
        self.late = self.periods = 0
        self.load = 0.0
        self._empty = self._second = time.monotonic()
        self._slept = 0.0

    def nothing_waits(self, slept: float, now: float) -> None:
        """No frame was there until just now, monotonic time in s; the loop has slept for it."""
        self._empty = now
        self._slept += slept

    def answered(self) -> None:
        """The frame that came is answered."""
        now = time.monotonic()
        waited = now - self._empty
        self._empty = now
        self.periods += 1
        self.worst = max(self.worst, waited)
        self.late += waited > LATE_S
        if now - self._second >= 1:
            self.load = 1 - self._slept / (now - self._second)
            self._second, self._slept = now, 0.0

    def __str__(self) -> str:
        """One line for the console."""
        return (
            f"{self.periods} periods, answered within {1e3 * self.worst:.2f} ms, {self.late} of them after more than "
            f"{1e3 * LATE_S:g} ms"
        )
