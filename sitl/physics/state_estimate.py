"""The state estimate that the autopilot receives: noise, gyro filter, frame mode, and the rounding of MAVLink.

A measurement is an array of nine numbers: quaternion (w, x, y, z) and body rates (rad/s) in single precision, then
altitude in whole mm and climb rate in whole cm/s, as in HIL_STATE_QUATERNION. The in-process loop rounds the same way,
so flights in process and over MAVLink agree in every bit.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm

from mimopilot.sitl.errors import SitlError
from mimopilot.sitl.physics.compiled_step import inlined

MEASUREMENT_SIZE = 9  # numbers in a measurement
ESTIMATE_NOISES = 6  # normal numbers for one measurement: 3 angles, 3 rates


def low_pass(cutoff_hz: float, Ts: float) -> NDArray[np.float64]:
    """The gyro filter: a second-order Butterworth low-pass, as in PX4 and ArduPilot.

    Parameters
    ----------
    cutoff_hz : float, Hz
        0: no filter.
    Ts : float, s
        Sampling period.

    Returns
    -------
    (5,) array
        b0, b1, b2, a1, a2.

    Raises
    ------
    SitlError
        When the cutoff is not below half of the sampling rate.
    """
    if not 0 <= cutoff_hz < 0.5 / Ts:
        raise SitlError(
            f"gyro_cutoff_hz: got {cutoff_hz:g} Hz, expected 0 (no filter) to below {0.5 / Ts:g} Hz, half of the "
            "control rate"
        )
    if cutoff_hz == 0:
        return np.array([1.0, 0.0, 0.0, 0.0, 0.0])
    # Bilinear transform, with the cut-off prewarped, of 1 / (s^2 + sqrt(2) s + 1).
    s = np.tan(np.pi * cutoff_hz * Ts)
    scale = 1 + np.sqrt(2) * s + s**2
    b0 = s**2 / scale
    return np.array([b0, 2 * b0, b0, 2 * (s**2 - 1) / scale, (1 - np.sqrt(2) * s + s**2) / scale])


def frame_mode(frequency_hz: float, damping: float, gain: float, Ts: float) -> NDArray[np.float64]:
    """A frame that bends between the rotors and the sensors: one mode on roll and one on pitch.

    The bend b obeys b'' + 2 damping w b' + w^2 b = gain a, where a is the angular acceleration of the body. The sensors
    measure the angle plus b and the rate plus b': the rigid response times 1 + gain s^2 / (s^2 + 2 damping w s + w^2).
    Solved exactly, with the mean acceleration of each period held over it.

    Parameters
    ----------
    frequency_hz : float, Hz
        w / (2 pi); below half of the sampling rate.
    damping : float
        Damping ratio.
    gain : float
        Modal gain relative to the rigid body; 0: a rigid frame.
    Ts : float, s
        Sampling period.

    Returns
    -------
    (6,) array
        A (2, 2) row by row, then B (2,), of the state (b, b') from one measurement to the next.

    Raises
    ------
    SitlError
        When the frequency is not below half of the sampling rate.
    """
    if not frequency_hz < 0.5 / Ts:
        raise SitlError(
            f"frame.frequency_hz: got {frequency_hz:g} Hz, expected below {0.5 / Ts:g} Hz, half of the control rate"
        )
    w = 2 * np.pi * frequency_hz
    augmented = np.array([[0.0, 1.0, 0.0], [-(w**2), -2 * damping * w, gain], [0.0, 0.0, 0.0]])
    transition = expm(augmented * Ts)
    return np.concatenate([transition[:2, :2].ravel(), transition[:2, 2]]).astype(np.float64)


class Sensors(NamedTuple):
    """Constants and state of the sensors; the arrays may be changed between samples.

    Attributes
    ----------
    angle_deviation, rate_deviation : float, rad, rad/s
        Standard deviation of the noise.
    gyro : (5,) array
        Coefficients from `low_pass`.
    memory : (2, 3) array
        State of that filter.
    frame : (7,) array
        Coefficients from `frame_mode`, then 1 / Ts; all zeros for a rigid frame.
    bend : (2, 3) array
        Roll and pitch: bend angle (rad), bend rate (rad/s), and body rate (rad/s) at the last measurement.
    bias : (3,) array, rad/s
        Added to the body rates.
    stuck, failed : (3,) arrays of bool
        Axes whose rate repeats its last value; axes whose rate is NaN.
    """

    angle_deviation: float
    rate_deviation: float
    gyro: NDArray[np.float64]
    memory: NDArray[np.float64]
    frame: NDArray[np.float64]
    bend: NDArray[np.float64]
    bias: NDArray[np.float64]
    stuck: NDArray[np.bool_]
    failed: NDArray[np.bool_]

    @staticmethod
    def healthy(
        angle_deviation: float, rate_deviation: float, gyro: NDArray[np.float64], frame: NDArray[np.float64]
    ) -> Sensors:
        """Make sensors without faults."""
        bias, stuck = np.zeros(3), np.zeros(3, np.bool_)
        memory, bend = np.zeros((2, 3)), np.zeros((2, 3))
        return Sensors(angle_deviation, rate_deviation, gyro, memory, frame, bend, bias, stuck, stuck.copy())

    def restart(self, rates: NDArray[np.float64]) -> None:
        """Reset the filter, the bend and every fault; the body rotates with `rates` (3,), rad/s."""
        for array in (self.memory, self.bend, self.bias, self.stuck, self.failed):
            array[:] = 0
        self.bend[:, 2] = rates[:2]


@inlined
def measure(state, noise, sensors, measurement):  # type: ignore[no-untyped-def]
    """Replace the last `measurement` (9,) by one of the true `state`.

    `noise` (6,) holds standard normal numbers: angles, then rates.
    """
    w, x, y, z = state[6], state[7], state[8], state[9]
    half = 0.5 * sensors.angle_deviation
    a, b, c = half * noise[0], half * noise[1], half * noise[2]
    frame, bend = sensors.frame, sensors.bend
    if frame[6] > 0.0:
        for i in range(2):
            acceleration = (state[10 + i] - bend[i, 2]) * frame[6]
            angle, rate = bend[i, 0], bend[i, 1]
            bend[i, 0] = frame[0] * angle + frame[1] * rate + frame[4] * acceleration
            bend[i, 1] = frame[2] * angle + frame[3] * rate + frame[5] * acceleration
            bend[i, 2] = state[10 + i]
        a, b = a + 0.5 * bend[0, 0], b + 0.5 * bend[1, 0]
    # Rotate by the small angles of noise and bend, 1 + (a, b, c), and restore unit length.
    qw, qx = w - x * a - y * b - z * c, x + w * a + y * c - z * b
    qy, qz = y + w * b + z * a - x * c, z + w * c + x * b - y * a
    scale = 1.0 / np.sqrt(qw * qw + qx * qx + qy * qy + qz * qz)
    measurement[0], measurement[1], measurement[2], measurement[3] = (
        np.float32(qw * scale),
        np.float32(qx * scale),
        np.float32(qy * scale),
        np.float32(qz * scale),
    )
    gyro, memory = sensors.gyro, sensors.memory
    for i in range(3):
        rate = state[10 + i] + sensors.rate_deviation * noise[3 + i] + sensors.bias[i]
        if i < 2:
            rate += bend[i, 1]
        filtered = gyro[0] * rate + memory[0, i]
        memory[0, i] = gyro[1] * rate - gyro[3] * filtered + memory[1, i]
        memory[1, i] = gyro[2] * rate - gyro[4] * filtered
        if sensors.failed[i]:
            measurement[4 + i] = np.nan
        elif not sensors.stuck[i]:
            measurement[4 + i] = np.float32(filtered)
    measurement[7] = np.round(-1000.0 * state[2])
    measurement[8] = np.round(-100.0 * state[5])


@inlined
def quaternion_of(roll, pitch, yaw):  # type: ignore[no-untyped-def]
    """Quaternion w, x, y, z of angles, rad; inverse of `euler_angles`."""
    cr, cp, cy = np.cos(roll / 2), np.cos(pitch / 2), np.cos(yaw / 2)
    sr, sp, sy = np.sin(roll / 2), np.sin(pitch / 2), np.sin(yaw / 2)
    return (
        cr * cp * cy + sr * sp * sy,
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
    )


@inlined
def euler_angles(w, x, y, z):  # type: ignore[no-untyped-def]
    """Roll, pitch and yaw (rad) of the aeronautical 3-2-1 sequence."""
    return (
        np.arctan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y)),
        np.arcsin(min(max(2.0 * (w * y - z * x), -1.0), 1.0)),
        np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z)),
    )
