"""Response times of the control loop to frames of the plant, and its processor load."""

from __future__ import annotations

import time

LATE_S = 1e-3  # s; chosen: a quarter of the default control period


class ResponseTimes:
    """Response times of one control loop.

    Attributes
    ----------
    worst : float, s
        Upper bound of the longest response: from the last time that no frame was waiting to the answer.
    late, periods : int
        Frames that may have waited longer than `LATE_S`; all frames.
    load : float
        Share of the last second in which the loop did not sleep.
    """

    def __init__(self) -> None:
        self.worst = 0.0
        self.late = self.periods = 0
        self.load = 0.0
        self._empty = self._second = time.monotonic()
        self._slept = 0.0

    def note_idle(self, slept: float, now: float) -> None:
        """No frame was waiting until `now`, monotonic time in s; the loop slept for `slept` s."""
        self._empty = now
        self._slept += slept

    def note_answer(self) -> None:
        """A frame was answered now."""
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
