"""The in-process flight: plant, sensors and autopilot in one compiled loop."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from mimopilot.sitl.autopilot.autopilot import RECORD, Autopilot, tick
from mimopilot.sitl.faults.inject_plant import Injection
from mimopilot.sitl.flight.scenario import Scenario
from mimopilot.sitl.physics.airframe import Airframe
from mimopilot.sitl.physics.compiled import compiled
from mimopilot.sitl.physics.rigid_body import HISTORY, ROTORS, STEP, advance, hover_state
from mimopilot.sitl.physics.state_estimate import NOISES, SIZE, Sensors, euler_angles, frame_mode, low_pass, measure
from numpy.typing import NDArray

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
    record : (N,) array of `sitl.autopilot.autopilot.RECORD`
        What the autopilot saw and did.
    truth : (N,) array of `TRUTH`
        What the plant did.
    runs : (N,) array, optional
        How often the autopilot ran in each period; by default once.
    """

    scenario: Scenario
    record: NDArray[Any]
    truth: NDArray[Any]
    runs: NDArray[np.int64] | None = None

    @property
    def crashed_at(self) -> float | None:
        """Time (s) of the loss: more than 60 degrees for 0.3 s, the ground, or a value that is not finite."""
        first = first_loss(self.truth, self.record, self.scenario.Ts)
        return None if first < 0 else float(first * self.scenario.Ts)


def first_loss(truth: NDArray[Any], record: NDArray[Any], Ts: float) -> int:
    """Sample at which the vehicle counts as lost, see `Flight.crashed_at`; -1: it is not.

    Parameters
    ----------
    truth, record : (N,) arrays of `TRUTH` and of `sitl.autopilot.autopilot.RECORD`
        What the plant and what the autopilot did.
    Ts : float, s
        Control period.
    """
    samples = max(1, round(CRASH_SECONDS / Ts))
    return int(_first_loss(truth["attitude"], truth["position"], record["moment"], samples))


@compiled
def _first_loss(attitude, position, moment, samples):  # type: ignore[no-untyped-def]
    run = 0
    for k in range(attitude.shape[0]):
        roll, pitch = attitude[k, 0], attitude[k, 1]
        tilted = not (abs(roll) <= CRASH_ANGLE and abs(pitch) <= CRASH_ANGLE)
        finite = np.isfinite(roll) and np.isfinite(pitch)
        for i in range(3):
            finite = finite and np.isfinite(moment[k, i])
        run = run + 1 if tilted else 0
        if run >= samples or not finite or position[k, 2] > 0.0:
            return k
    return -1


@compiled
def _hold(before, row):  # type: ignore[no-untyped-def]
    """A period that the autopilot did not see: everything stays as it was."""
    for i in range(4):
        row.quaternion[i] = before.quaternion[i]
    for i in range(3):
        row.attitude[i], row.rates[i] = before.attitude[i], before.rates[i]
        row.rates_setpoint[i], row.moment[i] = before.rates_setpoint[i], before.moment[i]
        row.unallocated[i] = before.unallocated[i]
    for i in range(row.commands.shape[0]):
        row.commands[i] = before.commands[i]
    row.collective, row.fault = before.collective, before.fault


@compiled
def _fly(plant, state, steps, step, sensors, seen, autopilot, link, count, history, noise, record, truth):  # type: ignore[no-untyped-def]
    step_address, controller, controls, outputs, allocation, hover, altitude = autopilot
    runs, delays, before = link
    n = allocation.mixer.shape[0]
    for k in range(record.shape[0]):
        row, true = record[k], truth[k]
        measure(state, noise[k], sensors, seen)
        if runs[k] == 0:
            _hold(before, row)
        for _ in range(runs[k]):
            tick(step_address, controller, controls, outputs, allocation, hover, altitude, seen, row)
        before = row
        roll, pitch, yaw = euler_angles(state[6], state[7], state[8], state[9])
        true.attitude[0], true.attitude[1], true.attitude[2] = roll, pitch, yaw
        for i in range(3):
            true.position[i], true.velocity[i], true.rates[i] = state[i], state[3 + i], state[10 + i]
        for i in range(n):
            history[(count + k) % HISTORY, i] = row.commands[i]
        advance(state, history[(count + k - delays[k]) % HISTORY], plant, steps, step)


class Simulator:
    """The plant of one vehicle with its sensors; what a fault changes is an attribute.

    Parameters
    ----------
    airframe : Airframe
        The vehicle.
    Ts : float, s
        Control period.
    seed : int or sequence of int
        Of the measurement noise.
    noise : bool
        False: exact measurements.
    altitude : float, m
        Where it starts, hovering.

    Attributes
    ----------
    plant : PlantParameters
        What flies; may be replaced between periods.
    state : (13 + n,) array
        See `sitl.physics.rigid_body`.
    sensors : Sensors
        May be replaced between periods.
    delay : int, samples
        Whole control periods between a measurement and the motor command made from it.
    """

    def __init__(
        self, airframe: Airframe, Ts: float, seed: int | list[int], noise: bool = True, altitude: float = 10.0
    ) -> None:
        self.plant = airframe.plant()
        self.steps = max(1, int(np.ceil(Ts / STEP - 1e-9)))
        self.step = Ts / self.steps
        self.delay = airframe.computing_delay
        self.history = np.zeros((HISTORY, RECORD["commands"].shape[0]), np.float32)
        self.generator = np.random.default_rng(seed)
        scale = 1.0 if noise else 0.0
        gyro = low_pass(airframe.gyro_cutoff_hz, Ts)
        frame = np.zeros(7)
        if (mode := airframe.frame) is not None:
            frame = np.append(frame_mode(mode.frequency_hz, mode.damping, mode.gain, Ts), 1 / Ts)
        self.sensors = Sensors.sound(scale * airframe.noise.angle, scale * airframe.noise.rate, gyro, frame)
        self.seen = np.zeros(SIZE)
        self.before: NDArray[Any] = np.zeros(1, RECORD)
        self.restart(hover_state(self.plant, altitude))

    def restart(self, state: NDArray[np.float64]) -> None:
        """Begin a flight in a state (13 + n,), its rotors turning as they were told to; nothing is left of the last."""
        self.state = state
        self.history[:] = state[ROTORS] ** 2 * self.plant.thrust_coefficient / self.plant.thrust_max
        self.count = 0
        self.seen[:], self.before[:] = 0, np.zeros(1, RECORD)
        self.sensors.restart(state[10:13])

    def noise(self, samples: int) -> NDArray[np.float64]:
        """The next standard normal numbers of the noise, (samples, 6); the same whatever the block size."""
        return self.generator.standard_normal((samples, NOISES))

    def measure(self, noise: NDArray[np.float64]) -> NDArray[np.float64]:
        """What the autopilot is told now, see `sitl.physics.state_estimate`; `noise` is one row of `noise`."""
        measure(self.state, noise, self.sensors, self.seen)
        return self.seen

    def advance(self, commands: NDArray[np.float32]) -> None:
        """Fly one control period; (16,) thrust fractions, which act after the delay."""
        self.history[self.count % HISTORY] = commands
        applied = self.history[(self.count - self.delay) % HISTORY]
        advance(self.state, applied, self.plant, self.steps, self.step)
        self.count += 1

    def fly(
        self,
        autopilot: Autopilot,
        noise: NDArray[np.float64],
        record: NDArray[Any],
        truth: NDArray[Any],
        runs: NDArray[np.int64] | None = None,
        delays: NDArray[np.int64] | None = None,
    ) -> None:
        """Fly consecutive control periods under an autopilot.

        Parameters
        ----------
        autopilot : Autopilot
            Its controller's state is carried on from where it is.
        noise : (N, 6) array
            From `noise`.
        record : (N,) array of `sitl.autopilot.autopilot.RECORD`
            Set-points and excitation are given, the rest is filled.
        truth : (N,) array of `TRUTH`
            Filled.
        runs : (N,) array, optional
            How often the autopilot runs in each period: 0 when the measurement is lost; by default once.
        delays : (N,) array, samples, optional
            From each measurement to the motors, below `HISTORY`; by default `delay`.
        """
        samples = len(record)
        link = (
            np.ones(samples, np.int64) if runs is None else runs,
            np.full(samples, self.delay) if delays is None else delays,
            self.before[0],
        )
        _fly(
            self.plant,
            self.state,
            self.steps,
            self.step,
            self.sensors,
            self.seen,
            autopilot.arguments(),
            link,
            self.count,
            self.history,
            noise,
            record,
            truth,
        )
        self.count += samples
        self.before[0] = record[-1]


def fly(airframe: Airframe, autopilot: Autopilot, scenario: Scenario, seed: int = 0, noise: bool = True) -> Flight:
    """Fly a scenario with its faults, starting from hover.

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

    Raises
    ------
    SitlError
        When a fault is not possible on this vehicle or in this flight.
    """
    samples = len(scenario.setpoint)
    simulator = Simulator(airframe, scenario.Ts, seed, noise, autopilot.altitude)
    injection = Injection(scenario.faults, airframe, simulator, scenario.Ts, seed, autopilot, samples * scenario.Ts)
    record, truth, runs = np.zeros(samples, RECORD), np.zeros(samples, TRUTH), np.ones(samples, np.int64)
    record["setpoint"], record["excitation"] = injection.setpoints(scenario.setpoint), scenario.excitation
    draws = simulator.noise(samples)
    for piece, ran, delays in injection.stretches(0, samples):
        simulator.fly(autopilot, draws[piece], record[piece], truth[piece], ran, delays)
        runs[piece] = 1 if ran is None else ran
    return Flight(scenario, record, truth, runs)
