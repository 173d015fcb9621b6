"""Excitation on the vehicle: steps the injector with the flight conditions, and publishes its phase and texts."""

from __future__ import annotations

from mimopilot.sitl.autopilot.excitation_injector import Conditions, Injector, Moment
from mimopilot.sitl.autopilot.flight_modes import Severity
from mimopilot.sitl.autopilot.setpoints import Sticks
from mimopilot.sitl.mavlink.vehicle.vehicle_state import VehicleState
from mimopilot.sitl.mavlink.wire.px4_modes import NAV_STATES

NO_STICKS = Sticks(0.0, 0.0, 0.0, 0.0)


class TorqueInjection:
    """Steps an injector once a period.

    Parameters
    ----------
    injector : Injector
    state : VehicleState
        The vehicle, with the autopilot's last record.
    """

    def __init__(self, injector: Injector, state: VehicleState) -> None:
        self.injector, self.state = injector, state

    def __call__(self, now: float) -> Moment:
        """Step the injector: torque (normalised) to inject now; `now` is the vehicle's clock, s."""
        vehicle, injector = self.state.vehicle, self.injector
        estimate = vehicle.estimate
        moment = injector.step(
            Conditions(
                ready=vehicle.armed and not vehicle.vertical.landed and not self.state.record["fault"],
                mode=NAV_STATES[vehicle.mode],
                attitude=(estimate.roll, estimate.pitch),
                sticks=vehicle.sticks.value if vehicle.sticks.fresh(now) else NO_STICKS,
                yaw_rate=float(self.state.record["rates"][2]),
            )
        )
        for text in injector.said:
            vehicle.say(Severity.INFO, text)
        injector.said.clear()
        self.state.excitation_phase, self.state.excitation_turn = injector.phase.published, injector.turned
        return moment
