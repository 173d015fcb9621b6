"""The state of the vehicle at one time, from which all telemetry is made."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from pymavlink.dialects.v20 import common as mavlink

from mimopilot.sitl.autopilot.autopilot import RECORD
from mimopilot.sitl.autopilot.flight_modes import Commander
from mimopilot.sitl.autopilot.setpoints import earth_to_heading
from mimopilot.sitl.mavlink.simulator_api.plant_link import PlantState
from mimopilot.sitl.physics.imu_baro_gps import METRES_PER_DEGREE

UNKNOWN = PlantState(*[0] * 19)


@dataclass
class VehicleState:
    """What telemetry is made from.

    Attributes
    ----------
    vehicle : Commander
    stamp : int, us
        The plant's clock at the last period.
    record : one of `sitl.autopilot.autopilot.RECORD`
        Inputs and outputs of the autopilot in that period.
    plant : PlantState
        The plant's last HIL_STATE_QUATERNION.
    imu, fix : tuple
        Fields of the plant's last HIL_SENSOR and HIL_GPS, in wire order, see `wire.fast_codec`; empty until then.
    home : (latitude, longitude, altitude), 1e-7 deg, mm
        First position received from the plant; empty until then.
    load : float
        Share of the last second in which the control loop did not sleep.
    excitation_phase : int
        0 roll, 1 pitch, 2 between two axes, 3 yaw, -1 off.
    excitation_turn : float, rad
        Since yaw's excitation began.
    autopilot : int
        MAV_AUTOPILOT that the vehicle reports.
    """

    vehicle: Commander
    stamp: int = -1
    record: Any = field(default_factory=lambda: np.zeros(1, RECORD)[0])
    plant: PlantState = UNKNOWN
    imu: tuple[Any, ...] = ()
    fix: tuple[Any, ...] = ()
    home: tuple[int, ...] = ()
    load: float = 0.0
    excitation_phase: int = -1
    autopilot: int = mavlink.MAV_AUTOPILOT_GENERIC
    excitation_turn: float = 0.0

    @property
    def milliseconds(self) -> int:
        """Time since boot, ms, as a uint32."""
        return max(self.stamp, 0) // 1000 % 2**32

    def local(self) -> tuple[float, ...]:
        """Position (m) and velocity (m/s), down positive: from motion capture while it is fresh, else from home."""
        estimate, vehicle = self.vehicle.estimate, self.vehicle
        if vehicle.pose.fresh(vehicle.now):
            pose = vehicle.pose.value
            vx, vy = earth_to_heading(estimate.north, estimate.east, estimate.yaw - pose.yaw)
            return pose.x, pose.y, pose.z, vx, vy, -estimate.climb
        latitude, longitude, altitude = self.home
        metres = 1e-7 * METRES_PER_DEGREE
        east = metres * math.cos(math.radians(latitude * 1e-7))
        return (
            (self.plant.lat - latitude) * metres,
            (self.plant.lon - longitude) * east,
            (altitude - self.plant.alt) / 1000,
            estimate.north,
            estimate.east,
            -estimate.climb,
        )
