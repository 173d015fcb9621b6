"""Messages that steer: attitude set-points, sticks, motion capture. What is not credible is dropped, and said."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

from mimopilot.sitl.autopilot.flight_modes import MAX_TILT, Severity, Vehicle
from mimopilot.sitl.autopilot.setpoints import Attitude, Pose, Sticks
from mimopilot.sitl.physics.state_estimate import euler_angles
from pymavlink.dialects.v20 import common as mavlink

RATES_IGNORED = (
    mavlink.ATTITUDE_TARGET_TYPEMASK_BODY_ROLL_RATE_IGNORE,
    mavlink.ATTITUDE_TARGET_TYPEMASK_BODY_PITCH_RATE_IGNORE,
    mavlink.ATTITUDE_TARGET_TYPEMASK_BODY_YAW_RATE_IGNORE,
)
THRUST_BODY_SET = 32  # pymavlink's enumeration lacks it
NOT_FLOWN = mavlink.ATTITUDE_TARGET_TYPEMASK_ATTITUDE_IGNORE | THRUST_BODY_SET
DEAD_BAND = 0.05  # of the climb stick
PULSE_MIN, PULSE_MAX = 800, 2200  # us, of a credible RC channel
FARTHEST = 1e5  # m


class SetpointReceiver:
    """Feeds a vehicle from messages.

    Parameters
    ----------
    vehicle : Vehicle
    """

    def __init__(self, vehicle: Vehicle) -> None:
        self.vehicle = vehicle
        self._channels: list[int] = [0, 0, 0, 0]
        self._seen = -1
        self._complained = -math.inf
        self.takers: dict[str, Callable[[Any], str]] = {
            "SET_ATTITUDE_TARGET": self._attitude_target,
            "MANUAL_CONTROL": self._manual_control,
            "RC_CHANNELS_OVERRIDE": self._channels_override,
            "ATT_POS_MOCAP": self._motion_capture,
            "VISION_POSITION_ESTIMATE": self._vision,
        }

    def take(self, message: Any) -> list[Any]:
        """One message; a refusal is said at most once a second."""
        refusal = self.takers[message.get_type()](message)
        now = max(self.vehicle.now, 0.0)
        if refusal and not 0 <= now - self._complained < 1:
            self._complained = now
            self.vehicle.say(Severity.WARNING, refusal)
        return []

    def _attitude_target(self, message: Any) -> str:
        mask = message.type_mask
        rates = (message.body_roll_rate, message.body_pitch_rate, message.body_yaw_rate)
        angles = _angles(message.q)
        if mask & NOT_FLOWN:
            return f"set-point refused: type_mask {mask}: only attitude is flown, with or without thrust"
        if any(not mask & bit and rate != 0 for bit, rate in zip(RATES_IGNORED, rates, strict=True)):
            return f"set-point refused: type_mask {mask}: body rates are not flown, add 7"
        if angles is None or max(abs(angles[0]), abs(angles[1])) > MAX_TILT:
            return f"set-point refused: expected a quaternion, tilted by at most {math.degrees(MAX_TILT):.0f} degrees"
        thrust = None if mask & mavlink.ATTITUDE_TARGET_TYPEMASK_THROTTLE_IGNORE else message.thrust
        if thrust is not None and not 0 <= thrust <= 1:
            return f"set-point refused: thrust {thrust:g}, expected 0 to 1"
        self.vehicle.attitude.put(Attitude(*angles, thrust), self.vehicle.now)
        return ""

    def _manual_control(self, message: Any) -> str:
        if message.target != 1:
            return ""
        roll, pitch, yaw = message.y / 1000, -message.x / 1000, message.r / 1000
        climb = message.z / 500 - 1
        if max(map(abs, (roll, pitch, yaw, climb))) > 1:
            return "sticks refused: expected -1000 to 1000, z 0 to 1000"
        self._stick(roll, pitch, yaw, climb)
        return ""

    def _channels_override(self, message: Any) -> str:
        """Channels 1 to 4: roll, pitch, throttle, yaw; 65535 leaves one as it was, 0 lets it go."""
        channels = [message.chan1_raw, message.chan2_raw, message.chan3_raw, message.chan4_raw]
        held = [old if new == 65535 else new for old, new in zip(self._channels, channels, strict=True)]
        if any(value and not PULSE_MIN <= value <= PULSE_MAX for value in held):
            return f"channels refused: expected {PULSE_MIN} to {PULSE_MAX} us"
        self._channels = held
        if all(held):
            roll, pitch, climb, yaw = (min(max((value - 1500) / 500, -1.0), 1.0) for value in held)
            self._stick(roll, pitch, yaw, climb)
        return ""

    def _stick(self, roll: float, pitch: float, yaw: float, climb: float) -> None:
        climb = 0.0 if abs(climb) < DEAD_BAND else climb
        self.vehicle.sticks.put(Sticks(roll, pitch, yaw, climb), self.vehicle.now)

    def _motion_capture(self, message: Any) -> str:
        angles = _angles(message.q)
        return self._pose(message.time_usec, (message.x, message.y, message.z), angles[2] if angles else math.nan)

    def _vision(self, message: Any) -> str:
        return self._pose(message.usec, (message.x, message.y, message.z), message.yaw)

    def _pose(self, stamp: int, place: tuple[float, float, float], yaw: float) -> str:
        if not all(abs(value) <= FARTHEST for value in (*place, yaw)):
            return "pose refused: expected finite numbers and a quaternion"
        now, pose = self.vehicle.now, self.vehicle.pose
        if stamp <= self._seen and pose.fresh(now):
            return ""  # an older one, or a repeated one
        if not pose.fresh(now):
            self.vehicle.say(Severity.INFO, "motion capture: its position is held")
        self._seen = stamp
        pose.put(Pose(*place, math.remainder(yaw, math.tau)), now)
        return ""


def _angles(q: Sequence[float]) -> tuple[float, float, float] | None:
    """Roll, pitch, yaw of a quaternion; None when it is none."""
    length = math.sqrt(sum(value * value for value in q))
    if not 0.9 <= length <= 1.1:
        return None
    roll, pitch, yaw = euler_angles(*(value / length for value in q))
    return float(roll), float(pitch), float(yaw)
