"""What the autopilot is told of the vehicle's state: the estimate, with noise, rounded as the wire rounds it.

A measurement is an array of nine numbers: quaternion (w, x, y, z) and body rates (rad/s), each a
single-precision value, then altitude in whole millimetres and climb rate in whole cm/s, just what one
HIL_STATE_QUATERNION message carries. The in-process loop rounds the same way, so both fly the same bits.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from mimopilot.sitl.errors import SitlError
from mimopilot.sitl.physics.compiled import inlined
from numpy.typing import NDArray
from scipy.linalg import expm
from scipy.signal import butter

SIZE = 9
NOISES = 6


def low_pass(cutoff_hz: float, Ts: float) -> NDArray[np.float64]:
    """The gyro's filter, a second-order Butterworth low-pass as flight stacks have it.

    Parameters
    ----------
    cutoff_hz : float, Hz
        0: none.
    Ts : float, s
        Its period.

    Returns
    -------
    (5,) array
        b0, b1, b2, a1, a2.

    Raises
    ------
    SitlError
        When the cut-off is at half of the rate or above.
    """
    if not 0 <= cutoff_hz < 0.5 / Ts:
        raise SitlError(
            f"gyro_cutoff_hz: got {cutoff_hz:g} Hz, expected 0 (no filter) to below {0.5 / Ts:g} Hz, half of the "
            "control rate"
        )
    if cutoff_hz == 0:
        return np.array([1.0, 0.0, 0.0, 0.0, 0.0])
    b, a = butter(2, cutoff_hz, fs=1 / Ts)
    return np.concatenate([b, a[1:]]).astype(np.float64)


def frame_mode(frequency_hz: float, damping: float, gain: float, Ts: float) -> NDArray[np.float64]:
    """A frame that bends between the rotors and the sensors: one mode on roll and one on pitch.

    The bend b obeys b'' + 2 damping w b' + w^2 b = gain a, a the body's angular acceleration; what is measured is the
    body's angle plus b and its rate plus b': the rigid response times 1 + gain s^2 / (s^2 + 2 damping w s + w^2).
    Solved exactly with the mean acceleration of a period held over it.

    Parameters
    ----------
    frequency_hz : float, Hz
        w / (2 pi); below half of the rate.
    damping : float
        Share of the critical one.
    gain : float
        Modal gain over that of the rigid body; 0: a rigid frame.
    Ts : float, s
        Period of the measurement.

    Returns
    -------
    (6,) array
        A row by row, then B, of (b, b') from one measurement to the next under the acceleration.

    Raises
    ------
    SitlError
        When the frequency is at half of the rate or above.
    """
    if not frequency_hz < 0.5 / Ts:
        raise SitlError(
            f"frame.frequency_hz: got {frequency_hz:g} Hz, expected below {0.5 / Ts:g} Hz, half of the control rate"
        )
    w = 2 * np.pi * frequency_hz
    augmented = np.array([[0.0, 1.0, 0.0], [-(w**2), -2 * damping * w, gain], [0.0, 0.0, 0.0]])
    moved = expm(augmented * Ts)
    return np.concatenate([moved[:2, :2].ravel(), moved[:2, 2]]).astype(np.float64)


class Sensors(NamedTuple):
    """Constants and memory of the measurement; the arrays may be changed between samples.

    Attributes
    ----------
    angle_deviation, rate_deviation : float, rad, rad/s
        Standard deviation of the noise.
    gyro : (5,) array
        From `low_pass`.
    memory : (2, 3) array
        Of that filter.
    frame : (7,) array
        From `frame_mode`, then 1 / Ts; all zeros for a rigid frame.
    bend : (2, 3) array
        Of the frame on roll and pitch: angle (rad), rate (rad/s), and the body's rate (rad/s) at the last measurement.
    bias : (3,) array, rad/s
        Added to the body rates.
    stuck, failed : (3,) arrays of bool
        Rates that repeat their last value; rates that are not a number.
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
    def sound(
        angle_deviation: float, rate_deviation: float, gyro: NDArray[np.float64], frame: NDArray[np.float64]
    ) -> Sensors:
        """Sensors without a fault."""
        nothing, never = np.zeros(3), np.zeros(3, np.bool_)
        memory, bend = np.zeros((2, 3)), np.zeros((2, 3))
        return Sensors(angle_deviation, rate_deviation, gyro, memory, frame, bend, nothing, never, never.copy())

    def restart(self, rates: NDArray[np.float64]) -> None:
        """Forget all that was measured, and every fault; the body turns with `rates` (3,), rad/s."""
        for array in (self.memory, self.bend, self.bias, self.stuck, self.failed):
            array[:] = 0
        self.bend[:, 2] = rates[:2]


@inlined
def measure(state, noise, sensors, seen):  # type: ignore[no-untyped-def]
    """Fill `seen` (9,), which holds the last measurement, from the true state and six standard normal numbers
    (angles, then rates).
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
    # A small rotation about the body axes, 1 + (a, b, c), noise and bend, then back to length one.
    qw, qx = w - x * a - y * b - z * c, x + w * a + y * c - z * b
    qy, qz = y + w * b + z * a - x * c, z + w * c + x * b - y * a
    scale = 1.0 / np.sqrt(qw * qw + qx * qx + qy * qy + qz * qz)
    seen[0], seen[1], seen[2], seen[3] = (
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
            seen[4 + i] = np.nan
        elif not sensors.stuck[i]:
            seen[4 + i] = np.float32(filtered)
    seen[7] = np.round(-1000.0 * state[2])
    seen[8] = np.round(-100.0 * state[5])


@inlined
def euler_angles(w, x, y, z):  # type: ignore[no-untyped-def]
    """Roll, pitch and yaw (rad) of the aeronautical 3-2-1 sequence."""
    return (
        np.arctan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y)),
        np.arcsin(min(max(2.0 * (w * y - z * x), -1.0), 1.0)),
        np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z)),
    )
