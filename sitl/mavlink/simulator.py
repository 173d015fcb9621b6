"""The plant as a process of its own: PX4's simulator API over TCP, in lockstep.

The autopilot connects; each period the plant sends HIL_SENSOR and HIL_STATE_QUATERNION, waits for
HIL_ACTUATOR_CONTROLS and only then steps.
"""

from __future__ import annotations

import math
import socket
import time
from collections.abc import Iterator
from typing import Any

import numpy as np
from pymavlink.dialects.v20 import common as mavlink

from sitl.airframe import Airframe
from sitl.autopilot import MAX_ROTORS
from sitl.loop import Simulator
from sitl.mavlink.link import Codec
from sitl.plant import GRAVITY

FIRST_ANSWER_S = 0.2  # the first frame is repeated at this interval until it is answered
NOISE_BLOCK = 250
EPOCH_US = 1_000_000
HOME_LATITUDE, HOME_LONGITUDE = 473977420, 85455940  # 1e-7 deg
METRES_PER_DEGREE = 111_319.5
METRES_PER_DEGREE_EAST = METRES_PER_DEGREE * math.cos(math.radians(HOME_LATITUDE * 1e-7))
ALL_FIELDS = 7 | 56 | 448 | 6656  # accelerometer, gyro, magnetometer, barometer
EARTH_FIELD = (0.21, 0.01, 0.43)  # Gauss, NED


class PlantServer:
    """A simulated vehicle at one end of a TCP connection.

    Parameters
    ----------
    airframe : Airframe
        The vehicle.
    Ts : float, s
        Interval between frames.
    seed : int
        Of the measurement noise.
    speed : float or None
        Times real time; None: as fast as the autopilot answers.
    """

    def __init__(
        self, airframe: Airframe, Ts: float, seed: int, speed: float | None = 1.0, altitude: float = 10.0
    ) -> None:
        self.simulator = Simulator(airframe, Ts, seed, altitude=altitude)
        if altitude == 0:
            self.simulator.state[13:] = 0
            self.simulator.history[:] = 0
        self.Ts, self.speed = Ts, speed
        self.rotors = len(airframe.rotors)
        self.codec = Codec(system=1, component=mavlink.MAV_COMP_ID_USER1)
        self._warm_up(airframe, seed)

    def _warm_up(self, airframe: Airframe, seed: int) -> None:
        """Compile what each period calls now, so that the first frames come in time."""
        spare = Simulator(airframe, self.Ts, seed)
        spare.measure(spare.noise(1)[0])
        spare.advance(np.zeros(MAX_ROTORS, np.float32))

    def serve(self, connection: socket.socket) -> int:
        """Fly until the autopilot goes away; returns the number of periods."""
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        answers = self._answers(connection)
        begin = time.monotonic()
        count = 0
        while True:
            if count % NOISE_BLOCK == 0:
                noise = self.simulator.noise(NOISE_BLOCK)
            measurement = self.simulator.measure(noise[count % NOISE_BLOCK])
            frame = self._frame(count, measurement)
            try:
                connection.sendall(frame)
                connection.settimeout(FIRST_ANSWER_S if count == 0 else None)
                answer = None
                while answer is None or answer.time_usec < EPOCH_US + round(count * self.Ts * 1e6):
                    answer = next(answers)  # an answer to a repeated frame is older than this one
                    if answer is None:
                        connection.sendall(frame)
            except (StopIteration, OSError):
                return count
            self.simulator.advance(np.array(answer.controls, np.float32))
            state = self.simulator.state
            if state[2] >= 0:
                state[2] = 0
                state[5] = min(state[5], 0)
                state[3:5] = 0
                state[10:13] = 0
                state[7:9] = 0
            count += 1
            if self.speed is not None:
                ahead = begin + count * self.Ts / self.speed - time.monotonic()
                if ahead > 0:
                    time.sleep(ahead)

    def _answers(self, connection: socket.socket) -> Iterator[Any]:
        """Actuator messages as they come; None each time that the wait for one ran out."""
        while True:
            try:
                data = connection.recv(65536)
            except TimeoutError:
                yield None
                continue
            if not data:
                return
            for message in self.codec.parse(data):
                if message.get_type() == "HIL_ACTUATOR_CONTROLS":
                    yield message

    def _frame(self, count: int, measurement: Any) -> bytes:
        """One HIL_SENSOR and one HIL_STATE_QUATERNION."""
        stamp = EPOCH_US + round(count * self.Ts * 1e6)
        q = [float(v) for v in measurement[:4]]
        p, q_rate, r = (float(v) for v in measurement[4:7])
        x, y, z, vx, vy = (float(v) for v in self.simulator.state[:5])
        speeds = self.simulator.state[13:]
        lift = self.simulator.plant.thrust_coefficient * float(speeds @ speeds) / self.simulator.plant.mass
        pressure = 1013.25 * (1 + z / 44330.0) ** 5.255
        sensor = mavlink.MAVLink_hil_sensor_message(
            stamp,
            *(0.0, 0.0, -lift),
            *(p, q_rate, r),
            *_to_body(q, EARTH_FIELD),
            pressure,
            0.0,
            -z,
            20.0,
            ALL_FIELDS,
        )
        gx, gy, gz = _to_body(q, (0.0, 0.0, 1.0))
        state = mavlink.MAVLink_hil_state_quaternion_message(
            stamp,
            q,
            p,
            q_rate,
            r,
            HOME_LATITUDE + round(x / METRES_PER_DEGREE * 1e7),
            HOME_LONGITUDE + round(y / METRES_PER_DEGREE_EAST * 1e7),
            int(measurement[7]),
            _int16(vx * 100),
            _int16(vy * 100),
            _int16(-float(measurement[8])),
            0,
            0,
            _int16(gx * 1000),
            _int16(gy * 1000),
            _int16((gz - lift / GRAVITY) * 1000),
        )
        return self.codec.pack(sensor) + self.codec.pack(state)


def _int16(value: float) -> int:
    return max(-32768, min(32767, round(value)))


def _to_body(q: list[float], v: tuple[float, float, float]) -> tuple[float, float, float]:
    """An earth vector in body axes; plain floats, NumPy would cost more than the rest of the frame."""
    w, x, y, z = q
    a, b, c = v
    return (
        (1 - 2 * (y * y + z * z)) * a + 2 * (x * y + w * z) * b + 2 * (x * z - w * y) * c,
        2 * (x * y - w * z) * a + (1 - 2 * (x * x + z * z)) * b + 2 * (y * z + w * x) * c,
        2 * (x * z + w * y) * a + 2 * (y * z - w * x) * b + (1 - 2 * (x * x + y * y)) * c,
    )
