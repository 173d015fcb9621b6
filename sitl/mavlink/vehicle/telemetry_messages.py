"""The telemetry messages, each built from the vehicle's state."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from pymavlink.dialects.v20 import common as mavlink

from mimopilot.sitl.autopilot.excitation_injector import ExcitationPhase
from mimopilot.sitl.autopilot.flight_modes import Mode
from mimopilot.sitl.flight.flight_log import EXCITATION_NAME, YAW_EXCITATION_NAME, setpoint_quaternions
from mimopilot.sitl.mavlink.vehicle.vehicle_state import VehicleState
from mimopilot.sitl.mavlink.wire.codec import MAVLINK_VERSION
from mimopilot.sitl.mavlink.wire.px4_modes import custom_mode
from mimopilot.sitl.physics.rigid_body import GRAVITY

UNKNOWN_16 = 65535  # "unknown" in a uint16 field, MAVLink common.xml
CAPABILITIES = (
    mavlink.MAV_PROTOCOL_CAPABILITY_MAVLINK2
    | mavlink.MAV_PROTOCOL_CAPABILITY_SET_ATTITUDE_TARGET
    | mavlink.MAV_PROTOCOL_CAPABILITY_PARAM_ENCODE_BYTEWISE
    | mavlink.MAV_PROTOCOL_CAPABILITY_COMMAND_INT
    | mavlink.MAV_PROTOCOL_CAPABILITY_FTP
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


def heartbeat(s: VehicleState) -> Any:
    """HEARTBEAT; it says that the vehicle is simulated."""
    vehicle = s.vehicle
    base = mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED | mavlink.MAV_MODE_FLAG_STABILIZE_ENABLED
    base |= mavlink.MAV_MODE_FLAG_HIL_ENABLED
    base |= MODE_FLAGS[vehicle.mode] | (mavlink.MAV_MODE_FLAG_SAFETY_ARMED if vehicle.armed else 0)
    status = mavlink.MAV_STATE_ACTIVE if vehicle.armed else mavlink.MAV_STATE_STANDBY
    if "plant" in vehicle.arming_blockers:
        status = mavlink.MAV_STATE_BOOT
    elif vehicle.armed and vehicle.in_failsafe:
        status = mavlink.MAV_STATE_CRITICAL
    kind, mode = (mavlink.MAV_TYPE_QUADROTOR, s.autopilot), custom_mode(vehicle.mode)
    return mavlink.MAVLink_heartbeat_message(*kind, base, mode, status, MAVLINK_VERSION)


def _sys_status(s: VehicleState) -> Any:
    vehicle = s.vehicle
    present = SENSORS | mavlink.MAV_SYS_STATUS_PREARM_CHECK
    if vehicle.pose.fresh(vehicle.now):
        present |= mavlink.MAV_SYS_STATUS_SENSOR_VISION_POSITION | mavlink.MAV_SYS_STATUS_SENSOR_XY_POSITION_CONTROL
    healthy = present if not vehicle.arming_problems() else present & ~mavlink.MAV_SYS_STATUS_PREARM_CHECK
    if "plant" in vehicle.arming_blockers:
        healthy = mavlink.MAV_SYS_STATUS_GEOFENCE  # without this bit ground stations report a fence breach
    return mavlink.MAVLink_sys_status_message(
        present, present, healthy, round(1000 * min(s.load, 1)), UNKNOWN_16, -1, -1, 0, 0, 0, 0, 0, 0
    )


def _attitude(s: VehicleState) -> Any:
    return mavlink.MAVLink_attitude_message(s.milliseconds, *_floats(s.record["attitude"]), *_floats(s.record["rates"]))


def _attitude_quaternion(s: VehicleState) -> Any:
    return mavlink.MAVLink_attitude_quaternion_message(
        s.milliseconds, *_floats(s.record["quaternion"]), *_floats(s.record["rates"])
    )


def _attitude_target(s: VehicleState) -> Any:
    wanted = _floats(setpoint_quaternions(s.record[None])[0])
    return mavlink.MAVLink_attitude_target_message(
        s.milliseconds, 0, wanted, *_floats(s.record["rates_setpoint"]), float(s.record["collective"])
    )


def _local_position(s: VehicleState) -> Any:
    return mavlink.MAVLink_local_position_ned_message(s.milliseconds, *s.local())


def _global_position(s: VehicleState) -> Any:
    plant = s.plant
    place = (plant.lat, plant.lon, plant.alt, plant.alt - s.home[2])
    return mavlink.MAVLink_global_position_int_message(
        s.milliseconds, *place, plant.vx, plant.vy, plant.vz, _heading(s, UNKNOWN_16)
    )


def _gps_raw(s: VehicleState) -> Any:
    stamp, latitude, longitude, altitude, eph, epv, speed, _, _, _, course, kind, satellites, *_ = s.fix
    return mavlink.MAVLink_gps_raw_int_message(
        stamp, kind, latitude, longitude, altitude, eph, epv, speed, course, satellites
    )


def _vfr_hud(s: VehicleState) -> Any:
    e = s.vehicle.estimate
    speed = math.hypot(e.north, e.east)
    return mavlink.MAVLink_vfr_hud_message(
        speed, speed, _heading(s, 0) // 100, _int16(100 * float(s.record["collective"])), e.altitude, e.climb
    )


def _altitude(s: VehicleState) -> Any:
    altitude, ground = s.vehicle.estimate.altitude, s.vehicle.vertical.ground
    home = s.home[2] / 1000
    return mavlink.MAVLink_altitude_message(
        s.stamp, altitude, altitude, altitude - home, altitude - home, altitude - ground, altitude - ground
    )


def _highres_imu(s: VehicleState) -> Any:
    return mavlink.MAVLink_highres_imu_message(*s.imu[:14], s.imu[14] & 0xFFFF)


def _scaled_imu(s: VehicleState) -> Any:
    imu = s.imu
    acceleration = (_int16(value / GRAVITY * 1000) for value in imu[1:4])
    rates_and_field = (_int16(value * 1000) for value in imu[4:10])
    return mavlink.MAVLink_scaled_imu_message(s.milliseconds, *acceleration, *rates_and_field, _int16(imu[13] * 100))


def _servo_output(s: VehicleState) -> Any:
    pulses = [_int16(1000 + 1000 * value) for value in _floats(s.record["commands"])]
    return mavlink.MAVLink_servo_output_raw_message(max(s.stamp, 0) % 2**32, 0, *pulses[:8])


def _actuators(s: VehicleState) -> Any:
    commands = _floats(s.record["commands"])
    return mavlink.MAVLink_actuator_output_status_message(max(s.stamp, 0), len(commands), commands + [0.0] * 16)


def _extended_state(s: VehicleState) -> Any:
    vehicle = s.vehicle
    state = mavlink.MAV_LANDED_STATE_ON_GROUND if vehicle.vertical.landed else mavlink.MAV_LANDED_STATE_IN_AIR
    if vehicle.armed and vehicle.mode is Mode.TAKEOFF:
        state = mavlink.MAV_LANDED_STATE_TAKEOFF
    elif vehicle.armed and vehicle.mode is Mode.LAND:
        state = mavlink.MAV_LANDED_STATE_LANDING
    return mavlink.MAVLink_extended_sys_state_message(mavlink.MAV_VTOL_STATE_UNDEFINED, state)


def _battery(s: VehicleState) -> Any:
    """All fields unknown: the simulator API carries no battery state."""
    return mavlink.MAVLink_battery_status_message(0, 0, 0, 32767, [UNKNOWN_16] * 10, -1, -1, -1, -1)


def _home_position(s: VehicleState) -> Any:
    return mavlink.MAVLink_home_position_message(*s.home, 0, 0, 0, [1, 0, 0, 0], 0, 0, 0)


def _excitation(s: VehicleState) -> Any:
    """Injected torque, as the firmware's module publishes it: of roll and pitch, or of yaw while that is excited."""
    roll, pitch, yaw = _floats(s.record["excitation"])
    phase, stamp = s.excitation_phase, max(s.stamp, 0)
    if phase == ExcitationPhase.YAW.value:
        return mavlink.MAVLink_debug_vect_message(YAW_EXCITATION_NAME, stamp, yaw, s.excitation_turn, float(phase))
    return mavlink.MAVLink_debug_vect_message(EXCITATION_NAME, stamp, roll, pitch, float(phase))


def _autopilot_version(s: VehicleState) -> Any:
    return mavlink.MAVLink_autopilot_version_message(CAPABILITIES, 0, 0, 0, 0, bytes(8), bytes(8), bytes(8), 0, 0, 0)


@dataclass(frozen=True)
class TelemetryMessage:
    """One telemetry message.

    Attributes
    ----------
    build : callable
        Builds it.
    rate : float, Hz
        Default rate; 0: only on request.
    stream : int
        Its MAV_DATA_STREAM, or `NO_STREAM`.
    needs : str
        The `VehicleState` attribute that must be known; empty: none.
    """

    build: Callable[[VehicleState], Any]
    rate: float
    stream: int
    needs: str = "home"


_STATUS, _POSITION = mavlink.MAV_DATA_STREAM_EXTENDED_STATUS, mavlink.MAV_DATA_STREAM_POSITION
_RAW, _CONTROLLER = mavlink.MAV_DATA_STREAM_RAW_SENSORS, mavlink.MAV_DATA_STREAM_RC_CHANNELS
_ATTITUDE, _HUD = mavlink.MAV_DATA_STREAM_EXTRA1, mavlink.MAV_DATA_STREAM_EXTRA2
NO_STREAM = -1

#: Message number -> how it is sent.
TELEMETRY_MESSAGES = {
    mavlink.MAVLINK_MSG_ID_HEARTBEAT: TelemetryMessage(heartbeat, 1.0, NO_STREAM, ""),
    mavlink.MAVLINK_MSG_ID_SYS_STATUS: TelemetryMessage(_sys_status, 1.0, _STATUS, ""),
    mavlink.MAVLINK_MSG_ID_EXTENDED_SYS_STATE: TelemetryMessage(_extended_state, 2.0, _STATUS),
    mavlink.MAVLINK_MSG_ID_BATTERY_STATUS: TelemetryMessage(_battery, 0.5, _STATUS, ""),
    mavlink.MAVLINK_MSG_ID_HOME_POSITION: TelemetryMessage(_home_position, 0.5, NO_STREAM),
    mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION: TelemetryMessage(_autopilot_version, 0.0, NO_STREAM, ""),
    mavlink.MAVLINK_MSG_ID_ATTITUDE: TelemetryMessage(_attitude, 20.0, _ATTITUDE),
    mavlink.MAVLINK_MSG_ID_ATTITUDE_QUATERNION: TelemetryMessage(_attitude_quaternion, 20.0, _ATTITUDE),
    mavlink.MAVLINK_MSG_ID_ATTITUDE_TARGET: TelemetryMessage(_attitude_target, 5.0, _ATTITUDE),
    mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED: TelemetryMessage(_local_position, 10.0, _POSITION),
    mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT: TelemetryMessage(_global_position, 5.0, _POSITION),
    mavlink.MAVLINK_MSG_ID_GPS_RAW_INT: TelemetryMessage(_gps_raw, 2.0, _STATUS, "fix"),
    mavlink.MAVLINK_MSG_ID_VFR_HUD: TelemetryMessage(_vfr_hud, 5.0, _HUD),
    mavlink.MAVLINK_MSG_ID_ALTITUDE: TelemetryMessage(_altitude, 5.0, _HUD),
    mavlink.MAVLINK_MSG_ID_HIGHRES_IMU: TelemetryMessage(_highres_imu, 5.0, _RAW, "imu"),
    mavlink.MAVLINK_MSG_ID_DEBUG_VECT: TelemetryMessage(_excitation, 0.0, NO_STREAM),
    mavlink.MAVLINK_MSG_ID_SCALED_IMU: TelemetryMessage(_scaled_imu, 0.0, _RAW, "imu"),
    mavlink.MAVLINK_MSG_ID_SERVO_OUTPUT_RAW: TelemetryMessage(_servo_output, 5.0, _CONTROLLER),
    mavlink.MAVLINK_MSG_ID_ACTUATOR_OUTPUT_STATUS: TelemetryMessage(_actuators, 0.0, NO_STREAM),
}


def _floats(values: Any) -> list[float]:
    return [float(value) for value in values]


def _heading(s: VehicleState, unknown: int) -> int:
    """Heading, 0.01 deg; `unknown` when the plant's attitude is not finite."""
    yaw = s.vehicle.estimate.yaw
    return round(math.degrees(yaw) * 100) % 36000 if math.isfinite(yaw) else unknown


def _int16(value: float) -> int:
    return max(-32768, min(32767, round(value))) if math.isfinite(value) else 0
