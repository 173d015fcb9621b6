"""What the acknowledgements of a stock PX4 say of one run of its autotune; see `px4_autotune`."""

from __future__ import annotations

from dataclasses import dataclass, field

from pymavlink.dialects.v20 import common as mavlink

from mimopilot.sitl.mavlink.ground_station.events import CommandAck

#: Progress -> the axis that is excited, or was before the pause.
AXES = {20: "roll", 40: "pitch", 60: "yaw"}
AFTER_AXES = 80  # progress from here on: nothing is excited any more
CONVERGED_S, GIVE_UP_S = 5.0, 19.0  # PX4: an axis takes 5 s or more; the module gives up after 20 s
PAUSE_S = 2.0  # PX4: after each axis


@dataclass
class Px4AutotuneRun:
    """What is known of one run of the autotune; times by the vehicle's clock, s.

    Attributes
    ----------
    requested : bool
        The vehicle has acknowledged the start.
    begun : bool
        It has excited an axis.
    ended : bool
        The autotune is idle again.
    result : int or None
        Last MAV_RESULT that is not "in progress".
    axis : str
        Excited last; "end": none any more.
    since : float
        When that began.
    seconds : dict
        Axis -> its duration so far, with the pause after it.
    """

    requested: bool = False
    begun: bool = False
    ended: bool = False
    result: int | None = None
    axis: str = ""
    since: float = 0.0
    seconds: dict[str, float] = field(default_factory=dict)

    @property
    def over(self) -> bool:
        """Whether nothing is excited any more."""
        return self.axis == "end" or self.result is not None

    def pass_time(self, now: float) -> None:
        """Count the time of the axis."""
        if self.axis in AXES.values() and not self.over:
            self.seconds[self.axis] = now - self.since

    @property
    def excited(self) -> float:
        """Duration of the excitation of all axes, s, to the interval of the requests."""
        return sum(max(0.0, seconds - PAUSE_S) for seconds in self.seconds.values())

    def note(self, ack: CommandAck, now: float) -> None:
        """Record an acknowledgement that came at a time."""
        self.pass_time(now)
        if ack.result == mavlink.MAV_RESULT_IN_PROGRESS:
            self.requested = True
            axis = AXES.get(ack.progress, "end" if ack.progress >= AFTER_AXES else "")
            if axis != self.axis and axis:
                self.axis, self.since, self.begun = axis, now, True
        elif self.begun or ack.result not in (mavlink.MAV_RESULT_ACCEPTED, mavlink.MAV_RESULT_FAILED):
            # A result before this run has begun is that of the run before.
            self.result = ack.result

    def problem(self, text: str) -> str:
        """Why it is no whole excitation of all axes; empty: it is."""
        if self.axis == "end" or self.result == mavlink.MAV_RESULT_ACCEPTED:
            return ""
        spent = self.seconds.get(self.axis, 0.0)
        if self.axis == "yaw" and spent >= CONVERGED_S:
            return ""
        if spent >= GIVE_UP_S:
            return f"PX4's autotune gave up on {self.axis} after 20 s: its model did not converge; raise --amplitude"
        return f"the vehicle ended its autotune in {self.axis or 'the beginning'} (a stick moved?): {text}"
