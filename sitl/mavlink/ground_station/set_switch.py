"""The switch of a vehicle that takes a set of gains as a whole: see `tuning.crazyflie_names`."""

from __future__ import annotations

from dataclasses import dataclass

from mimopilot.sitl.mavlink.ground_station.events import CRAZYFLIE, Exchange
from mimopilot.sitl.mavlink.ground_station.parameter_protocol import ParameterClient
from mimopilot.sitl.mavlink.ground_station.vehicle_link_state import TRY_S
from mimopilot.tuning.crazyflie_names import ControllerState
from mimopilot.tuning.parameter_row import PREFIX
from mimopilot.tuning.parameters import ENABLE

#: s in which a vehicle takes a set, chosen: 500 control periods.
TAKE_S = 1.0
#: State -> why a set does not fly.
REFUSALS: dict[int, str] = {
    ControllerState.STOCK: "the stock controller flies",
    ControllerState.CHANGED: "the set that it took before flies",
    ControllerState.REFUSED: "it refused the set, and the one that it took before flies",
    ControllerState.WAITING: "it is flying: the set counts on the ground",
    ControllerState.WRONG_PERIOD: "the set is for another rate, it gives no torque",
    ControllerState.OTHER_FIRMWARE: "the set is not for this firmware, the stock controller flies",
}


@dataclass(frozen=True)
class SetSwitch:
    """Names of the parameters of a vehicle that takes a set as a whole, when a switch goes from 0 to 1 on the ground.

    Attributes
    ----------
    enable : str
        The switch.
    state : str
        What the vehicle does with the set: a `ControllerState`.
    """

    enable: str
    state: str


#: MAV_AUTOPILOT -> its switch.
SWITCHES = {CRAZYFLIE: SetSwitch(ENABLE.name, f"{PREFIX}STATE")}


def state_after(client: ParameterClient, switch: SetSwitch, value: float, old: bool = False) -> Exchange[str]:
    """Wait until a vehicle has taken its set; returns why it has not, empty: it has, or the switch is off (0).

    `old`: the set that it held before, which may be one of another firmware.
    """
    if value == 0:
        return ""
    deadline = client.now + TAKE_S
    while True:
        answer = (yield from client.read([switch.state], "verifying", keep_going=True))[switch.state]
        client.forget(switch.state)
        if answer.value is None:
            return f"{switch.state}: {answer.problem}"
        if answer.value == ControllerState.FLIES or (old and answer.value == ControllerState.OTHER_FIRMWARE):
            return ""
        if client.now >= deadline:
            return f"{switch.state} is {answer.value:g}: {REFUSALS.get(int(answer.value), 'not known')}"
        yield from client.send_and_wait([], client.now + TRY_S / 5)
