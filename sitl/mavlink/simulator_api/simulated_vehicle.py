"""The simulated vehicle behind a simulator protocol: sensors and messages out, motor commands in, period by period.

It has no sockets and no clock: see `sitl.mavlink.simulator_api.plant_server`, `sitl.mavlink.simulator_api.hitl` and
`sitl.mavlink.simulator_api.json_server`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray
from pymavlink.dialects.v20 import common as mavlink

from mimopilot.sitl.faults.inject_plant import FaultInjection
from mimopilot.sitl.faults.kinds import Fault
from mimopilot.sitl.flight.simulator import Simulator
from mimopilot.sitl.mavlink.wire.codec import SYSTEM
from mimopilot.sitl.mavlink.wire.fast_codec import ARMED, GPS, SENSOR, STATE, FastCodec
from mimopilot.sitl.physics.airframe import Airframe
from mimopilot.sitl.physics.ground_contact import apply_ground_contact, ground_state
from mimopilot.sitl.physics.imu_baro_gps import (
    FIX_3D,
    GPS_EPH,
    GPS_EPV,
    GPS_PERIOD,
    SATELLITES,
    ImuBaroGps,
    centi,
    global_position,
)
from mimopilot.sitl.physics.rigid_body import COMMAND_HISTORY, GRAVITY, MAX_ROTORS

NOISE_BLOCK = 250  # periods of sensor noise drawn at once: one second at 250 Hz
EPOCH_US = 1_000_000  # us, start of the simulated clock: autopilots treat time zero as "no time"
INERTIAL = 7 | 56  # HIL_SENSOR.fields_updated: accelerometer, gyro
MAG_AND_BARO = 448 | 6656  # HIL_SENSOR.fields_updated: magnetometer; absolute pressure, pressure altitude, temperature
MAG_AND_BARO_PERIOD = 0.02  # s, 50 Hz; typical of such sensors
MAX_CATCH_UP_S = 0.25  # s; chosen: a simulation that is later than this does not catch up
HARD_LANDING = 3.0  # m/s; chosen: a fall from 0.46 m
MAX_LANDING_TILT = 60.0  # deg; chosen: beyond it the vehicle tips over

Report = Callable[[str], None]


class SimulatedVehicle:
    """A vehicle with its sensors, on the ground or in the air.

    Parameters
    ----------
    airframe : Airframe
        The vehicle.
    Ts : float, s
        Control period.
    seed : int
        Seed of all noise.
    altitude : float, m
        Initial hover altitude; 0: on the ground, rotors stopped.
    report : callable
        Called with each message for the user.
    faults : sequence of Fault
        Faults to inject, in seconds from the first answer of an autopilot.
    sensor_noise : bool
        False: accelerometer and gyro are exact, for an autopilot that adds noise itself.

    Attributes
    ----------
    copies : int
        How often the current messages reach the autopilot: 0 when lost, 2 when duplicated.
    periods : int
        Periods counted by the simulated clock.
    flown : int
        Periods flown, from the first answer.
    crashed : bool
        Whether the vehicle lies on the ground with stopped motors.
    codec : FastCodec
        Of the plant's end of the link.
    """

    def __init__(
        self,
        airframe: Airframe,
        Ts: float,
        seed: int,
        altitude: float,
        report: Report,
        faults: Sequence[Fault] = (),
        sensor_noise: bool = True,
    ) -> None:
        self.airframe, self.Ts, self.seed, self.altitude, self.report = airframe, Ts, seed, altitude, report
        self.faults, self.sensor_noise = faults, sensor_noise
        self.rotors = len(airframe.rotors)
        self.restart()
        # Compile what each period calls, so that the first frames are on time.
        self.pack_messages()
        self.fly([0.0] * MAX_ROTORS, ARMED)
        apply_ground_contact(ground_state(self.simulator.plant), self.simulator.plant, Ts)
        self.restart()

    def restart(self) -> None:
        """Reset the vehicle to its start; every flight from there is the same."""
        self.simulator = Simulator(self.airframe, self.Ts, self.seed, altitude=self.altitude)
        if self.altitude == 0:
            self.simulator.state[:] = ground_state(self.simulator.plant)
            self.simulator.history[:] = 0.0
        self.mag_and_baro_every = max(1, round(MAG_AND_BARO_PERIOD / self.Ts))
        self.fix_every = max(1, round(GPS_PERIOD / self.Ts))
        self.instruments = ImuBaroGps(self.simulator.state, self.Ts, self.seed, self.sensor_noise)
        self.injection = FaultInjection(self.faults, self.airframe, self.simulator, self.Ts, self.seed)
        self.codec = FastCodec(SYSTEM, mavlink.MAV_COMP_ID_USER1)
        self.periods = self.flown = 0
        self.crashed = self.nonfinite_reported = False
        self.copies, self.gyro = 1, [0.0, 0.0, 0.0]
        self._measure()

    def change_period(self, Ts: float) -> None:
        """Fly on with another control period, s; motion, time and faults stay.

        Raises
        ------
        SitlError
            When a filter of the airframe does not run at this period; the vehicle is then lost.
        """
        before, seconds, crashed = self.simulator, self.seconds, self.crashed
        self.Ts = Ts
        self.restart()
        after, self.flown, self.crashed = self.simulator, round(seconds / Ts), crashed
        for _ in self.injection.segments(1, self.flown + 1):  # the faults so far, in order
            pass
        after.state[:] = self.instruments.before[:] = before.state
        after.history[:] = before.history[(before.count - 1) % COMMAND_HISTORY]
        after.count = self.flown
        after.sensors.bend[:] = before.sensors.bend

    @property
    def stamp(self) -> int:
        """The simulated clock, us."""
        return EPOCH_US + round((self.periods * self.Ts - self.injection.clock_back(self.flown)) * 1e6)

    @property
    def seconds(self) -> float:
        """Flight time, s of simulated time."""
        return self.flown * self.Ts

    def _measure(self) -> None:
        if self.faults:
            self._inject_faults()
        if self.flown % NOISE_BLOCK == 0:
            self.noise = self.simulator.noise(NOISE_BLOCK)
        self.simulator.measure(self.noise[self.flown % NOISE_BLOCK])

    def _inject_faults(self) -> None:
        """Inject the faults of this period into the vehicle and into its link."""
        for _, runs, delays in self.injection.segments(self.flown, self.flown + 1):
            self.copies = 1 if runs is None else int(runs[0])
            if delays is not None:
                self.simulator.delay = int(delays[0])

    def hold(self) -> None:
        """Let a period pass without flying: clock and sensors run, the vehicle stays where it is."""
        self.periods += 1

    def fly(self, controls: Sequence[float], mode: int) -> None:
        """Fly one period under HIL_ACTUATOR_CONTROLS: thrust fractions and the autopilot's mode bits."""
        commands = np.zeros(MAX_ROTORS, np.float32)
        if not self.crashed and mode & ARMED:
            used = controls[: self.rotors]
            commands[: self.rotors] = used
            if not math.isfinite(sum(used)):
                self._stop_nonfinite(commands)
        simulator = self.simulator
        simulator.advance(commands)
        speed = apply_ground_contact(simulator.state, simulator.plant, self.Ts)
        if speed >= 0.0:
            self._check_landing(speed)
        self.periods += 1
        self.flown += 1
        self._measure()

    def _stop_nonfinite(self, commands: NDArray[np.float32]) -> None:
        commands[~np.isfinite(commands)] = 0.0
        if not self.nonfinite_reported:
            self.nonfinite_reported = True
            self.report("the autopilot sent motor commands that are not finite; those motors stop")

    def _check_landing(self, speed: float) -> None:
        """Report a crash, at a touchdown speed in m/s; the motors then stay stopped until `restart`."""
        x, y = self.simulator.state[7:9]
        level = 1 - 2 * (x * x + y * y)
        if self.crashed or (speed <= HARD_LANDING and level >= math.cos(math.radians(MAX_LANDING_TILT))):
            return
        self.crashed = True
        tilt = math.degrees(math.acos(min(1.0, max(-1.0, level))))
        self.report(
            f"crashed at {self.seconds:.2f} s of flight: touchdown at {speed:.1f} m/s (at most {HARD_LANDING:g}), "
            f"tilted by {tilt:.0f} deg (at most {MAX_LANDING_TILT:g}); motors stopped until an autopilot restarts"
        )

    def _inject_gyro_faults(self, rates: list[float]) -> list[float]:
        """Gyro reading under the faults, rad/s: biased, stuck or failed."""
        sensors = self.simulator.sensors
        biased = rates + sensors.bias
        self.gyro = np.where(sensors.failed, np.nan, np.where(sensors.stuck, self.gyro, biased)).tolist()
        return self.gyro

    def read_sensors(self) -> list[float]:
        """Read all sensors but the GPS, once in a period: see `ImuBaroGps.read`; with the frame's bend and faults."""
        readings = self.instruments.read(self.simulator.state)
        for i in range(2):
            readings[3 + i] += float(self.simulator.sensors.bend[i, 1])
        if self.faults:
            readings[3:6] = self._inject_gyro_faults(readings[3:6])
        return readings

    def pack_messages(self, estimate: bool = True) -> bytes:
        """Read the sensors, and pack HIL_SENSOR, HIL_GPS when due and, with `estimate`, HIL_STATE_QUATERNION."""
        stamp, state = self.stamp, self.simulator.state
        readings = self.read_sensors()
        fields = INERTIAL | (MAG_AND_BARO if self.periods % self.mag_and_baro_every == 0 else 0)
        data = self.codec.pack(SENSOR, stamp, *readings[:10], 0.0, *readings[10:12], fields, 0)
        if self.periods % self.fix_every == 0:
            fix = self.instruments.fix(state)
            motion = (fix.speed, fix.north, fix.east, fix.down, fix.course)
            data += self.codec.pack(GPS, stamp, *fix.position, GPS_EPH, GPS_EPV, *motion, FIX_3D, SATELLITES, 0, 0)
        if estimate:
            seen = self.simulator.measurement.tolist()
            x, y, z, vx, vy = state[:5].tolist()
            latitude, longitude, _ = global_position(x, y, z)
            acceleration = (centi(10.0 * a / GRAVITY) for a in readings[12:])
            place_and_speed = (latitude, longitude, int(seen[7]), centi(vx), centi(vy), int(-seen[8]))
            data += self.codec.pack(STATE, stamp, *seen[:7], *place_and_speed, 0, 0, *acceleration)
        return data
