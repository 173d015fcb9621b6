"""A scripted pilot: takes off, flies a scenario and lands, the same every time."""

from __future__ import annotations

from enum import Enum

from mimopilot.sitl.autopilot.flight_modes import Commander, Mode, Refused
from mimopilot.sitl.autopilot.setpoints import AttitudeSetpoint
from mimopilot.sitl.errors import SitlError
from mimopilot.sitl.flight.scenario import Scenario

HEIGHT = 3.0  # m; chosen: clear of the ground during a manoeuvre
SETTLE_S = 3.0  # of hover before the scenario; chosen: three time constants of the altitude hold
READY_S = 10.0  # to wait until arming is possible; chosen: far above the time that a vehicle on the ground needs


class PilotPhase(Enum):
    """Phase of the flight."""

    GROUND, CLIMB, SETTLE, SCENARIO, DESCENT, DONE = range(6)


class ScriptedPilot:
    """Flies one scenario, from the ground and back to it.

    Parameters
    ----------
    scenario : Scenario
        Flown at a height of 3 m with altitude hold.

    Attributes
    ----------
    moment : (3,) sequence
        Torque (normalised) to inject in this period.
    done : bool
        The vehicle has landed and is disarmed.
    """

    def __init__(self, scenario: Scenario) -> None:
        self.scenario = scenario
        self.phase = PilotPhase.GROUND
        self.moment = (0.0, 0.0, 0.0)
        self._periods = 0

    @property
    def done(self) -> bool:
        """Whether the flight is over."""
        return self.phase is PilotPhase.DONE

    def update(self, vehicle: Commander) -> None:
        """Command the vehicle for one period.

        Raises
        ------
        SitlError
            When the vehicle refuses a command, or is lost.
        """
        self._periods += 1
        before = self.phase
        try:
            self._step(vehicle, (self._periods - 1) * self.scenario.Ts)
        except Refused as refusal:
            raise SitlError(f"{self.scenario.name}: {refusal}", exit_code=1) from refusal
        if self.phase is not before:
            self._periods = 0

    def _step(self, vehicle: Commander, elapsed: float) -> None:
        if self.phase is PilotPhase.GROUND:
            if vehicle.arming_problems() and elapsed < READY_S:
                return
            vehicle.arm()
            vehicle.take_off(HEIGHT)
            self.phase = PilotPhase.CLIMB
        elif self.phase is PilotPhase.DESCENT:
            self.phase = self.phase if vehicle.armed else PilotPhase.DONE
        elif not vehicle.armed:
            raise SitlError(f"{self.scenario.name}: the vehicle was lost", exit_code=1)
        elif self.phase is PilotPhase.CLIMB:
            self.phase = PilotPhase.SETTLE if vehicle.mode is Mode.HOLD else self.phase
        elif self.phase is PilotPhase.SETTLE:
            self._send_setpoint(vehicle, 0)
            if elapsed >= SETTLE_S:
                vehicle.enter(Mode.OFFBOARD)
                self.phase = PilotPhase.SCENARIO
        elif self._periods <= len(self.scenario.setpoint):
            self._send_setpoint(vehicle, self._periods - 1)
        else:
            self.moment = (0.0, 0.0, 0.0)
            vehicle.enter(Mode.LAND)
            self.phase = PilotPhase.DESCENT

    def _send_setpoint(self, vehicle: Commander, sample: int) -> None:
        roll, pitch, yaw = self.scenario.setpoint[sample].tolist()
        yaw_rate = 0.0 if self.scenario.yaw_rate is None else float(self.scenario.yaw_rate[sample])
        vehicle.attitude.put(AttitudeSetpoint(roll, pitch, yaw, None, yaw_rate), vehicle.now)
        if self.phase is PilotPhase.SCENARIO:
            first, second, third = self.scenario.excitation[sample].tolist()
            self.moment = (first, second, third)
