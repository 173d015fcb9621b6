"""Simulated flights as PX4 logs: topics and fields have PX4's names, so one reader serves both."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mimopilot.codegen.layout import to_array
from mimopilot.codegen.render import generator_version
from mimopilot.common.files import write_atomically
from mimopilot.sitl.flight.simulator import Flight
from mimopilot.sitl.flight.ulog_writer import ulog_bytes
from mimopilot.sitl.physics.airframe import Airframe
from mimopilot.sitl.physics.state_estimate import quaternion_of
from mimopilot.tuning.gains import Gains
from mimopilot.tuning.parameters import IDENTITY, PARAMETERS

#: Names of the debug_vect messages with the injected torque, as in the firmware: x, y on roll and pitch; x on yaw.
EXCITATION_NAME, YAW_EXCITATION_NAME = b"MIMO_EXC", b"MIMO_EXY"


def quaternions(angles: NDArray[Any]) -> NDArray[np.float32]:
    """Quaternions (N, 4), w first, of roll, pitch and yaw (N, 3), rad."""
    # As plain Python: compiling it for arrays would take longer than any log.
    return np.column_stack(quaternion_of.py_func(*np.asarray(angles, np.float64).T)).astype(np.float32)


def setpoint_quaternions(record: NDArray[Any]) -> NDArray[np.float32]:
    """Attitude setpoints (N, 4) of a record; in rate mode, which has none, the attitude."""
    return quaternions(np.where(record["rate_mode"][:, None] != 0, record["attitude"], record["setpoint"]))


def flight_log_bytes(flight: Flight, airframe: Airframe, gains: Gains) -> bytes:
    """The flight as a ULog file; u is logged with the injected torque, which has its own topic.

    Parameters
    ----------
    flight : Flight
        The flight.
    airframe : Airframe
        The vehicle.
    gains : Gains
        Gains in flight, logged as parameters of the vehicle.
    """
    truth = flight.truth
    topics = autopilot_topics(flight.record, len(airframe.rotors)) | injection_topics(flight.record, flight.scenario.Ts)
    topics |= {
        "vehicle_attitude_groundtruth": {"q": quaternions(truth["attitude"])},
        "vehicle_angular_velocity_groundtruth": {"xyz": truth["rates"].astype(np.float32)},
        "vehicle_local_position_groundtruth": {
            name: truth[field][:, i].astype(np.float32)
            for field, names in (("position", "x y z"), ("velocity", "vx vy vz"))
            for i, name in enumerate(names.split())
        },
    }
    flown = {p.name: float(value) for p, value in zip(PARAMETERS, to_array(gains), strict=True)}
    return _ulog_file(flight.scenario.Ts, topics, flown, airframe)


def vehicle_log(
    record: NDArray[Any], landed: NDArray[np.bool_], Ts: float, airframe: Airframe, parameters: Mapping[str, float]
) -> bytes:
    """A flight without its true state, from arming to disarming, as a ULog file.

    Parameters
    ----------
    record : (N,) array of `sitl.autopilot.autopilot.RECORD`
        Inputs and outputs of the autopilot.
    landed : (N,) array of bool
        Whether the vehicle was on the ground.
    Ts : float, s
        Control period.
    airframe : Airframe
        The vehicle.
    parameters : mapping
        Name -> value of the parameters in flight.
    """
    topics = autopilot_topics(record, len(airframe.rotors)) | injection_topics(record, Ts) | vehicle_topics(landed)
    return _ulog_file(Ts, topics, parameters, airframe)


def _ulog_file(
    Ts: float, topics: dict[str, dict[str, NDArray[Any]]], parameters: Mapping[str, float], airframe: Airframe
) -> bytes:
    scale = {parameter.name: value for parameter, value in zip(IDENTITY, airframe.moment_scale(), strict=True)}
    return ulog_bytes(Ts, topics, {**parameters, **scale}, log_information(airframe))


def log_information(airframe: Airframe) -> dict[str, str]:
    """Key -> text that says where a log comes from."""
    return {
        "sys_name": "mimopilot",
        "ver_hw": f"SITL {airframe.name}",
        "ver_sw": f"mimopilot {generator_version()}",
    }


def vehicle_topics(landed: NDArray[np.bool_]) -> dict[str, dict[str, NDArray[Any]]]:
    """Topics of the state of an armed vehicle; (N,) whether it was on the ground."""
    return {
        "vehicle_land_detected": {"landed": landed.astype(np.uint8)},
        "actuator_armed": {"armed": np.ones(len(landed), np.uint8)},
    }


def autopilot_topics(record: NDArray[Any], rotors: int) -> dict[str, dict[str, NDArray[Any]]]:
    """Topics of the inputs and outputs of the autopilot."""
    thrust = np.zeros((len(record), 3), np.float32)
    thrust[:, 2] = -record["collective"]
    return {
        "vehicle_angular_velocity": {"xyz": record["rates"]},
        "vehicle_attitude": {"q": record["quaternion"]},
        "vehicle_attitude_setpoint": {
            "q_d": setpoint_quaternions(record),
            "yaw_sp_move_rate": record["yaw_rate"],
            "thrust_body": thrust,
        },
        "vehicle_rates_setpoint": {
            **{name: record["rates_setpoint"][:, i] for i, name in enumerate(("roll", "pitch", "yaw"))},
            "thrust_body": thrust,
        },
        "vehicle_torque_setpoint": {"xyz": record["moment"]},
        "vehicle_thrust_setpoint": {"xyz": thrust},
        "actuator_motors": {"control": record["commands"][:, :rotors]},
        "control_allocator_status": {"unallocated_torque": record["unallocated"]},
    }


def injection_topics(record: NDArray[Any], Ts: float) -> dict[str, dict[str, NDArray[Any]]]:
    """Topic of the injected torque."""
    excitation = record["excitation"]
    # One message a period, as in the firmware; z is the excited axis, numbered as `ExcitationPhase`.
    on_yaw = excitation[:, 2] != 0
    active = np.select([excitation[:, 0] != 0, excitation[:, 1] != 0, on_yaw], [0, 1, 3], -1).astype(np.float32)
    return {
        "debug_vect": {
            "x": np.where(on_yaw, excitation[:, 2], excitation[:, 0]),
            "y": np.where(on_yaw, _turned(record["rates"][:, 2], on_yaw, Ts), excitation[:, 1]),
            "z": active,
            "name": np.where(on_yaw, np.array(YAW_EXCITATION_NAME, "S10"), np.array(EXCITATION_NAME, "S10")),
        },
    }


def _turned(rate: NDArray[Any], on_yaw: NDArray[np.bool_], Ts: float) -> NDArray[np.float32]:
    """How far the vehicle has turned since yaw's excitation began, rad, as y of MIMO_EXY says."""
    turned = np.cumsum(np.where(on_yaw, rate, 0.0)) * Ts
    return turned.astype(np.float32)


def save_flight(path: Path, flight: Flight, airframe: Airframe, gains: Gains) -> None:
    """Write `flight_log_bytes` to a file, atomically."""
    write_atomically(path, flight_log_bytes(flight, airframe, gains))
