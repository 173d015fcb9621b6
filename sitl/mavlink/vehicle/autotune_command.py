"""The autotune of the bench's stock PX4 over MAVLink: its command, and the signal in each period."""

from __future__ import annotations

from pymavlink.dialects.v20 import common as mavlink

from mimopilot.sitl.autopilot.autotune_module import PROGRESS, State
from mimopilot.sitl.autopilot.excitation_injector import NO_MOMENT, Moment
from mimopilot.sitl.autopilot.stock_autopilot import StockAutopilot
from mimopilot.sitl.mavlink.vehicle.torque_injection import NO_STICKS
from mimopilot.sitl.mavlink.vehicle.vehicle_commands import Command, Progress
from mimopilot.sitl.mavlink.vehicle.vehicle_state import VehicleState
from mimopilot.tuning.px4_names import AUTOTUNE_START

#: State -> MAV_RESULT; all others are in progress.
RESULTS = {State.COMPLETE: mavlink.MAV_RESULT_ACCEPTED, State.FAIL: mavlink.MAV_RESULT_FAILED}


class AutotuneCommand:
    """Starts the autotune and reports its progress.

    Parameters
    ----------
    autopilot : StockAutopilot
    state : VehicleState
    """

    def __init__(self, autopilot: StockAutopilot, state: VehicleState) -> None:
        self.autopilot, self.state = autopilot, state

    def execute(self, command: Command) -> Progress:
        """MAV_CMD_DO_AUTOTUNE_ENABLE as v1.16 answers it: with any parameters, and without the module, too."""
        module = self.autopilot.module
        state = State.IDLE if module is None else module.state
        if state is State.IDLE:
            self.autopilot.set_parameter(AUTOTUNE_START, 1.0)
        return Progress(RESULTS.get(state, mavlink.MAV_RESULT_IN_PROGRESS), PROGRESS[state])

    def __call__(self, now: float) -> Moment:
        """What is added to the rate setpoint (rad/s) in this period; `now` is the vehicle's clock, s."""
        module, vehicle = self.autopilot.module, self.state.vehicle
        if module is None:
            return NO_MOMENT
        sticks = vehicle.sticks.value if vehicle.sticks.fresh(now) else NO_STICKS
        return module.step(now, vehicle.armed, sticks)
