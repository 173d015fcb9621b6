"""MAVLink commands to the vehicle, and their acknowledgements (mavlink.io/en/services/command.html)."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

from pymavlink.dialects.v20 import common as mavlink

from mimopilot.sitl.autopilot.flight_modes import Commander, Denied, Failed, Mode, Refused, Severity
from mimopilot.sitl.mavlink.vehicle.telemetry import Telemetry
from mimopilot.sitl.mavlink.vehicle.telemetry_messages import TELEMETRY_MESSAGES
from mimopilot.sitl.mavlink.wire.px4_modes import mode_of, mode_of_pair

FORCE = 21196  # param2 of MAV_CMD_COMPONENT_ARM_DISARM: override the checks
TAKEOFF_HEIGHT = 2.5  # m, when none is given: PX4's default of MIS_TAKEOFF_ALT
MAX_INTERVAL_US = 2_000_000_000  # us; MESSAGE_INTERVAL's int32 holds little more


class Unsupported(Refused):
    """The vehicle does not know what was requested. The pilot gets no text: ground stations probe routinely."""


RESULTS = {
    Unsupported: mavlink.MAV_RESULT_UNSUPPORTED,
    Refused: mavlink.MAV_RESULT_TEMPORARILY_REJECTED,
    Denied: mavlink.MAV_RESULT_DENIED,
    Failed: mavlink.MAV_RESULT_FAILED,
}


@dataclass(frozen=True)
class Command:
    """COMMAND_LONG or COMMAND_INT.

    Attributes
    ----------
    number : int
        MAV_CMD.
    params : tuple of float
        param1 to param7; NaN: not given.
    absolute : bool
        Whether param7 is an altitude above mean sea level.
    """

    number: int
    params: tuple[float, ...]
    absolute: bool = False

    @classmethod
    def of(cls, message: Any) -> Command:
        """Make it from either message."""
        if message.get_type() == "COMMAND_LONG":
            last: tuple[float, float, float] = (message.param5, message.param6, message.param7)
            absolute = False
        else:
            last = (message.x, message.y, message.z)
            absolute = message.frame in (mavlink.MAV_FRAME_GLOBAL, mavlink.MAV_FRAME_GLOBAL_INT)
        params = (message.param1, message.param2, message.param3, message.param4, *last)
        return cls(message.command, tuple(float(value) for value in params), absolute)

    def whole(self, place: int) -> int:
        """Parameter 1 to 7 as a whole number.

        Raises
        ------
        Denied
            When it is not a whole number.
        """
        value = self.params[place - 1]
        if not (math.isfinite(value) and value == round(value)):
            raise Denied(f"command {self.number}: param{place} is {value:g}, expected a whole number")
        return round(value)


class Progress(NamedTuple):
    """An acknowledgement with its MAV_RESULT and progress, %."""

    result: int
    percent: int


#: A command's handler: returns the messages to send after the acknowledgement, or this; may raise `Refused`.
Handler = Callable[[Command], list[Any] | Progress]


class VehicleCommands:
    """Executes commands.

    Parameters
    ----------
    vehicle : Commander
    telemetry : Telemetry
    reboot : callable
        Resets the vehicle to its start; may raise `Refused`.

    Attributes
    ----------
    handlers : dict
        MAV_CMD -> handler; other modules may add theirs.
    """

    def __init__(self, vehicle: Commander, telemetry: Telemetry, reboot: Callable[[], None]) -> None:
        self.vehicle, self.telemetry, self.reboot = vehicle, telemetry, reboot
        self.handlers: dict[int, Handler] = {
            mavlink.MAV_CMD_COMPONENT_ARM_DISARM: self._arm,
            mavlink.MAV_CMD_NAV_TAKEOFF: self._take_off,
            mavlink.MAV_CMD_NAV_LAND: self._land,
            mavlink.MAV_CMD_DO_SET_MODE: self._set_mode,
            mavlink.MAV_CMD_SET_MESSAGE_INTERVAL: self._set_interval,
            mavlink.MAV_CMD_GET_MESSAGE_INTERVAL: self._get_interval,
            mavlink.MAV_CMD_REQUEST_MESSAGE: self._request_message,
            mavlink.MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES: self._capabilities,
            mavlink.MAV_CMD_GET_HOME_POSITION: self._home,
            mavlink.MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN: self._reboot,
        }

    def execute(self, message: Any) -> list[Any]:
        """Execute a command; return its acknowledgement and the messages that follow it."""
        sender = message.get_srcSystem(), message.get_srcComponent()

        def acknowledge(result: int, percent: int = 0) -> Any:
            return mavlink.MAVLink_command_ack_message(message.command, result, percent, 0, *sender)

        handler = self.handlers.get(message.command)
        if handler is None:
            return [acknowledge(mavlink.MAV_RESULT_UNSUPPORTED)]
        try:
            more = handler(Command.of(message))
        except Refused as refusal:
            if not isinstance(refusal, Unsupported):
                self.vehicle.say(Severity.WARNING, str(refusal))
            return [acknowledge(RESULTS[type(refusal)])]
        return [acknowledge(*more)] if isinstance(more, Progress) else [acknowledge(mavlink.MAV_RESULT_ACCEPTED), *more]

    def set_mode(self, message: Any) -> list[Any]:
        """Execute SET_MODE, the deprecated message; it has no acknowledgement."""
        try:
            self.vehicle.enter(mode_of(message.custom_mode))
        except Refused as refusal:
            self.vehicle.say(Severity.WARNING, str(refusal))
        return []

    def _arm(self, command: Command) -> list[Any]:
        wanted, force = command.whole(1), command.params[1] == FORCE
        if wanted == 1:
            self.vehicle.arm(force)
        elif wanted == 0:
            self.vehicle.disarm(force)
        else:
            raise Denied(f"arm: param1 is {wanted}, expected 0 or 1")
        return []

    def _take_off(self, command: Command) -> list[Any]:
        height = command.params[6]
        if command.absolute:
            height -= self.vehicle.vertical.ground
        self.vehicle.take_off(TAKEOFF_HEIGHT if math.isnan(height) else height)
        return []

    def _land(self, command: Command) -> list[Any]:
        self.vehicle.enter(Mode.LAND)
        return []

    def _set_mode(self, command: Command) -> list[Any]:
        if not command.whole(1) & mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED:
            raise Denied("set modes by number: base_mode 1 and a custom_mode")
        main = command.whole(2)
        whole = main > 0xFF  # the whole custom_mode in param2, as MAVProxy sends it
        self.vehicle.enter(mode_of(main) if whole else mode_of_pair(main, command.whole(3)))
        return []

    def _message_number(self, command: Command) -> int:
        number = command.whole(1)
        if number not in TELEMETRY_MESSAGES:
            raise Unsupported(f"message {number} is not supported")
        return number

    def _set_interval(self, command: Command) -> list[Any]:
        number, interval = self._message_number(command), command.params[1]
        if interval == 0:
            self.telemetry.set_rate(number, TELEMETRY_MESSAGES[number].rate)
        elif interval == -1:
            self.telemetry.set_rate(number, 0.0)
        elif 0 < interval <= MAX_INTERVAL_US:
            self.telemetry.set_rate(number, 1e6 / interval)
        else:
            raise Denied(
                f"message interval {interval:g} us: expected -1 (never), 0 (default) or up to {MAX_INTERVAL_US}"
            )
        return []

    def _get_interval(self, command: Command) -> list[Any]:
        number = command.whole(1)
        rate = self.telemetry.rates.get(number)
        interval = 0 if rate is None else -1 if rate == 0 else round(1e6 / rate)
        return [mavlink.MAVLink_message_interval_message(number % 65536, interval)]

    def _request_message(self, command: Command) -> list[Any]:
        number = self._message_number(command)
        message = self.telemetry.build(number)
        if message is None:
            raise Refused(f"message {number}: no data yet; wait for the plant")
        return [message]

    def _capabilities(self, command: Command) -> list[Any]:
        return [self.telemetry.build(mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION)]

    def _home(self, command: Command) -> list[Any]:
        message = self.telemetry.build(mavlink.MAVLINK_MSG_ID_HOME_POSITION)
        if message is None:
            raise Refused("no home position: the plant has sent none yet")
        return [message]

    def _reboot(self, command: Command) -> list[Any]:
        if command.whole(1) not in (1, 3):
            raise Denied("reboot: param1 must be 1")
        if self.vehicle.armed:
            raise Refused("no reboot: armed; disarm first")
        self.reboot()
        return []
