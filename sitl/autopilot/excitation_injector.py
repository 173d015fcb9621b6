"""The excitation experiment of a vehicle that a ground station flies: a PRBS moment, asked for by one parameter.

The rules are those of the firmware's own injector (`excitation.hpp` of the PX4 module), so that one client serves both.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from enum import Enum
from typing import NamedTuple

import numpy as np
from mimopilot.tuning.excitation import pulses

#: The parameter that starts and stops it.
AXIS = "MIMO_EX_AX"
PAUSE_S = 1.0  # between roll and pitch
STICK_MOVE = 0.1

Moment = tuple[float, float, float]
NOTHING: Moment = (0.0, 0.0, 0.0)


class Phase(Enum):
    """What the injector does; the numbers are those that logs and DEBUG_VECT carry."""

    OFF = -1
    ROLL = 0
    PITCH = 1
    PAUSE = 2
    WAITING = 3

    @property
    def published(self) -> int:
        """As logs and DEBUG_VECT carry it: waiting is off."""
        return Phase.OFF.value if self is Phase.WAITING else self.value


class Conditions(NamedTuple):
    """What is known of the vehicle in one period.

    Attributes
    ----------
    ready : bool
        Armed, in the air, measurements sound.
    mode : int
        PX4's number of the flight mode (nav_state).
    attitude : (roll, pitch), rad
    sticks : tuple of 4 float
        Deflections -1..1, zeros without a pilot.
    """

    ready: bool
    mode: int
    attitude: tuple[float, float]
    sticks: tuple[float, float, float, float]


class Injector:
    """Adds a PRBS on roll, on pitch, or on one after the other.

    Setting `AXIS` from 0 to 1, 2 or 3 asks for one run. It begins when the vehicle is ready and in its mode, and ends
    by itself, or when the vehicle is no longer ready, leaves the mode or tilts too far, or a stick moves; another run
    needs 0 first.

    Parameters
    ----------
    Ts : float, s
        Control period.

    Attributes
    ----------
    phase : Phase
    said : list of str
        For the pilot; whoever owns the injector empties it.
    """

    def __init__(self, Ts: float) -> None:
        self.Ts = Ts
        self.phase = Phase.OFF
        self.said: list[str] = []
        self._held: Mapping[str, float] | None = None
        self._settings: Mapping[str, float] = {}
        self._pulses: Iterator[tuple[float, int]] = iter(())
        self._sign = 0.0
        self._pulse = self._left = 0  # samples of the pulse, and of the phase
        self._sticks = (0.0, 0.0, 0.0, 0.0)

    @property
    def running(self) -> bool:
        """Whether it has begun and not ended."""
        return self.phase in (Phase.ROLL, Phase.PITCH, Phase.PAUSE)

    def configure(self, settings: Mapping[str, float]) -> None:
        """Take over the settings, name -> value of `tuning.parameters.EXCITATION`; the first ones start nothing."""
        asked = self._held is not None and self._held[AXIS] == 0 and settings[AXIS] != 0
        self._held = settings
        if settings[AXIS] == 0:
            if self.phase is not Phase.OFF:
                self._stop("cancelled")
        elif asked and settings["MIMO_EX_HMIN"] <= settings["MIMO_EX_HMAX"]:
            # The run keeps what was set now.
            self._settings = settings
            self._enter(Phase.WAITING)
        elif asked:
            self._stop("refused: MIMO_EX_HMIN is above MIMO_EX_HMAX")

    def step(self, conditions: Conditions) -> Moment:
        """One control period: the moment to add on roll, pitch and yaw."""
        if self.phase is Phase.OFF:
            return NOTHING
        if self.phase is Phase.WAITING:
            self._sticks = conditions.sticks
            if self._fault(conditions):
                return NOTHING
            self._begin(Phase.PITCH if self._settings[AXIS] == 2 else Phase.ROLL)
        fault = self._fault(conditions)
        if fault:
            self._stop(fault)
            return NOTHING
        if self._left == 0 and not self._advance():
            return NOTHING
        self._left -= 1
        if self.phase is Phase.PAUSE:
            return NOTHING
        if self._pulse == 0:
            self._sign, self._pulse = next(self._pulses)
        self._pulse -= 1
        moment = self._sign * self._settings["MIMO_EX_AMP"]
        return (moment, 0.0, 0.0) if self.phase is Phase.ROLL else (0.0, moment, 0.0)

    def _fault(self, conditions: Conditions) -> str:
        """Why nothing may be injected now; empty: it may."""
        if not conditions.ready or conditions.mode != self._settings["MIMO_EX_MODE"]:
            return "stopped: mode left, on the ground or disarmed"
        if not max(map(abs, conditions.attitude)) <= self._settings["MIMO_EX_TILT"]:
            return "stopped: tilt beyond MIMO_EX_TILT"
        if any(abs(new - old) > STICK_MOVE for new, old in zip(conditions.sticks, self._sticks, strict=True)):
            return "stopped: a stick moved"
        return ""

    def _advance(self) -> bool:
        """The phase is over; False: it was the last."""
        if self.phase is Phase.ROLL and self._settings[AXIS] == 3:
            self._begin(Phase.PAUSE)
        elif self.phase is Phase.PAUSE:
            self._begin(Phase.PITCH)
        else:
            self._stop("finished")
        return self.running

    def _begin(self, phase: Phase) -> None:
        self._enter(phase)
        seconds = PAUSE_S if phase is Phase.PAUSE else self._settings["MIMO_EX_DUR"]
        self._left, self._pulse = max(1, round(seconds / self.Ts)), 0
        if phase is Phase.PAUSE:
            return
        # Each axis has a sequence of its own, that begins with a whole pulse.
        seed = 2 * int(self._settings["MIMO_EX_SEED"]) + (phase is Phase.PITCH)
        low, high = int(self._settings["MIMO_EX_HMIN"]), int(self._settings["MIMO_EX_HMAX"])
        self._pulses = pulses(low, high, np.random.default_rng(seed))

    def _enter(self, phase: Phase) -> None:
        self.phase = phase
        waits = "waits for its mode in the air"
        self.said.append(f"excitation: {waits if phase is Phase.WAITING else phase.name.lower()}")

    def _stop(self, why: str) -> None:
        self.phase = Phase.OFF
        self.said.append(f"excitation {why}")
