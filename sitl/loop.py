"""The in-process flight: plant, sensors and autopilot in one compiled loop."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sitl.airframe import Airframe
from sitl.autopilot import RECORD, Autopilot, tick
from sitl.compiled import compiled
from sitl.plant import STEP, advance, hover_state
from sitl.scenario import Scenario
from sitl.sensors import NOISES, SIZE, euler_angles, low_pass, measure

CRASH_ANGLE = np.radians(60.0)
CRASH_SECONDS = 0.3

#: The true state at each sample.
TRUTH = np.dtype([("position", "f8", 3), ("velocity", "f8", 3), ("attitude", "f8", 3), ("rates", "f8", 3)])


@dataclass(frozen=True, eq=False)
class Flight:
    """What one flight left behind.

    Attributes
    ----------
    scenario : Scenario
        What was asked.
    record : (N,) array of `sitl.autopilot.RECORD`
        What the autopilot saw and did.
    truth : (N,) array of `TRUTH`
        What the plant did.
    """

    scenario: Scenario
    record: NDArray[Any]
    truth: NDArray[Any]

    @property
    def crashed_at(self) -> float | None:
        """Time (s) of the loss: more than 60 degrees for 0.3 s, the ground, or a value that is not finite."""
        angles = self.truth["attitude"][:, :2]
        finite = np.isfinite(angles).all(axis=1) & np.isfinite(self.record["moment"]).all(axis=1)
        grounded = self.truth["position"][:, 2] > 0
        tilted = ~(np.abs(angles) <= CRASH_ANGLE).all(axis=1)
        samples = max(1, round(CRASH_SECONDS / self.scenario.Ts))
        run = 0
        for k in range(len(tilted)):
            run = run + 1 if tilted[k] else 0
            if run >= samples or not finite[k] or grounded[k]:
                return k * self.scenario.Ts
        return None


@compiled
def _fly(plant, state, steps, step, queue, sensors, noise, autopilot, record, truth, work):  # type: ignore[no-untyped-def]
    step_address, controller, controls, outputs, allocation, hover, altitude = autopilot
    measurement = np.zeros(SIZE)
    delay = queue.shape[0]
    for k in range(record.shape[0]):
        measure(state, noise[k], sensors[0], sensors[1], sensors[2], sensors[3], measurement)
        row, true = record[k], truth[k]
        tick(step_address, controller, controls, outputs, allocation, hover, altitude, measurement, row)
        roll, pitch, yaw = euler_angles(state[6], state[7], state[8], state[9])
        true.attitude[0], true.attitude[1], true.attitude[2] = roll, pitch, yaw
        for i in range(3):
            true.position[i], true.velocity[i], true.rates[i] = state[i], state[3 + i], state[10 + i]
        if delay == 0:
            advance(state, row.commands, plant, steps, step, work)
        else:
            advance(state, queue[k % delay], plant, steps, step, work)
            queue[k % delay] = row.commands


class Simulator:
    """The plant of one vehicle with its sensors, one control period at a time.

    Parameters
    ----------
    airframe : Airframe
        The vehicle.
    Ts : float, s
        Control period.
    seed : int
        Of the measurement noise.
    noise : bool
        False: exact measurements.
    altitude : float, m
        Where it starts, hovering.
    """

    def __init__(self, airframe: Airframe, Ts: float, seed: int, noise: bool = True, altitude: float = 10.0) -> None:
        self.plant = airframe.plant()
        self.state = hover_state(self.plant, altitude)
        self.steps = max(1, int(np.ceil(Ts / STEP - 1e-9)))
        self.step = Ts / self.steps
        hover = self.state[13] ** 2 * self.plant.thrust_coefficient / self.plant.thrust_max
        self.queue = np.full((airframe.computing_delay, RECORD["commands"].shape[0]), hover, np.float32)
        self.generator = np.random.default_rng(seed)
        scale = 1.0 if noise else 0.0
        gyro = low_pass(airframe.gyro_cutoff_hz, Ts)
        self.sensors = (scale * airframe.noise.angle, scale * airframe.noise.rate, gyro, np.zeros((2, 3)))
        self.work = np.zeros((6, len(self.state)))

    def noise(self, samples: int) -> NDArray[np.float64]:
        """The next standard normal numbers of the noise, (samples, 6); the same whatever the block size."""
        return self.generator.standard_normal((samples, NOISES))


def fly(airframe: Airframe, autopilot: Autopilot, scenario: Scenario, seed: int = 0, noise: bool = True) -> Flight:
    """Fly a scenario, starting from hover.

    Parameters
    ----------
    airframe : Airframe
        The vehicle.
    autopilot : Autopilot
        A fresh one: its controller's state is carried on from where it is.
    scenario : Scenario
        Set-points and excitation; its period must be the controller's.
    seed : int
        Of the measurement noise.
    noise : bool
        False: exact measurements.
    """
    simulator = Simulator(airframe, scenario.Ts, seed, noise, autopilot.altitude)
    record = np.zeros(len(scenario.setpoint), RECORD)
    record["setpoint"], record["excitation"] = scenario.setpoint, scenario.excitation
    truth = np.zeros(len(record), TRUTH)
    _fly(
        simulator.plant,
        simulator.state,
        simulator.steps,
        simulator.step,
        simulator.queue,
        simulator.sensors,
        simulator.noise(len(record)),
        autopilot.arguments(),
        record,
        truth,
        simulator.work,
    )
    return Flight(scenario, record, truth)
