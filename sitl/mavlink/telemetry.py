"""What the vehicle shows ground stations: messages made from its situation, each at its rate."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from pymavlink.dialects.v20 import common as mavlink

from sitl.autopilot import RECORD
from sitl.mavlink.flight_modes import custom_mode
from sitl.mavlink.plant_link import PlantState
from sitl.modes import Mode, Severity, Vehicle
from sitl.plant import GRAVITY
from sitl.recorder import quaternions
from sitl.setpoints import turned

MAX_RATE = 250.0  # Hz, of one message
TEXT = 50  # characters of one STATUSTEXT
UNKNOWN_16 = 65535
CAPABILITIES = (
    mavlink.MAV_PROTOCOL_CAPABILITY_MAVLINK2
    | mavlink.MAV_PROTOCOL_CAPABILITY_SET_ATTITUDE_TARGET
    | mavlink.MAV_PROTOCOL_CAPABILITY_PARAM_ENCODE_BYTEWISE
    | mavlink.MAV_PROTOCOL_CAPABILITY_COMMAND_INT
)
SENSORS = (
    mavlink.MAV_SYS_STATUS_SENSOR_3D_GYRO
    | mavlink.MAV_SYS_STATUS_SENSOR_3D_ACCEL
    | mavlink.MAV_SYS_STATUS_SENSOR_3D_MAG
    | mavlink.MAV_SYS_STATUS_SENSOR_ABSOLUTE_PRESSURE
    | mavlink.MAV_SYS_STATUS_SENSOR_GPS
    | mavlink.MAV_SYS_STATUS_SENSOR_ANGULAR_RATE_CONTROL
    | mavlink.MAV_SYS_STATUS_SENSOR_ATTITUDE_STABILIZATION
    | mavlink.MAV_SYS_STATUS_SENSOR_Z_ALTITUDE_CONTROL
    | mavlink.MAV_SYS_STATUS_SENSOR_MOTOR_OUTPUTS
    | mavlink.MAV_SYS_STATUS_GEOFENCE
)
MODE_FLAGS = {
    Mode.HOLD: mavlink.MAV_MODE_FLAG_GUIDED_ENABLED,
    Mode.OFFBOARD: mavlink.MAV_MODE_FLAG_GUIDED_ENABLED,
    Mode.TAKEOFF: mavlink.MAV_MODE_FLAG_AUTO_ENABLED,
    Mode.LAND: mavlink.MAV_MODE_FLAG_AUTO_ENABLED,
    Mode.ALTITUDE: mavlink.MAV_MODE_FLAG_MANUAL_INPUT_ENABLED,
}


@dataclass
class Situation:
    """All that telemetry is made from.

    Attributes
    ----------
    vehicle : Vehicle
    stamp : int, us
        The plant's clock at the last period.
    row : one of `sitl.autopilot.RECORD`
        What the autopilot saw and did then.
    state : PlantState
    imu, fix : tuple
        Fields of the plant's last HIL_SENSOR and HIL_GPS, in wire order, see `sitl.mavlink.lean`; empty until then.
    home : (latitude, longitude, altitude), 1e-7 deg, mm
        Where the vehicle was first seen; empty until then.
    load : float
        Share of the period that is worked.
    """

    vehicle: Vehicle
    stamp: int = -1
    row: Any = field(default_factory=lambda: np.zeros(1, RECORD)[0])
    state: PlantState = PlantState(*[0] * 19)
    imu: tuple[Any, ...] = ()
    fix: tuple[Any, ...] = ()
    home: tuple[int, ...] = ()
    load: float = 0.0

    @property
    def milliseconds(self) -> int:
        """Time since boot as messages carry it."""
        return max(self.stamp, 0) // 1000 % 2**32

    def local(self) -> tuple[float, ...]:
        """Position (m) and velocity (m/s), down positive: where motion capture sees it, else from home."""
        estimate, vehicle = self.vehicle.estimate, self.vehicle
        if vehicle.pose.fresh(vehicle.now):
            pose = vehicle.pose.value
            vx, vy = turned(estimate.north, estimate.east, estimate.yaw - pose.yaw)
            return pose.x, pose.y, pose.z, vx, vy, -estimate.climb
        latitude, longitude, altitude = self.home
        metres = 1e-7 * 111_319.5
        east = metres * math.cos(math.radians(latitude * 1e-7))
        return (
            (self.state.lat - latitude) * metres,
            (self.state.lon - longitude) * east,
            (altitude - self.state.alt) / 1000,
            estimate.north,
            estimate.east,
            -estimate.climb,
        )


def heartbeat(s: Situation) -> Any:
    """HEARTBEAT."""
    vehicle = s.vehicle
    base = mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED | mavlink.MAV_MODE_FLAG_STABILIZE_ENABLED
    base |= MODE_FLAGS[vehicle.mode] | (mavlink.MAV_MODE_FLAG_SAFETY_ARMED if vehicle.armed else 0)
    status = mavlink.MAV_STATE_ACTIVE if vehicle.armed else mavlink.MAV_STATE_STANDBY
    if "plant" in vehicle.obstacles:
        status = mavlink.MAV_STATE_BOOT
    elif vehicle.armed and vehicle.in_trouble:
        status = mavlink.MAV_STATE_CRITICAL
    return mavlink.MAVLink_heartbeat_message(
        mavlink.MAV_TYPE_QUADROTOR, mavlink.MAV_AUTOPILOT_GENERIC, base, custom_mode(vehicle.mode), status, 3
    )


def _sys_status(s: Situation) -> Any:
    vehicle = s.vehicle
    present = SENSORS | mavlink.MAV_SYS_STATUS_PREARM_CHECK
    if vehicle.pose.fresh(vehicle.now):
        present |= mavlink.MAV_SYS_STATUS_SENSOR_VISION_POSITION | mavlink.MAV_SYS_STATUS_SENSOR_XY_POSITION_CONTROL
    healthy = present if not vehicle.complaints() else present & ~mavlink.MAV_SYS_STATUS_PREARM_CHECK
    if "plant" in vehicle.obstacles:
        healthy = 0
    return mavlink.MAVLink_sys_status_message(
        present, present, healthy, round(1000 * min(s.load, 1)), UNKNOWN_16, -1, -1, 0, 0, 0, 0, 0, 0
    )


def _attitude(s: Situation) -> Any:
    return mavlink.MAVLink_attitude_message(s.milliseconds, *_floats(s.row["attitude"]), *_floats(s.row["rates"]))


def _attitude_quaternion(s: Situation) -> Any:
    return mavlink.MAVLink_attitude_quaternion_message(
        s.milliseconds, *_floats(s.row["quaternion"]), *_floats(s.row["rates"])
    )


def _attitude_target(s: Situation) -> Any:
    wanted = _floats(quaternions(s.row["setpoint"][None])[0])
    return mavlink.MAVLink_attitude_target_message(
        s.milliseconds, 0, wanted, *_floats(s.row["rates_setpoint"]), float(s.row["collective"])
    )


def _local_position(s: Situation) -> Any:
    return mavlink.MAVLink_local_position_ned_message(s.milliseconds, *s.local())


def _global_position(s: Situation) -> Any:
    above = s.state.alt - s.home[2]
    return mavlink.MAVLink_global_position_int_message(
        s.milliseconds, s.state.lat, s.state.lon, s.state.alt, above, s.state.vx, s.state.vy, s.state.vz, _heading(s)
    )


def _gps_raw(s: Situation) -> Any:
    stamp, latitude, longitude, altitude, eph, epv, speed, _, _, _, course, kind, satellites, *_ = s.fix
    return mavlink.MAVLink_gps_raw_int_message(
        stamp, kind, latitude, longitude, altitude, eph, epv, speed, course, satellites
    )


def _vfr_hud(s: Situation) -> Any:
    e = s.vehicle.estimate
    speed = math.hypot(e.north, e.east)
    return mavlink.MAVLink_vfr_hud_message(
        speed, speed, _heading(s) // 100, round(100 * float(s.row["collective"])), e.altitude, e.climb
    )


def _altitude(s: Situation) -> Any:
    altitude, ground = s.vehicle.estimate.altitude, s.vehicle.lift.ground
    home = s.home[2] / 1000
    return mavlink.MAVLink_altitude_message(
        s.stamp, altitude, altitude, altitude - home, altitude - home, altitude - ground, altitude - ground
    )


def _highres_imu(s: Situation) -> Any:
    return mavlink.MAVLink_highres_imu_message(*s.imu[:14], s.imu[14] & 0xFFFF)


def _scaled_imu(s: Situation) -> Any:
    imu = s.imu
    acceleration = (_int16(value / GRAVITY * 1000) for value in imu[1:4])
    rates_and_field = (_int16(value * 1000) for value in imu[4:10])
    return mavlink.MAVLink_scaled_imu_message(s.milliseconds, *acceleration, *rates_and_field, _int16(imu[13] * 100))


def _servo_output(s: Situation) -> Any:
    pulses = [round(1000 + 1000 * value) for value in _floats(s.row["commands"])]
    return mavlink.MAVLink_servo_output_raw_message(max(s.stamp, 0) % 2**32, 0, *pulses[:8])


def _extended_state(s: Situation) -> Any:
    vehicle = s.vehicle
    state = mavlink.MAV_LANDED_STATE_ON_GROUND if vehicle.lift.landed else mavlink.MAV_LANDED_STATE_IN_AIR
    if vehicle.armed and vehicle.mode is Mode.TAKEOFF:
        state = mavlink.MAV_LANDED_STATE_TAKEOFF
    elif vehicle.armed and vehicle.mode is Mode.LAND:
        state = mavlink.MAV_LANDED_STATE_LANDING
    return mavlink.MAVLink_extended_sys_state_message(mavlink.MAV_VTOL_STATE_UNDEFINED, state)


def _battery(s: Situation) -> Any:
    """Nothing is known of it: the simulator's link carries no battery."""
    return mavlink.MAVLink_battery_status_message(0, 0, 0, 32767, [UNKNOWN_16] * 10, -1, -1, -1, -1)


def _home_position(s: Situation) -> Any:
    return mavlink.MAVLink_home_position_message(*s.home, 0, 0, 0, [1, 0, 0, 0], 0, 0, 0)


def _autopilot_version(s: Situation) -> Any:
    return mavlink.MAVLink_autopilot_version_message(CAPABILITIES, 0, 0, 0, 0, bytes(8), bytes(8), bytes(8), 0, 0, 0)


Builder = Callable[[Situation], Any]


@dataclass(frozen=True)
class Topic:
    """A message: how it is made, how often by default (Hz), its data stream, and what must be known for it."""

    build: Builder
    rate: float
    stream: int
    needs: str = "home"


_STATUS, _POSITION = mavlink.MAV_DATA_STREAM_EXTENDED_STATUS, mavlink.MAV_DATA_STREAM_POSITION
_RAW, _CONTROLLER = mavlink.MAV_DATA_STREAM_RAW_SENSORS, mavlink.MAV_DATA_STREAM_RC_CHANNELS
_ATTITUDE, _HUD = mavlink.MAV_DATA_STREAM_EXTRA1, mavlink.MAV_DATA_STREAM_EXTRA2
_OWN = -1  # of no stream

#: Message number -> topic.
TOPICS = {
    mavlink.MAVLINK_MSG_ID_HEARTBEAT: Topic(heartbeat, 1.0, _OWN, ""),
    mavlink.MAVLINK_MSG_ID_SYS_STATUS: Topic(_sys_status, 1.0, _STATUS, ""),
    mavlink.MAVLINK_MSG_ID_EXTENDED_SYS_STATE: Topic(_extended_state, 2.0, _STATUS),
    mavlink.MAVLINK_MSG_ID_BATTERY_STATUS: Topic(_battery, 0.5, _STATUS, ""),
    mavlink.MAVLINK_MSG_ID_HOME_POSITION: Topic(_home_position, 0.5, _OWN),
    mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION: Topic(_autopilot_version, 0.0, _OWN, ""),
    mavlink.MAVLINK_MSG_ID_ATTITUDE: Topic(_attitude, 20.0, _ATTITUDE),
    mavlink.MAVLINK_MSG_ID_ATTITUDE_QUATERNION: Topic(_attitude_quaternion, 20.0, _ATTITUDE),
    mavlink.MAVLINK_MSG_ID_ATTITUDE_TARGET: Topic(_attitude_target, 5.0, _ATTITUDE),
    mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED: Topic(_local_position, 10.0, _POSITION),
    mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT: Topic(_global_position, 5.0, _POSITION),
    mavlink.MAVLINK_MSG_ID_GPS_RAW_INT: Topic(_gps_raw, 2.0, _STATUS, "fix"),
    mavlink.MAVLINK_MSG_ID_VFR_HUD: Topic(_vfr_hud, 5.0, _HUD),
    mavlink.MAVLINK_MSG_ID_ALTITUDE: Topic(_altitude, 5.0, _HUD),
    mavlink.MAVLINK_MSG_ID_HIGHRES_IMU: Topic(_highres_imu, 5.0, _RAW, "imu"),
    mavlink.MAVLINK_MSG_ID_SCALED_IMU: Topic(_scaled_imu, 0.0, _RAW, "imu"),
    mavlink.MAVLINK_MSG_ID_SERVO_OUTPUT_RAW: Topic(_servo_output, 5.0, _CONTROLLER),
}


class Telemetry:
    """When each message is due.

    Parameters
    ----------
    situation : Situation
        What they are made from.
    """

    def __init__(self, situation: Situation) -> None:
        self.situation = situation
        self.rates = {number: topic.rate for number, topic in TOPICS.items()}
        self.due = {number: 0.0 for number, rate in self.rates.items() if rate > 0}
        self.next = 0.0

    def set_rate(self, number: int, rate: float) -> None:
        """Send a message so often, Hz; 0: never. More than `MAX_RATE` is that."""
        self.rates[number] = min(rate, MAX_RATE)
        self.due.pop(number, None)
        if rate > 0:
            self.due[number] = self.next = 0.0

    def set_stream(self, stream: int, rate: float) -> None:
        """The same for all messages of a data stream; stream 0 is all of them."""
        for number, topic in TOPICS.items():
            if topic.stream != _OWN and stream in (mavlink.MAV_DATA_STREAM_ALL, topic.stream):
                self.set_rate(number, rate if TOPICS[number].rate > 0 else 0.0)

    def build(self, number: int) -> Any:
        """One message now; None when what it tells is not known."""
        topic = TOPICS[number]
        if topic.needs and not getattr(self.situation, topic.needs):
            return None
        return topic.build(self.situation)

    def messages(self, now: float) -> list[Any]:
        """What is due at a monotonic time, s."""
        if now < self.next:
            return []
        made = []
        for number, due in self.due.items():
            if now >= due:
                period = 1 / self.rates[number]
                self.due[number] = due + period if now < due + period else now + period
                made.append(self.build(number))
        self.next = min(self.due.values(), default=math.inf)
        return [message for message in made if message is not None]


def texts(severity: Severity, text: str, number: int) -> list[Any]:
    """STATUSTEXT, in pieces when it is long; `number` tells one long text from another, 1 to 65535."""
    data = text.encode("ascii", "replace")
    pieces = [data[i : i + TEXT] for i in range(0, len(data), TEXT)] or [b""]
    mark = number if len(pieces) > 1 else 0
    return [mavlink.MAVLink_statustext_message(severity.value, piece, mark, i) for i, piece in enumerate(pieces)]


def _floats(values: Any) -> list[float]:
    return [float(value) for value in values]


def _heading(s: Situation) -> int:
    return round(math.degrees(s.vehicle.estimate.yaw) * 100) % 36000


def _int16(value: float) -> int:
    return max(-32768, min(32767, round(value))) if math.isfinite(value) else 0
