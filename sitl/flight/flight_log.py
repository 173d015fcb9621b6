"""A flight of the bench as a PX4 log: topics and fields as PX4 names them, so one reader serves both."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from mimopilot.codegen.layout import to_array
from mimopilot.codegen.render import generator_version
from mimopilot.sitl.flight.simulator import Flight
from mimopilot.sitl.flight.ulog_writer import ulog_bytes
from mimopilot.sitl.physics.airframe import Airframe
from mimopilot.tuning.gains import Gains
from mimopilot.tuning.parameters import IDENTITY, PARAMETERS
from numpy.typing import NDArray

from mimopilot.common.files import write_atomically

EXCITATION_NAME = b"MIMO_EXC"


def quaternions(angles: NDArray[Any]) -> NDArray[np.float32]:
    """Quaternions (N, 4), w first, of aeronautical angles (N, 3), rad."""
    half = np.asarray(angles, np.float64).T / 2
    (cr, cp, cy), (sr, sp, sy) = np.cos(half), np.sin(half)
    return np.column_stack(
        [
            cr * cp * cy + sr * sp * sy,
            sr * cp * cy - cr * sp * sy,
            cr * sp * cy + sr * cp * sy,
            cr * cp * sy - sr * sp * cy,
        ]
    ).astype(np.float32)


def record_flight(flight: Flight, airframe: Airframe, gains: Gains) -> bytes:
    """The flight as a ULog file; u is logged after injection, the injected signal beside it.

    Parameters
    ----------
    flight : Flight
        What flew.
    airframe : Airframe
        The vehicle.
    gains : Gains
        The controller that flew: logged as the vehicle's parameters.
    """
    truth = flight.truth
    topics = _seen(flight.record, len(airframe.rotors)) | {
        "vehicle_attitude_groundtruth": {"q": quaternions(truth["attitude"])},
        "vehicle_angular_velocity_groundtruth": {"xyz": truth["rates"].astype(np.float32)},
        "vehicle_local_position_groundtruth": {
            name: truth[field][:, i].astype(np.float32)
            for field, names in (("position", "x y z"), ("velocity", "vx vy vz"))
            for i, name in enumerate(names.split())
        },
    }
    return _file(flight.scenario.Ts, topics, to_array(gains), airframe)


def vehicle_log(
    record: NDArray[Any], landed: NDArray[np.bool_], Ts: float, airframe: Airframe, gains: NDArray[np.float32]
) -> bytes:
    """A flight of which only the vehicle's own view is known, from arming to disarming, as a ULog file.

    Parameters
    ----------
    record : (N,) array of `sitl.autopilot.autopilot.RECORD`
        What the autopilot saw and did.
    landed : (N,) array of bool
        Whether it stood on the ground.
    Ts : float, s
        Control period.
    airframe : Airframe
        The vehicle.
    gains : (36,) float32 array
        What flew, in the order of `tuning.parameters.PARAMETERS`.
    """
    topics = _seen(record, len(airframe.rotors)) | {
        "vehicle_land_detected": {"landed": landed.astype(np.uint8)},
        "actuator_armed": {"armed": np.ones(len(record), np.uint8)},
    }
    return _file(Ts, topics, gains, airframe)


def _file(
    Ts: float, topics: dict[str, dict[str, NDArray[Any]]], gains: NDArray[np.float32], airframe: Airframe
) -> bytes:
    parameters = {parameter.name: float(value) for parameter, value in zip(PARAMETERS, gains, strict=True)}
    scale = airframe.moment_scale()
    parameters |= {parameter.name: value for parameter, value in zip(IDENTITY, scale, strict=True)}
    information = {
        "sys_name": "mimopilot",
        "ver_hw": f"SITL {airframe.name}",
        "ver_sw": f"mimopilot {generator_version()}",
    }
    return ulog_bytes(Ts, topics, parameters, information)


def _seen(record: NDArray[Any], rotors: int) -> dict[str, dict[str, NDArray[Any]]]:
    """Topics of what the autopilot saw and did."""
    excitation = record["excitation"]
    # z is the axis that is being excited: 0 roll, 1 pitch, -1 none.
    active = np.where(excitation[:, 0] != 0, 0, np.where(excitation[:, 1] != 0, 1, -1)).astype(np.float32)
    thrust = np.zeros_like(excitation)
    thrust[:, 2] = -record["collective"]
    return {
        "vehicle_angular_velocity": {"xyz": record["rates"]},
        "vehicle_attitude": {"q": record["quaternion"]},
        "vehicle_attitude_setpoint": {"q_d": quaternions(record["setpoint"]), "thrust_body": thrust},
        "vehicle_rates_setpoint": {
            **{name: record["rates_setpoint"][:, i] for i, name in enumerate(("roll", "pitch", "yaw"))},
            "thrust_body": thrust,
        },
        "vehicle_torque_setpoint": {"xyz": record["moment"]},
        "vehicle_thrust_setpoint": {"xyz": thrust},
        "actuator_motors": {"control": record["commands"][:, :rotors]},
        "control_allocator_status": {"unallocated_torque": record["unallocated"]},
        "debug_vect": {
            "x": excitation[:, 0],
            "y": excitation[:, 1],
            "z": active,
            "name": np.full(len(record), EXCITATION_NAME, "S10"),
        },
    }


def save_flight(path: Path, flight: Flight, airframe: Airframe, gains: Gains) -> None:
    """`record_flight` into a file, atomically."""
    write_atomically(path, record_flight(flight, airframe, gains))
