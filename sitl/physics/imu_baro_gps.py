"""What a vehicle's own instruments say, for an autopilot that has an estimator of its own.

Accelerometer (specific force), gyro, magnetometer and barometer, then a satellite receiver. The densities and
deviations are those of the parts that small autopilots carry; each run draws its own constant biases.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from mimopilot.sitl.physics.compiled import compiled
from mimopilot.sitl.physics.rigid_body import GRAVITY
from numpy.typing import NDArray

GYRO_DENSITY = 1.75e-4  # rad/s/sqrt(Hz)
GYRO_BIAS = 2e-3  # rad/s, deviation between runs
GYRO_RANGE = math.radians(1999.0)  # rad/s
ACCELEROMETER_DENSITY = 2e-3  # m/s^2/sqrt(Hz)
ACCELEROMETER_BIAS = 0.03  # m/s^2
ACCELEROMETER_RANGE = 15.9 * GRAVITY
MAGNETOMETER_NOISE = 2e-3  # Gauss
MAGNETOMETER_BIAS = 3e-3  # Gauss
BAROMETER_NOISE = 0.012  # hPa, which is 0.1 m

HOME_LATITUDE, HOME_LONGITUDE = 47.3977420, 8.5455940  # deg; home is at sea level
DECLINATION, INCLINATION, FIELD = math.radians(3.4), math.radians(63.2), 0.482  # of the earth there, Gauss
METRES_PER_DEGREE = 111_319.5
SEA_LEVEL_PRESSURE, SEA_LEVEL_TEMPERATURE = 1013.25, 20.0  # hPa, deg C
LAPSE = 0.0065  # K/m

GPS_PERIOD = 0.1  # s
GPS_HORIZONTAL, GPS_VERTICAL, GPS_SPEED = 0.1, 0.2, 0.05  # m, m, m/s, deviations of the noise
GPS_EPH, GPS_EPV = 90, 150  # cm, what the receiver says of itself
FIX_3D, SATELLITES = 3, 12

READINGS = 15
NOISES = 10

EARTH_FIELD = FIELD * np.array(
    [
        math.cos(INCLINATION) * math.cos(DECLINATION),
        math.cos(INCLINATION) * math.sin(DECLINATION),
        math.sin(INCLINATION),
    ]
)


class Place(NamedTuple):
    """A point on the earth as MAVLink writes it: 1e-7 deg, 1e-7 deg, mm."""

    latitude: int
    longitude: int
    altitude: int


class Fix(NamedTuple):
    """What the receiver says: where, how fast (cm/s: over ground, north, east, down), course (0.01 deg)."""

    place: Place
    speed: int
    north: int
    east: int
    down: int
    course: int


def place(north: float, east: float, down: float) -> Place:
    """Where on the earth a position (m, NED from home) is."""
    eastward = METRES_PER_DEGREE * math.cos(math.radians(HOME_LATITUDE))
    return Place(
        round((HOME_LATITUDE + north / METRES_PER_DEGREE) * 1e7),
        round((HOME_LONGITUDE + east / eastward) * 1e7),
        round(-1000.0 * down),
    )


@compiled
def _to_body(q, x, y, z):  # type: ignore[no-untyped-def]
    """An earth vector in body axes."""
    w, a, b, c = q[0], q[1], q[2], q[3]
    return (
        (1 - 2 * (b * b + c * c)) * x + 2 * (a * b + w * c) * y + 2 * (a * c - w * b) * z,
        2 * (a * b - w * c) * x + (1 - 2 * (a * a + c * c)) * y + 2 * (b * c + w * a) * z,
        2 * (a * c + w * b) * x + 2 * (b * c - w * a) * y + (1 - 2 * (a * a + b * b)) * z,
    )


@compiled
def _read(state, before, Ts, biases, deviations, noise, field, out):  # type: ignore[no-untyped-def]
    """Fill `out` (15,): accelerometer, gyro, magnetometer, pressure, its altitude, temperature, then the acceleration.

    `before` is the state one period ago: an accelerometer reports what happened between two samples, and so the
    push of the ground is in it.
    """
    q = np.empty(4)
    for i in range(4):
        q[i] = state[6 + i] + before[6 + i]
    scale = 1.0 / np.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    for i in range(4):
        q[i] *= scale
    x, y, z = (state[3] - before[3]) / Ts, (state[4] - before[4]) / Ts, (state[5] - before[5]) / Ts
    out[12], out[13], out[14] = _to_body(q, x, y, z)
    out[0], out[1], out[2] = _to_body(q, x, y, z - GRAVITY)
    out[3], out[4], out[5] = state[10], state[11], state[12]
    out[6], out[7], out[8] = _to_body(state[6:10], field[0], field[1], field[2])
    for i in range(9):
        out[i] += biases[i] + deviations[i] * noise[i]
    for i in range(3):
        out[i] = min(max(out[i], -ACCELEROMETER_RANGE), ACCELEROMETER_RANGE)
        out[3 + i] = min(max(out[3 + i], -GYRO_RANGE), GYRO_RANGE)
    # The standard atmosphere, and back.
    pressure = SEA_LEVEL_PRESSURE * max(1.0 + 2.25577e-5 * state[2], 0.01) ** 5.25588 + BAROMETER_NOISE * noise[9]
    out[9] = pressure
    out[10] = (1.0 - (pressure / SEA_LEVEL_PRESSURE) ** (1.0 / 5.25588)) / 2.25577e-5
    out[11] = SEA_LEVEL_TEMPERATURE + LAPSE * state[2]


class Instruments:
    """The instruments of one vehicle.

    Parameters
    ----------
    state : (13 + n,) array
        Where it starts, see `sitl.physics.rigid_body`.
    Ts : float, s
        Interval between readings.
    seed : int
        Of noise and biases.
    """

    def __init__(self, state: NDArray[np.float64], Ts: float, seed: int) -> None:
        self.Ts = Ts
        self.inertial, self.satellites = (np.random.default_rng([seed, which]) for which in (1, 2))
        bandwidth = math.sqrt(0.5 / Ts)
        deviations = ACCELEROMETER_DENSITY * bandwidth, GYRO_DENSITY * bandwidth, MAGNETOMETER_NOISE
        self.deviations = np.repeat(deviations, 3)
        spread = np.repeat((ACCELEROMETER_BIAS, GYRO_BIAS, MAGNETOMETER_BIAS), 3)
        self.biases = spread * np.clip(self.inertial.standard_normal(9), -2.0, 2.0)
        self.before = state.copy()
        self.out = np.zeros(READINGS)

    def read(self, state: NDArray[np.float64]) -> list[float]:
        """Readings at the end of a period.

        Returns
        -------
        list of 15
            Specific force (m/s^2), rates (rad/s) and magnetic field (Gauss) in body axes; pressure (hPa), the
            altitude (m) that it stands for, temperature (deg C); and the true acceleration (m/s^2, body).
        """
        noise = self.inertial.standard_normal(NOISES)
        _read(state, self.before, self.Ts, self.biases, self.deviations, noise, EARTH_FIELD, self.out)
        self.before[:] = state
        readings: list[float] = self.out.tolist()
        return readings

    def fix(self, state: NDArray[np.float64]) -> Fix:
        """What the satellite receiver says now."""
        deviations = (GPS_HORIZONTAL, GPS_HORIZONTAL, GPS_VERTICAL, GPS_SPEED, GPS_SPEED, GPS_SPEED)
        x, y, z, north, east, down = (state[:6] + deviations * self.satellites.standard_normal(6)).tolist()
        speed = math.hypot(north, east)
        course = round(math.degrees(math.atan2(east, north)) * 100) % 36000
        return Fix(place(x, y, z), centi(speed), centi(north), centi(east), centi(down), course)


def centi(value: float) -> int:
    """Hundredths, as many as 16 bits hold."""
    return max(-32768, min(32767, round(value * 100)))
