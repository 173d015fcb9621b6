"""A pilot that is a program: takes off, flies a scenario, lands; the same every time."""

from __future__ import annotations

from enum import Enum

from mimopilot.sitl.autopilot.flight_modes import Mode, Refused, Vehicle
from mimopilot.sitl.autopilot.setpoints import Attitude
from mimopilot.sitl.errors import SitlError
from mimopilot.sitl.flight.scenario import Scenario

HEIGHT = 3.0  # m
SETTLE_S = 3.0  # of hovering before the scenario
READY_S = 10.0  # a vehicle that cannot be armed by then will not be


class Phase(Enum):
    """How far it is."""

    GROUND, CLIMB, SETTLE, SCENARIO, DESCENT, DONE = range(6)


class ScriptedPilot:
    """Flies one scenario with a vehicle that stands on the ground.

    Parameters
    ----------
    scenario : Scenario
        What is flown at a height of 3 m, the altitude held.

    Attributes
    ----------
    moment : (3,) sequence
        To inject in this period.
    done : bool
        The vehicle stands again, disarmed.
    """

    def __init__(self, scenario: Scenario) -> None:
        self.scenario = scenario
        self.phase = Phase.GROUND
        self.moment = (0.0, 0.0, 0.0)
        self._periods = 0

    @property
    def done(self) -> bool:
        """Whether the flight is over."""
        return self.phase is Phase.DONE

    def steer(self, vehicle: Vehicle) -> None:
        """One period.

        Raises
        ------
        SitlError
            When the vehicle refuses, or is lost.
        """
        self._periods += 1
        before = self.phase
        try:
            self._act(vehicle, (self._periods - 1) * self.scenario.Ts)
        except Refused as refusal:
            raise SitlError(f"{self.scenario.name}: {refusal}", exit_code=1) from refusal
        if self.phase is not before:
            self._periods = 0

    def _act(self, vehicle: Vehicle, elapsed: float) -> None:
        if self.phase is Phase.GROUND:
            if vehicle.complaints() and elapsed < READY_S:
                return
            vehicle.arm()
            vehicle.take_off(HEIGHT)
            self.phase = Phase.CLIMB
        elif self.phase is Phase.DESCENT:
            self.phase = self.phase if vehicle.armed else Phase.DONE
        elif not vehicle.armed:
            raise SitlError(f"{self.scenario.name}: the vehicle was lost", exit_code=1)
        elif self.phase is Phase.CLIMB:
            self.phase = Phase.SETTLE if vehicle.mode is Mode.HOLD else self.phase
        elif self.phase is Phase.SETTLE:
            self._command(vehicle, 0)
            if elapsed >= SETTLE_S:
                vehicle.enter(Mode.OFFBOARD)
                self.phase = Phase.SCENARIO
        elif self._periods <= len(self.scenario.setpoint):
            self._command(vehicle, self._periods - 1)
        else:
            self.moment = (0.0, 0.0, 0.0)
            vehicle.enter(Mode.LAND)
            self.phase = Phase.DESCENT

    def _command(self, vehicle: Vehicle, sample: int) -> None:
        roll, pitch, yaw = self.scenario.setpoint[sample].tolist()
        vehicle.attitude.put(Attitude(roll, pitch, yaw, None), vehicle.now)
        if self.phase is Phase.SCENARIO:
            first, second, third = self.scenario.excitation[sample].tolist()
            self.moment = (first, second, third)
