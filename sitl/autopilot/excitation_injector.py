"""Excitation of a vehicle under a ground station: a PRBS torque, requested by one parameter.

The rules are those of the injector in the firmware (`vehicle/excitation.hpp`), so one client serves both.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from enum import Enum
from typing import NamedTuple

import numpy as np

from mimopilot.tuning.excitation import YAW_HOLD, pulses

#: The parameter that starts and stops the excitation.
AXIS = "MIMO_EX_AX"
PAUSE_S = 1.0  # between two axes, as in the firmware
#: rad, rad/s: turn since yaw's excitation began, and yaw rate, that stop it, as in the firmware. Chosen: PX4's own
#: autotune moves a heading by 0.8 rad, at up to 1.5 rad/s.
MAX_TURN, MAX_YAW_RATE = 0.8, 2.0
STICK_MOVE = 0.1  # change of a deflection that stops the excitation, as in the firmware

Moment = tuple[float, float, float]
NO_MOMENT: Moment = (0.0, 0.0, 0.0)


class ExcitationPhase(Enum):
    """Phase of the injector, numbered as in logs and DEBUG_VECT."""

    OFF = -1
    ROLL = 0
    PITCH = 1
    PAUSE = 2
    YAW = 3
    WAITING = -2

    @property
    def published(self) -> int:
        """Number in logs and DEBUG_VECT, where waiting is off."""
        return ExcitationPhase.OFF.value if self is ExcitationPhase.WAITING else self.value


class Conditions(NamedTuple):
    """State of the vehicle in one period.

    Attributes
    ----------
    ready : bool
        Armed, in the air, measurements healthy.
    mode : int
        Flight mode, numbered as PX4's nav_state.
    attitude : (roll, pitch), rad
    yaw_rate : float, rad/s
    sticks : tuple of 4 float
        Deflections -1..1; zeros without sticks.
    """

    ready: bool
    mode: int
    attitude: tuple[float, float]
    sticks: tuple[float, float, float, float]
    yaw_rate: float = 0.0


#: Value of `AXIS` -> the axes it excites, one after the other.
PHASES = {
    1: (ExcitationPhase.ROLL,),
    2: (ExcitationPhase.PITCH,),
    3: (ExcitationPhase.ROLL, ExcitationPhase.PITCH),
    4: (ExcitationPhase.YAW,),
    5: (ExcitationPhase.ROLL, ExcitationPhase.PITCH, ExcitationPhase.YAW),
}
#: Phase -> axis of the torque.
COLUMNS = {ExcitationPhase.ROLL: 0, ExcitationPhase.PITCH: 1, ExcitationPhase.YAW: 2}


class Injector:
    """Injects a PRBS torque on one axis, or on one after the other.

    Setting `AXIS` from 0 to a key of `PHASES` requests one run. It begins when the vehicle is ready and in its mode. It
    ends after its duration, or when the vehicle is not ready, leaves the mode or tilts too far, or a stick moves; on
    yaw also when it turns too fast or too far. The next run needs 0 first.

    Parameters
    ----------
    Ts : float, s
        Control period.

    Attributes
    ----------
    phase : ExcitationPhase
    turned : float, rad
        By the yaw rate since yaw's excitation began: an estimator's heading reset is no turn.
    said : list of str
        Texts for the pilot; the owner empties it.
    """

    def __init__(self, Ts: float) -> None:
        self.Ts = Ts
        self.phase = ExcitationPhase.OFF
        self.turned = 0.0
        self.said: list[str] = []
        self._axes: list[ExcitationPhase] = []  # after this one
        self._held: Mapping[str, float] | None = None
        self._settings: Mapping[str, float] = {}
        self._pulses: Iterator[tuple[float, int]] = iter(())
        self._sign = 0.0
        self._pulse = self._left = 0  # samples left of the pulse, and of the phase
        self._sticks = (0.0, 0.0, 0.0, 0.0)

    @property
    def running(self) -> bool:
        """Whether a run has begun and not ended."""
        return self.phase not in (ExcitationPhase.OFF, ExcitationPhase.WAITING)

    def configure(self, settings: Mapping[str, float]) -> None:
        """Take over settings, name -> value of `tuning.parameters.EXCITATION`; the first ones start no run."""
        asked = self._held is not None and self._held[AXIS] == 0 and settings[AXIS] != 0
        self._held = settings
        if settings[AXIS] == 0:
            if self.phase is not ExcitationPhase.OFF:
                self._stop("cancelled")
        elif asked and settings["MIMO_EX_HMIN"] <= settings["MIMO_EX_HMAX"]:
            # The run keeps the settings of now.
            self._settings = settings
            self._enter(ExcitationPhase.WAITING)
        elif asked:
            self._stop("refused: MIMO_EX_HMIN is above MIMO_EX_HMAX")

    def step(self, conditions: Conditions) -> Moment:
        """One control period: the torque (normalised) to add on roll, pitch and yaw."""
        if self.phase is ExcitationPhase.OFF:
            return NO_MOMENT
        if self.phase is ExcitationPhase.WAITING:
            self._sticks = conditions.sticks
            if self._reason_to_stop(conditions):
                return NO_MOMENT
            first, *self._axes = PHASES[int(self._settings[AXIS])]
            self._begin(first)
        if self.phase is ExcitationPhase.YAW:
            self.turned += conditions.yaw_rate * self.Ts
        reason = self._reason_to_stop(conditions)
        if reason:
            self._stop(reason)
            return NO_MOMENT
        if self._left == 0 and not self._advance():
            return NO_MOMENT
        self._left -= 1
        if self.phase is ExcitationPhase.PAUSE:
            return NO_MOMENT
        if self._pulse == 0:
            self._sign, self._pulse = next(self._pulses)
        self._pulse -= 1
        column = COLUMNS[self.phase]
        moment = [0.0, 0.0, 0.0]
        moment[column] = self._sign * self._settings["MIMO_EX_AMPY" if column == 2 else "MIMO_EX_AMP"]
        return moment[0], moment[1], moment[2]

    def _reason_to_stop(self, conditions: Conditions) -> str:
        """Why nothing may be injected now; empty: injection is allowed."""
        if not conditions.ready or conditions.mode != self._settings["MIMO_EX_MODE"]:
            return "stopped: mode left, on the ground or disarmed"
        if not max(map(abs, conditions.attitude)) <= self._settings["MIMO_EX_TILT"]:
            return "stopped: tilt beyond MIMO_EX_TILT"
        if self.phase is ExcitationPhase.YAW and not (
            abs(self.turned) <= MAX_TURN and abs(conditions.yaw_rate) <= MAX_YAW_RATE
        ):
            return "stopped: turned too fast or too far"
        if any(abs(new - old) > STICK_MOVE for new, old in zip(conditions.sticks, self._sticks, strict=True)):
            return "stopped: a stick moved"
        return ""

    def _advance(self) -> bool:
        """Go on to the next phase; False: there is none."""
        if not self._axes:
            self._stop("finished")
        elif self.phase is ExcitationPhase.PAUSE:
            self._begin(self._axes.pop(0))
        else:
            self._begin(ExcitationPhase.PAUSE)
        return self.running

    def _begin(self, phase: ExcitationPhase) -> None:
        """Enter a phase with a duration."""
        self._enter(phase)
        seconds = PAUSE_S if phase is ExcitationPhase.PAUSE else self._settings["MIMO_EX_DUR"]
        self._left, self._pulse = max(1, round(seconds / self.Ts)), 0
        if phase is ExcitationPhase.PAUSE:
            return
        # Each axis has its own sequence, which begins with a whole pulse.
        self.turned = 0.0
        seed = 2 * int(self._settings["MIMO_EX_SEED"]) + COLUMNS[phase]
        longer = YAW_HOLD if phase is ExcitationPhase.YAW else 1
        low, high = int(self._settings["MIMO_EX_HMIN"]), int(self._settings["MIMO_EX_HMAX"])
        self._pulses = pulses(longer * low, longer * high, np.random.default_rng(seed))

    def _enter(self, phase: ExcitationPhase) -> None:
        self.phase = phase
        waits = "waits for its mode in the air"
        self.said.append(f"excitation: {waits if phase is ExcitationPhase.WAITING else phase.name.lower()}")

    def _stop(self, why: str) -> None:
        self.phase = ExcitationPhase.OFF
        self.said.append(f"excitation {why}")
