"""The simulated plant: body, sensors and motor commands of one vehicle, one control period at a time."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mimopilot.sitl.physics.airframe import Airframe
from mimopilot.sitl.physics.rigid_body import (
    COMMAND_HISTORY,
    MAX_ROTORS,
    ROTORS,
    RUNGE_KUTTA_STEP,
    advance,
    hover_state,
)
from mimopilot.sitl.physics.state_estimate import (
    ESTIMATE_NOISES,
    MEASUREMENT_SIZE,
    Sensors,
    frame_mode,
    low_pass,
    measure,
)


class SimulatedPlant:
    """The plant of one vehicle with its sensors. Faults replace its attributes between periods.

    Parameters
    ----------
    airframe : Airframe
        The vehicle.
    Ts : float, s
        Control period.
    seed : int or sequence of int
        Seed of the measurement noise.
    noise : bool
        False: exact measurements.
    altitude : float, m
        Initial altitude, hovering.

    Attributes
    ----------
    plant : PlantParameters
        Physical constants; may be replaced between periods.
    state : (13 + n,) array
        See `sitl.physics.rigid_body`.
    sensors : Sensors
        May be replaced between periods.
    delay : int, samples
        Whole control periods between a measurement and the motor command computed from it.
    measurement : (9,) array
        The last one, see `sitl.physics.state_estimate`.
    count : int
        Periods flown since the start.
    """

    def __init__(
        self, airframe: Airframe, Ts: float, seed: int | list[int], noise: bool = True, altitude: float = 10.0
    ) -> None:
        self.plant = airframe.plant()
        self.steps = max(1, int(np.ceil(Ts / RUNGE_KUTTA_STEP - 1e-9)))  # 1e-9: rounding of a whole quotient
        self.step = Ts / self.steps
        self.delay = airframe.computing_delay
        self.history = np.zeros((COMMAND_HISTORY, MAX_ROTORS), np.float32)
        self.generator = np.random.default_rng(seed)
        scale = 1.0 if noise else 0.0
        gyro = low_pass(airframe.gyro_cutoff_hz, Ts)
        frame = np.zeros(7)
        if (mode := airframe.frame) is not None:
            frame = np.append(frame_mode(mode.frequency_hz, mode.damping, mode.gain, Ts), 1 / Ts)
        self.sensors = Sensors.healthy(scale * airframe.noise.angle, scale * airframe.noise.rate, gyro, frame)
        self.measurement = np.zeros(MEASUREMENT_SIZE)
        self.restart(hover_state(self.plant, altitude))

    def restart(self, state: NDArray[np.float64]) -> None:
        """Begin a new flight in a state (13 + n,), the motor commands being those that keep its rotor speeds."""
        self.state = state
        self.history[:] = state[ROTORS] ** 2 * self.plant.thrust_coefficient / self.plant.thrust_max
        self.count = 0
        self.measurement[:] = 0
        self.sensors.restart(state[10:13])

    def noise(self, samples: int) -> NDArray[np.float64]:
        """Draw the next standard normal numbers of the noise, (samples, 6); the block size does not change them."""
        return self.generator.standard_normal((samples, ESTIMATE_NOISES))

    def measure(self, noise: NDArray[np.float64]) -> NDArray[np.float64]:
        """Take the measurement (9,) of this period; `noise` is one row of `noise`."""
        measure(self.state, noise, self.sensors, self.measurement)
        return self.measurement

    def advance(self, commands: NDArray[np.float32]) -> None:
        """Fly one control period; (16,) thrust fractions, which act after the delay."""
        self.history[self.count % COMMAND_HISTORY] = commands
        applied = self.history[(self.count - self.delay) % COMMAND_HISTORY]
        advance(self.state, applied, self.plant, self.steps, self.step)
        self.count += 1
