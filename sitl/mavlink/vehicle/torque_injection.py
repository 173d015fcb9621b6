"""The injector on the vehicle: what it sees of the flight, and what ground stations see of it."""

from __future__ import annotations

from mimopilot.sitl.autopilot.excitation_injector import Conditions, Injector, Moment
from mimopilot.sitl.autopilot.flight_modes import Severity
from mimopilot.sitl.autopilot.setpoints import Sticks
from mimopilot.sitl.mavlink.vehicle.vehicle_state import VehicleState
from mimopilot.sitl.mavlink.wire.px4_modes import NAV_STATES

NO_STICKS = Sticks(0.0, 0.0, 0.0, 0.0)


class TorqueInjection:
    """Drives an injector once a period.

    Parameters
    ----------
    injector : Injector
    situation : VehicleState
        The vehicle, with what the autopilot saw last.
    """

    def __init__(self, injector: Injector, situation: VehicleState) -> None:
        self.injector, self.situation = injector, situation

    def __call__(self, now: float) -> Moment:
        """Moment to inject now; `now` is the vehicle's clock, s."""
        vehicle, injector = self.situation.vehicle, self.injector
        estimate = vehicle.estimate
        moment = injector.step(
            Conditions(
                ready=vehicle.armed and not vehicle.lift.landed and not self.situation.row["fault"],
                mode=NAV_STATES[vehicle.mode],
                attitude=(estimate.roll, estimate.pitch),
                sticks=vehicle.sticks.value if vehicle.sticks.fresh(now) else NO_STICKS,
            )
        )
        for text in injector.said:
            vehicle.say(Severity.INFO, text)
        injector.said.clear()
        self.situation.excited = injector.phase.published
        return moment
