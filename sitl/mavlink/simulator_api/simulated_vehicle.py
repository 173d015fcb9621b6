"""The vehicle as an autopilot meets it over PX4's simulator API: messages out, motor commands in, one period at a time.

No sockets and no clock here: see `sitl.mavlink.simulator_api.plant_server` and `sitl.mavlink.simulator_api.hitl`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
from mimopilot.sitl.autopilot.autopilot import MAX_ROTORS
from mimopilot.sitl.faults.inject_plant import Injection
from mimopilot.sitl.faults.kinds import Fault
from mimopilot.sitl.flight.simulator import Simulator
from mimopilot.sitl.mavlink.wire.fast_codec import GPS, SENSOR, STATE, FastCodec
from mimopilot.sitl.physics.airframe import Airframe
from mimopilot.sitl.physics.ground_contact import ground_state, touch
from mimopilot.sitl.physics.imu_baro_gps import (
    FIX_3D,
    GPS_EPH,
    GPS_EPV,
    GPS_PERIOD,
    SATELLITES,
    Instruments,
    centi,
    place,
)
from mimopilot.sitl.physics.rigid_body import GRAVITY
from numpy.typing import NDArray
from pymavlink.dialects.v20 import common as mavlink

NOISE_BLOCK = 250
EPOCH_US = 1_000_000  # the simulated clock starts here: autopilots take zero for no time at all
INERTIAL, FIELD_AND_AIR = 7 | 56, 448 | 6656  # bits of fields_updated
FIELD_AND_AIR_PERIOD = 0.02  # s
FORGET_S = 0.25  # a simulation that is late by more does not race to catch up
HARD_LANDING = 3.0  # m/s, a fall from half a metre
TIPPED = math.cos(math.radians(60.0))
ARMED = mavlink.MAV_MODE_FLAG_SAFETY_ARMED

Tell = Callable[[str], None]


class SimulatedVehicle:
    """A vehicle with its instruments, on the ground or in the air.

    Parameters
    ----------
    airframe : Airframe
        The vehicle.
    Ts : float, s
        Control period.
    seed : int
        Of all noise.
    altitude : float, m
        Where it starts, hovering; 0: on the ground, with standing rotors.
    tell : callable
        Called with each thing that a user must know.
    faults : sequence of Fault
        What goes wrong, in seconds from the first answer of an autopilot.

    Attributes
    ----------
    copies : int
        How often the messages of now reach the autopilot: 0 when they are lost, 2 when they are duplicated.
    periods : int
        What the simulated clock has counted.
    codec : FastCodec
        Of the plant's end of the link.
    """

    def __init__(
        self, airframe: Airframe, Ts: float, seed: int, altitude: float, tell: Tell, faults: Sequence[Fault] = ()
    ) -> None:
        self.airframe, self.Ts, self.seed, self.altitude, self.tell = airframe, Ts, seed, altitude, tell
        self.faults = faults
        self.rotors = len(airframe.rotors)
        self.field_every = max(1, round(FIELD_AND_AIR_PERIOD / Ts))
        self.fix_every = max(1, round(GPS_PERIOD / Ts))
        self.restart()
        # Compile what each period calls now, so that the first frames come in time.
        self.messages()
        self.fly([0.0] * MAX_ROTORS, ARMED)
        touch(ground_state(self.simulator.plant), self.simulator.plant, Ts)
        self.restart()

    def restart(self) -> None:
        """Put the vehicle back at its start; what follows is the same as the first time."""
        self.simulator = Simulator(self.airframe, self.Ts, self.seed, altitude=self.altitude)
        if self.altitude == 0:
            self.simulator.state[:] = ground_state(self.simulator.plant)
            self.simulator.history[:] = 0.0
        self.instruments = Instruments(self.simulator.state, self.Ts, self.seed)
        self.injection = Injection(self.faults, self.airframe, self.simulator, self.Ts, self.seed)
        self.codec = FastCodec(1, mavlink.MAV_COMP_ID_USER1)
        self.periods = self.flown = 0
        self.lost = self.odd = False
        self.copies, self.gyro = 1, [0.0, 0.0, 0.0]
        self._measure()

    @property
    def stamp(self) -> int:
        """The simulated clock, us."""
        return EPOCH_US + round((self.periods * self.Ts - self.injection.clock_back(self.flown)) * 1e6)

    @property
    def seconds(self) -> float:
        """How long it has flown, s of simulated time."""
        return self.flown * self.Ts

    def _measure(self) -> None:
        if self.faults:
            self._break()
        if self.flown % NOISE_BLOCK == 0:
            self.noise = self.simulator.noise(NOISE_BLOCK)
        self.simulator.measure(self.noise[self.flown % NOISE_BLOCK])

    def _break(self) -> None:
        """Put the faults of this period into the vehicle and into its link."""
        for _, runs, delays in self.injection.stretches(self.flown, self.flown + 1):
            self.copies = 1 if runs is None else int(runs[0])
            if delays is not None:
                self.simulator.delay = int(delays[0])

    def stand(self) -> None:
        """Let a period pass without flying: the clock and the instruments run, the vehicle stays where it is."""
        self.periods += 1

    def fly(self, controls: Sequence[float], mode: int) -> None:
        """Fly one period under HIL_ACTUATOR_CONTROLS: thrust fractions and the autopilot's mode bits."""
        commands = np.zeros(MAX_ROTORS, np.float32)
        if not self.lost and mode & ARMED:
            used = controls[: self.rotors]
            commands[: self.rotors] = used
            if not math.isfinite(sum(used)):
                self._stop_odd(commands)
        simulator = self.simulator
        simulator.advance(commands)
        speed = touch(simulator.state, simulator.plant, self.Ts)
        if speed >= 0.0:
            self._judge_landing(speed)
        self.periods += 1
        self.flown += 1
        self._measure()

    def _stop_odd(self, commands: NDArray[np.float32]) -> None:
        commands[~np.isfinite(commands)] = 0.0
        if not self.odd:
            self.odd = True
            self.tell("motor commands that are not finite came from the autopilot; those motors stop")

    def _judge_landing(self, speed: float) -> None:
        """Tell of a crash; the vehicle lies where it is, its motors stopped, until `restart`."""
        x, y = self.simulator.state[7:9]
        level = 1 - 2 * (x * x + y * y)
        if self.lost or (speed <= HARD_LANDING and level >= TIPPED):
            return
        self.lost = True
        tilt = math.degrees(math.acos(min(1.0, max(-1.0, level))))
        self.tell(
            f"crashed at {self.seconds:.2f} s of flight: came down at {speed:.1f} m/s (at most {HARD_LANDING:g}), "
            f"tilted by {tilt:.0f} deg (at most 60); it lies there with stopped motors until an autopilot connects anew"
        )

    def _gyro(self, rates: list[float]) -> list[float]:
        """What is left of the gyro's reading."""
        sensors = self.simulator.sensors
        biased = rates + sensors.bias
        self.gyro = np.where(sensors.failed, np.nan, np.where(sensors.stuck, self.gyro, biased)).tolist()
        return self.gyro

    def messages(self, estimate: bool = True) -> bytes:
        """HIL_SENSOR, HIL_GPS when it is due and, if wanted, HIL_STATE_QUATERNION of now."""
        stamp, state = self.stamp, self.simulator.state
        readings = self.instruments.read(state)
        for i in range(2):
            readings[3 + i] += float(self.simulator.sensors.bend[i, 1])
        if self.faults:
            readings[3:6] = self._gyro(readings[3:6])
        fields = INERTIAL | (FIELD_AND_AIR if self.periods % self.field_every == 0 else 0)
        data = self.codec.pack(SENSOR, stamp, *readings[:10], 0.0, *readings[10:12], fields, 0)
        if self.periods % self.fix_every == 0:
            fix = self.instruments.fix(state)
            said = (fix.speed, fix.north, fix.east, fix.down, fix.course, FIX_3D, SATELLITES, 0, 0)
            data += self.codec.pack(GPS, stamp, *fix.place, GPS_EPH, GPS_EPV, *said)
        if estimate:
            seen = self.simulator.seen.tolist()
            x, y, z, vx, vy = state[:5].tolist()
            latitude, longitude, _ = place(x, y, z)
            acceleration = (centi(10.0 * a / GRAVITY) for a in readings[12:])
            place_and_speed = (latitude, longitude, int(seen[7]), centi(vx), centi(vy), int(-seen[8]))
            data += self.codec.pack(STATE, stamp, *seen[:7], *place_and_speed, 0, 0, *acceleration)
        return data
