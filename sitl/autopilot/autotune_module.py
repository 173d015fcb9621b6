"""The autotune of the bench's stock PX4: it moves the rate setpoint of one axis after the other, and tunes nothing.

Its states, times and signal are those of PX4 v1.16 (mc_autotune_attitude_control): a square signal whose holds become
shorter, behind a high-pass of 0.2 s, at 10 Hz. Each axis ends after the time that PX4's own estimate took in a recorded
flight. It ends early when a stick moves, and does not look at tilt or mode.
"""

from __future__ import annotations

from collections.abc import Iterator, MutableMapping
from enum import IntEnum

from mimopilot.sitl.autopilot.excitation_injector import NO_MOMENT, Moment
from mimopilot.sitl.autopilot.setpoints import Sticks
from mimopilot.tuning.px4_names import AUTOTUNE_AMPLITUDE, AUTOTUNE_START

PUBLISHED_S = 0.1  # s between two values of the signal
FILTER_S = 0.2  # s, time constant of the high-pass
MEASURED_SAMPLES = 1000  # control periods that are measured before the first axis
STICK = 0.05  # deflection of roll or pitch that ends it
LONGEST, AGAIN = 10, 5  # values in the first hold, and in those that follow the shortest one


class State(IntEnum):
    """States, numbered as in autotune_attitude_control_status."""

    IDLE, INIT, ROLL, ROLL_PAUSE, PITCH, PITCH_PAUSE, YAW, YAW_PAUSE = range(8)
    VERIFICATION, APPLY, TEST, COMPLETE, FAIL = range(8, 13)


#: States in which roll, pitch and yaw are moved.
AXIS_STATES = (State.ROLL, State.PITCH, State.YAW)
#: State -> its duration, s, and the next one; the axes' as in the recorded flight.
SEQUENCE = {
    State.ROLL: (5.1, State.ROLL_PAUSE),
    State.ROLL_PAUSE: (2.0, State.PITCH),
    State.PITCH: (5.1, State.PITCH_PAUSE),
    State.PITCH_PAUSE: (2.0, State.YAW),
    State.YAW: (10.0, State.YAW_PAUSE),
    State.YAW_PAUSE: (2.0, State.VERIFICATION),
    State.VERIFICATION: (0.0, State.APPLY),
    State.APPLY: (0.0, State.COMPLETE),
    State.COMPLETE: (2.0, State.IDLE),
    State.FAIL: (2.0, State.IDLE),
}
#: State -> progress in the acknowledgement, %.
PROGRESS = {
    State.IDLE: 0,
    State.INIT: 0,
    State.ROLL: 20,
    State.ROLL_PAUSE: 20,
    State.PITCH: 40,
    State.PITCH_PAUSE: 40,
    State.YAW: 60,
    State.YAW_PAUSE: 60,
    State.VERIFICATION: 80,
    State.APPLY: 85,
    State.COMPLETE: 100,
    State.FAIL: 0,
}


def square_signal() -> Iterator[float]:
    """The square signal, 0 or 1, a value each `PUBLISHED_S`; a short first hold keeps the vehicle in place."""
    level, hold, left = 1.0, LONGEST, LONGEST - AGAIN + 1
    while True:
        for _ in range(left):
            yield level
        level, hold = 1.0 - level, hold - 1 if hold > 1 else AGAIN
        left = hold + 1


class AutotuneModule:
    """The module, as it runs after a boot with MC_AT_EN.

    Parameters
    ----------
    parameters : mapping
        The vehicle's, by name; MC_AT_START goes back to 0 at the end.
    """

    def __init__(self, parameters: MutableMapping[str, float]) -> None:
        self.parameters = parameters
        self.state = State.IDLE
        self._since = self._published = 0.0
        self._samples = 0
        self._signal: Iterator[float] = iter(())
        self._low = 0.0  # state of the low-pass whose rest is the signal
        self._value: Moment = NO_MOMENT

    def step(self, now: float, armed: bool, sticks: Sticks) -> Moment:
        """One control period: what is added to the rate setpoint (rad/s); `now` is the vehicle's clock, s."""
        # Also while it waits: the values of a second run are published at the same times as those of the first.
        published = now - self._published >= PUBLISHED_S - 1e-6 or now < self._published
        if published:
            self._published = now
        if self.state is State.IDLE and self.parameters[AUTOTUNE_START] == 0:
            return NO_MOMENT
        if not armed:
            return NO_MOMENT
        self._samples += 1
        if published:
            self._update_state(now, sticks)
            self._value = self._next_value()
        return self._value

    def _update_state(self, now: float, sticks: Sticks) -> None:
        if self.state is State.IDLE:
            self._enter(State.INIT, now)
        elif self.state is State.INIT:
            if self._samples > MEASURED_SAMPLES:
                self._enter(State.ROLL, now)
        elif now - self._since > SEQUENCE[self.state][0]:
            self._enter(SEQUENCE[self.state][1], now)
        if self.state not in (State.IDLE, State.FAIL) and max(abs(sticks.roll), abs(sticks.pitch)) > STICK:
            self._enter(State.FAIL, now)

    def _enter(self, state: State, now: float) -> None:
        self.state, self._since = state, now
        if state in AXIS_STATES:
            self._signal, self._low = square_signal(), 0.0
        if state is State.IDLE:
            self.parameters[AUTOTUNE_START] = 0.0

    def _next_value(self) -> Moment:
        if self.state not in AXIS_STATES:
            return NO_MOMENT
        wanted = self.parameters[AUTOTUNE_AMPLITUDE] * next(self._signal)
        value = wanted - self._low
        self._low += PUBLISHED_S / (PUBLISHED_S + FILTER_S) * (wanted - self._low)
        axis = AXIS_STATES.index(self.state)
        return (value if axis == 0 else 0.0, value if axis == 1 else 0.0, value if axis == 2 else 0.0)
