"""Raw sensors for an autopilot with its own estimator: accelerometer, gyro, magnetometer, barometer, GPS.

The noise densities, deviations and ranges are class values of the parts on small autopilots. Each run draws its own
constant biases.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mimopilot.sitl.physics.compiled_step import compiled
from mimopilot.sitl.physics.rigid_body import GRAVITY

GYRO_DENSITY = 1.75e-4  # rad/s/sqrt(Hz): 0.01 deg/s/sqrt(Hz)
GYRO_BIAS = 2e-3  # rad/s, standard deviation between runs
GYRO_RANGE = math.radians(1999.0)  # rad/s; just below the +-2000 deg/s of the parts
ACCELEROMETER_DENSITY = 2e-3  # m/s^2/sqrt(Hz): 0.2 mg/sqrt(Hz)
ACCELEROMETER_BIAS = 0.03  # m/s^2, standard deviation between runs
ACCELEROMETER_RANGE = 15.9 * GRAVITY  # m/s^2; just below the +-16 g of the parts
MAGNETOMETER_NOISE = 2e-3  # Gauss, standard deviation
MAGNETOMETER_BIAS = 3e-3  # Gauss, standard deviation between runs
BAROMETER_NOISE = 0.012  # hPa, standard deviation: 0.1 m

HOME_LATITUDE, HOME_LONGITUDE = 47.3977420, 8.5455940  # deg, PX4's default home of simulations; here at sea level
DECLINATION, INCLINATION, FIELD = math.radians(3.4), math.radians(63.2), 0.482  # rad, rad, Gauss, at home
METRES_PER_DEGREE = 111_319.5  # of latitude, on a sphere with the WGS 84 equatorial radius
SEA_LEVEL_PRESSURE, SEA_LEVEL_TEMPERATURE = 1013.25, 20.0  # hPa (ISA), deg C (chosen)
LAPSE = 0.0065  # K/m (ISA)
PRESSURE_LAPSE, PRESSURE_EXPONENT = 2.25577e-5, 5.25588  # 1/m, -: barometric formula of the ISA below 11 km
MIN_PRESSURE_BASE = 0.01  # keeps the power real above the altitude where the formula ends

GPS_PERIOD = 0.1  # s: 10 Hz receiver
GPS_HORIZONTAL, GPS_VERTICAL, GPS_SPEED = 0.1, 0.2, 0.05  # m, m, m/s, standard deviations
GPS_EPH, GPS_EPV = 90, 150  # cm, accuracies that the receiver reports
FIX_3D, SATELLITES = 3, 12  # MAVLink's GPS_FIX_TYPE_3D_FIX; chosen

READINGS = 15  # numbers in a reading, see `ImuBaroGps.read`
SENSOR_NOISES = 10  # normal numbers for one reading: accelerometer, gyro, magnetometer (3 each), barometer

EARTH_FIELD = FIELD * np.array(
    [
        math.cos(INCLINATION) * math.cos(DECLINATION),
        math.cos(INCLINATION) * math.sin(DECLINATION),
        math.sin(INCLINATION),
    ]
)


class GlobalPosition(NamedTuple):
    """A point on the earth in MAVLink units: 1e-7 deg, 1e-7 deg, mm."""

    latitude: int
    longitude: int
    altitude: int


class GpsFix(NamedTuple):
    """A fix of the receiver: position, speeds (cm/s: over ground, north, east, down), course (0.01 deg)."""

    position: GlobalPosition
    speed: int
    north: int
    east: int
    down: int
    course: int


def global_position(north: float, east: float, down: float) -> GlobalPosition:
    """Convert a position (m, NED from home) to a point on the earth."""
    eastward = METRES_PER_DEGREE * math.cos(math.radians(HOME_LATITUDE))
    return GlobalPosition(
        round((HOME_LATITUDE + north / METRES_PER_DEGREE) * 1e7),
        round((HOME_LONGITUDE + east / eastward) * 1e7),
        round(-1000.0 * down),
    )


@compiled
def _to_body(q, x, y, z):  # type: ignore[no-untyped-def]
    """Rotate a vector from earth to body axes."""
    w, a, b, c = q[0], q[1], q[2], q[3]
    return (
        (1 - 2 * (b * b + c * c)) * x + 2 * (a * b + w * c) * y + 2 * (a * c - w * b) * z,
        2 * (a * b - w * c) * x + (1 - 2 * (a * a + c * c)) * y + 2 * (b * c + w * a) * z,
        2 * (a * c + w * b) * x + 2 * (b * c - w * a) * y + (1 - 2 * (a * a + b * b)) * z,
    )


@compiled
def _read(state, before, Ts, errors, out):  # type: ignore[no-untyped-def]
    """Fill `out` (15,), see `ImuBaroGps.read`.

    `before` is the state one period ago: an accelerometer reports the mean force between two samples, which includes
    the ground contact. `errors` holds biases (9,), standard deviations (9,) and standard normal numbers (10,).
    """
    biases, deviations, noise = errors
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
    out[6], out[7], out[8] = _to_body(state[6:10], EARTH_FIELD[0], EARTH_FIELD[1], EARTH_FIELD[2])
    for i in range(9):
        out[i] += biases[i] + deviations[i] * noise[i]
    for i in range(3):
        out[i] = min(max(out[i], -ACCELEROMETER_RANGE), ACCELEROMETER_RANGE)
        out[3 + i] = min(max(out[3 + i], -GYRO_RANGE), GYRO_RANGE)
    # From altitude to pressure, add noise, and back to altitude.
    base = max(1.0 + PRESSURE_LAPSE * state[2], MIN_PRESSURE_BASE)
    pressure = SEA_LEVEL_PRESSURE * base**PRESSURE_EXPONENT + BAROMETER_NOISE * noise[9]
    out[9] = pressure
    out[10] = (1.0 - (pressure / SEA_LEVEL_PRESSURE) ** (1.0 / PRESSURE_EXPONENT)) / PRESSURE_LAPSE
    out[11] = SEA_LEVEL_TEMPERATURE + LAPSE * state[2]


class ImuBaroGps:
    """The raw sensors of one vehicle.

    Parameters
    ----------
    state : (13 + n,) array
        Initial state, see `sitl.physics.rigid_body`.
    Ts : float, s
        Interval between readings.
    seed : int
        Seed of noise and biases.
    noise : bool
        False: all but the barometer and the GPS are exact.
    """

    def __init__(self, state: NDArray[np.float64], Ts: float, seed: int, noise: bool = True) -> None:
        self.Ts = Ts
        self._generator, self._gps_generator = (np.random.default_rng([seed, which]) for which in (1, 2))
        bandwidth = math.sqrt(0.5 / Ts)
        deviations = ACCELEROMETER_DENSITY * bandwidth, GYRO_DENSITY * bandwidth, MAGNETOMETER_NOISE
        self.deviations = np.repeat(deviations, 3) * noise
        spread = np.repeat((ACCELEROMETER_BIAS, GYRO_BIAS, MAGNETOMETER_BIAS), 3)
        self.biases = noise * spread * np.clip(self._generator.standard_normal(9), -2.0, 2.0)
        self.before = state.copy()
        self.out = np.zeros(READINGS)

    def read(self, state: NDArray[np.float64]) -> list[float]:
        """Read all sensors but the GPS at the end of a period.

        Returns
        -------
        list of 15
            Specific force (3, m/s^2), rates (3, rad/s) and magnetic field (3, Gauss) in body axes; pressure (hPa),
            pressure altitude (m), temperature (deg C); and the true acceleration (3, m/s^2, body axes).
        """
        noise = self._generator.standard_normal(SENSOR_NOISES)
        _read(state, self.before, self.Ts, (self.biases, self.deviations, noise), self.out)
        self.before[:] = state
        readings: list[float] = self.out.tolist()
        return readings

    def fix(self, state: NDArray[np.float64]) -> GpsFix:
        """Fix of the GPS receiver."""
        deviations = (GPS_HORIZONTAL, GPS_HORIZONTAL, GPS_VERTICAL, GPS_SPEED, GPS_SPEED, GPS_SPEED)
        x, y, z, north, east, down = (state[:6] + deviations * self._gps_generator.standard_normal(6)).tolist()
        speed = math.hypot(north, east)
        course = round(math.degrees(math.atan2(east, north)) * 100) % 36000
        return GpsFix(global_position(x, y, z), centi(speed), centi(north), centi(east), centi(down), course)


def centi(value: float) -> int:
    """Convert to hundredths, clipped to 16 bits."""
    return max(-32768, min(32767, round(value * 100)))
