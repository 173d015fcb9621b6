"""Flights of the bench's stock PX4 as logs: a stock PX4's topics, rates and parameters."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mimopilot.sitl.autopilot.autotune_module import AXIS_STATES, PUBLISHED_S
from mimopilot.sitl.flight.flight_log import autopilot_topics, log_information, vehicle_topics
from mimopilot.sitl.flight.ulog_writer import ulog_bytes
from mimopilot.sitl.physics.airframe import Airframe
from mimopilot.tuning.px4_names import HIGH_RATE, LOG_PROFILE

#: Topic -> interval (s) in the default log profile and in that for high rates (logged_topics.cpp of v1.16); 0: all.
INTERVALS = {
    "vehicle_angular_velocity": (0.02, 0.0),
    "vehicle_attitude": (0.05, 0.0),
    "vehicle_attitude_setpoint": (0.05, 0.0),
    "vehicle_rates_setpoint": (0.02, 0.0),
    "vehicle_torque_setpoint": (0.02, 0.0),
    "vehicle_thrust_setpoint": (0.02, 0.0),
    "actuator_motors": (0.1, 0.0),
    "control_allocator_status": (0.2, 0.2),
}
AUTOTUNE_TOPIC = "autotune_attitude_control_status"


def stock_log(
    record: NDArray[Any], landed: NDArray[np.bool_], Ts: float, airframe: Airframe, parameters: Mapping[str, float]
) -> bytes:
    """A flight of the stock PX4, from arming to disarming, as a ULog file.

    Parameters
    ----------
    record : (N,) array of `sitl.autopilot.autopilot.RECORD`
        Inputs and outputs of the autopilot; its excitation is what the autotune adds to the rate setpoint, rad/s.
    landed : (N,) array of bool
        Whether the vehicle was on the ground.
    Ts : float, s
        Control period.
    airframe : Airframe
        The vehicle.
    parameters : mapping
        PX4's parameters; the log profile is that of the last boot.
    """
    topics = autopilot_topics(record, len(airframe.rotors)) | vehicle_topics(landed)
    fast = bool(round(parameters[LOG_PROFILE]) & HIGH_RATE)
    samples = {topic: (0, max(1, round(intervals[fast] / Ts))) for topic, intervals in INTERVALS.items()}
    signal = record["excitation"]
    if signal.any():
        state = np.zeros(len(record), np.uint8)
        for axis, number in enumerate(AXIS_STATES):
            state[signal[:, axis] != 0] = number
        topics[AUTOTUNE_TOPIC] = {"rate_sp": signal, "state": state}
        # Published with the first sample that uses it, and held until the next.
        period = round(PUBLISHED_S / Ts)
        samples[AUTOTUNE_TOPIC] = (int(np.flatnonzero(signal.any(axis=1))[0]) % period, period)
    return ulog_bytes(Ts, topics, parameters, log_information(airframe), samples)
