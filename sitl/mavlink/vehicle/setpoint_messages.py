"""Attitude setpoints, sticks and motion capture poses from MAVLink; implausible ones are refused and reported."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

from pymavlink.dialects.v20 import common as mavlink

from mimopilot.sitl.autopilot.failure_detector import MAX_TILT
from mimopilot.sitl.autopilot.flight_modes import Commander, Severity
from mimopilot.sitl.autopilot.setpoints import AttitudeSetpoint, Pose, Sticks
from mimopilot.sitl.mavlink.wire.codec import SYSTEM
from mimopilot.sitl.physics.state_estimate import euler_angles
from mimopilot.tuning.controller import MAX_RATE

RATES_IGNORED = (
    mavlink.ATTITUDE_TARGET_TYPEMASK_BODY_ROLL_RATE_IGNORE,
    mavlink.ATTITUDE_TARGET_TYPEMASK_BODY_PITCH_RATE_IGNORE,
    mavlink.ATTITUDE_TARGET_TYPEMASK_BODY_YAW_RATE_IGNORE,
)
THRUST_BODY_SET = 32  # ATTITUDE_TARGET_TYPEMASK_THRUST_BODY_SET, which pymavlink's enumeration lacks
DEAD_BAND = 0.05  # of the climb stick's range; chosen
PULSE_MIN, PULSE_MAX = 800, 2200  # us; chosen: plausible RC pulse widths
PULSE_MIDDLE, PULSE_SPAN = 1500, 500  # us, the RC convention: 1000 to 2000
CHANNEL_UNCHANGED = 65535  # RC_CHANNELS_OVERRIDE: leave the channel as it was; 0: release it
MAX_DISTANCE = 1e5  # m; chosen: a pose farther away is implausible
QUATERNION_NORM = 0.9, 1.1  # chosen: norms outside are no quaternion
REFUSAL_INTERVAL_S = 1.0  # s, least interval between reports of a refusal; chosen


class SetpointReceiver:
    """Passes setpoints from messages to a vehicle.

    Parameters
    ----------
    vehicle : Commander

    Attributes
    ----------
    handlers : dict
        Message name -> function that returns the reason of a refusal; empty: accepted.
    """

    def __init__(self, vehicle: Commander) -> None:
        self.vehicle = vehicle
        self._channels: list[int] = [0, 0, 0, 0]
        self._last_pose_us = -1
        self._last_refusal = -math.inf
        self.handlers: dict[str, Callable[[Any], str]] = {
            "SET_ATTITUDE_TARGET": self._attitude_target,
            "MANUAL_CONTROL": self._manual_control,
            "RC_CHANNELS_OVERRIDE": self._channels_override,
            "ATT_POS_MOCAP": self._motion_capture,
            "VISION_POSITION_ESTIMATE": self._vision,
        }

    def receive(self, message: Any) -> list[Any]:
        """Handle one message; a refusal is reported at most once a second."""
        refusal = self.handlers[message.get_type()](message)
        now = max(self.vehicle.now, 0.0)
        if refusal and not 0 <= now - self._last_refusal < REFUSAL_INTERVAL_S:
            self._last_refusal = now
            self.vehicle.say(Severity.WARNING, refusal)
        return []

    def _attitude_target(self, message: Any) -> str:
        mask = message.type_mask
        given = (message.body_roll_rate, message.body_pitch_rate, message.body_yaw_rate)
        rates = [0.0 if mask & bit else rate for bit, rate in zip(RATES_IGNORED, given, strict=True)]
        rate_mode = bool(mask & mavlink.ATTITUDE_TARGET_TYPEMASK_ATTITUDE_IGNORE)
        angles = rates if rate_mode else _angles(message.q)
        if mask & THRUST_BODY_SET:
            return f"setpoint refused: type_mask {mask}: thrust along body axes is not supported"
        if not all(abs(rate) <= MAX_RATE for rate in rates):
            return f"setpoint refused: expected body rates of at most {MAX_RATE:g} rad/s"
        if rate_mode and any(mask & bit for bit in RATES_IGNORED):
            return f"setpoint refused: type_mask {mask}: expected an attitude, or all three body rates"
        if rate_mode and mask & mavlink.ATTITUDE_TARGET_TYPEMASK_THROTTLE_IGNORE:
            return f"setpoint refused: type_mask {mask}: body rates need a thrust"
        if not rate_mode and (rates[0] != 0 or rates[1] != 0):
            return f"setpoint refused: type_mask {mask}: with an attitude only the yaw rate counts, add 3"
        if angles is None or (not rate_mode and max(abs(angles[0]), abs(angles[1])) > MAX_TILT):
            return f"setpoint refused: expected a quaternion, tilted by at most {math.degrees(MAX_TILT):.0f} degrees"
        thrust = None if mask & mavlink.ATTITUDE_TARGET_TYPEMASK_THROTTLE_IGNORE else message.thrust
        if thrust is not None and not 0 <= thrust <= 1:
            return f"setpoint refused: thrust {thrust:g}, expected 0 to 1"
        yaw_rate = 0.0 if rate_mode else rates[2]
        first, second, third = angles
        setpoint = AttitudeSetpoint(first, second, third, thrust, yaw_rate, rate_mode)
        self.vehicle.attitude.put(setpoint, self.vehicle.now)
        return ""

    def _manual_control(self, message: Any) -> str:
        if message.target != SYSTEM:
            return ""
        roll, pitch, yaw = message.y / 1000, -message.x / 1000, message.r / 1000
        climb = message.z / 500 - 1
        if max(map(abs, (roll, pitch, yaw, climb))) > 1:
            return "sticks refused: expected -1000 to 1000, z 0 to 1000"
        self._stick(roll, pitch, yaw, climb)
        return ""

    def _channels_override(self, message: Any) -> str:
        """Channels 1 to 4: roll, pitch, throttle, yaw."""
        channels = [message.chan1_raw, message.chan2_raw, message.chan3_raw, message.chan4_raw]
        held = [old if new == CHANNEL_UNCHANGED else new for old, new in zip(self._channels, channels, strict=True)]
        if any(value and not PULSE_MIN <= value <= PULSE_MAX for value in held):
            return f"channels refused: expected {PULSE_MIN} to {PULSE_MAX} us"
        self._channels = held
        if all(held):
            roll, pitch, climb, yaw = (min(max((value - PULSE_MIDDLE) / PULSE_SPAN, -1.0), 1.0) for value in held)
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
        if not all(abs(value) <= MAX_DISTANCE for value in (*place, yaw)):
            return f"pose refused: expected a quaternion and finite positions within {MAX_DISTANCE:g} m"
        now, pose = self.vehicle.now, self.vehicle.pose
        if stamp <= self._last_pose_us and pose.fresh(now):
            return ""  # older or repeated
        if not pose.fresh(now):
            self.vehicle.say(Severity.INFO, "motion capture: position hold uses it")
        self._last_pose_us = stamp
        pose.put(Pose(*place, math.remainder(yaw, math.tau)), now)
        return ""


def _angles(q: Sequence[float]) -> tuple[float, float, float] | None:
    """Roll, pitch, yaw of a quaternion, rad; None when its norm is not near one."""
    norm = math.sqrt(sum(value * value for value in q))
    if not QUATERNION_NORM[0] <= norm <= QUATERNION_NORM[1]:
        return None
    roll, pitch, yaw = euler_angles(*(value / norm for value in q))
    return float(roll), float(pitch), float(yaw)
