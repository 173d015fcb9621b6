"""The in-process flight: plant, sensors and autopilot in one compiled loop."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mimopilot.sitl.autopilot.autopilot import RECORD, Autopilot, tick_unpacked
from mimopilot.sitl.autopilot.failure_detector import MAX_TILT, MAX_TILT_SECONDS
from mimopilot.sitl.faults.inject_plant import FaultInjection
from mimopilot.sitl.flight.scenario import Scenario
from mimopilot.sitl.physics.airframe import Airframe
from mimopilot.sitl.physics.compiled_step import compiled
from mimopilot.sitl.physics.rigid_body import COMMAND_HISTORY, PlantParameters, advance
from mimopilot.sitl.physics.simulated_plant import SimulatedPlant
from mimopilot.sitl.physics.state_estimate import Sensors, euler_angles, measure

#: The true state at each sample.
TRUTH = np.dtype([("position", "f8", 3), ("velocity", "f8", 3), ("attitude", "f8", 3), ("rates", "f8", 3)])


@dataclass(frozen=True, eq=False)
class Flight:
    """The result of one flight.

    Attributes
    ----------
    scenario : Scenario
        The inputs.
    record : (N,) array of `sitl.autopilot.autopilot.RECORD`
        Inputs and outputs of the autopilot.
    truth : (N,) array of `TRUTH`
        True state of the plant.
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
    """Sample at which the vehicle counts as lost, see `Flight.crashed_at`; -1: it does not.

    Parameters
    ----------
    truth, record : (N,) arrays of `TRUTH` and of `sitl.autopilot.autopilot.RECORD`
        True state of the plant; inputs and outputs of the autopilot.
    Ts : float, s
        Control period.
    """
    samples = max(1, round(MAX_TILT_SECONDS / Ts))
    return int(_first_loss(truth["attitude"], truth["position"], record["moment"], samples))


@compiled
def _first_loss(attitude, position, moment, samples):  # type: ignore[no-untyped-def]
    run = 0
    for k in range(attitude.shape[0]):
        roll, pitch = attitude[k, 0], attitude[k, 1]
        tilted = not (abs(roll) <= MAX_TILT and abs(pitch) <= MAX_TILT)
        finite = np.isfinite(roll) and np.isfinite(pitch)
        for i in range(3):
            finite = finite and np.isfinite(moment[k, i])
        run = run + 1 if tilted else 0
        if run >= samples or not finite or position[k, 2] > 0.0:
            return k
    return -1


class _Body(NamedTuple):
    """The plant as the compiled loop takes it; see `SimulatedPlant`."""

    plant: PlantParameters
    state: NDArray[np.float64]
    steps: int
    step: float


class _Measuring(NamedTuple):
    """The sensors as the compiled loop takes them, and the noise (N, 6)."""

    sensors: Sensors
    measurement: NDArray[np.float64]
    noise: NDArray[np.float64]


class _TickLink(NamedTuple):
    """Runs (N,) and delays (N,) of each period, the motor commands so far, and the number of the first period."""

    runs: NDArray[np.int64]
    delays: NDArray[np.int64]
    history: NDArray[np.float32]
    first: int


@compiled
def _repeat_outputs(before, record, k):  # type: ignore[no-untyped-def]
    """Fill a period in which the autopilot did not run: all but the given inputs stay as they were."""
    setpoint, excitation = record[k].setpoint.copy(), record[k].excitation.copy()
    yaw_rate, rate_mode = record[k].yaw_rate, record[k].rate_mode
    record[k] = before
    record[k].yaw_rate, record[k].rate_mode = yaw_rate, rate_mode
    for i in range(3):
        record[k].setpoint[i], record[k].excitation[i] = setpoint[i], excitation[i]


@compiled
def _fly(body, measuring, autopilot, link, before, record, truth):  # type: ignore[no-untyped-def]
    # Unpacked once: numba counts the references of a tuple's arrays at each access.
    (step_address, state_address, inputs, outputs, allocation), collective, altitude = autopilot
    plant, state, steps, step = body
    sensors, measurement, noise = measuring
    runs, delays, history, first = link
    rotors = allocation.mixer.shape[0]
    for k in range(record.shape[0]):
        row, true = record[k], truth[k]
        measure(state, noise[k], sensors, measurement)
        if runs[k] == 0:
            _repeat_outputs(before, record, k)
        for _ in range(runs[k]):
            tick_unpacked(
                step_address, state_address, inputs, outputs, allocation, collective, altitude, measurement, row
            )
        before = row
        roll, pitch, yaw = euler_angles(state[6], state[7], state[8], state[9])
        true.attitude[0], true.attitude[1], true.attitude[2] = roll, pitch, yaw
        for i in range(3):
            true.position[i], true.velocity[i], true.rates[i] = state[i], state[3 + i], state[10 + i]
        now = first + k
        for i in range(rotors):
            history[now % COMMAND_HISTORY, i] = row.commands[i]
        advance(state, history[(now - delays[k]) % COMMAND_HISTORY], plant, steps, step)


class Simulator(SimulatedPlant):
    """A simulated plant that flies under an autopilot in this process; parameters as `SimulatedPlant`."""

    def __init__(
        self, airframe: Airframe, Ts: float, seed: int | list[int], noise: bool = True, altitude: float = 10.0
    ) -> None:
        self._before: NDArray[Any] = np.zeros(1, RECORD)
        super().__init__(airframe, Ts, seed, noise, altitude)

    def restart(self, state: NDArray[np.float64]) -> None:
        """Begin a new flight, see `SimulatedPlant.restart`."""
        super().restart(state)
        self._before[:] = np.zeros(1, RECORD)

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
            Its controller continues from its present state.
        noise : (N, 6) array
            From `noise`.
        record : (N,) array of `sitl.autopilot.autopilot.RECORD`
            Setpoints, their yaw rate and mode, and excitation are given; the rest is filled.
        truth : (N,) array of `TRUTH`
            Filled.
        runs : (N,) array, optional
            How often the autopilot runs in each period: 0 when the measurement is lost; by default once.
        delays : (N,) array, samples, optional
            From each measurement to the motors, below `COMMAND_HISTORY`; by default `delay`.
        """
        samples = len(record)
        runs = np.ones(samples, np.int64) if runs is None else runs
        delays = np.full(samples, self.delay) if delays is None else delays
        _fly(
            _Body(self.plant, self.state, self.steps, self.step),
            _Measuring(self.sensors, self.measurement, noise),
            (autopilot.loop, autopilot.hover, autopilot.altitude),
            _TickLink(runs, delays, self.history, self.count),
            self._before[0],
            record,
            truth,
        )
        self.count += samples
        self._before[0] = record[-1]


def fly(airframe: Airframe, autopilot: Autopilot, scenario: Scenario, seed: int = 0, noise: bool = True) -> Flight:
    """Fly a scenario with its faults, starting from hover.

    Parameters
    ----------
    airframe : Airframe
        The vehicle.
    autopilot : Autopilot
        A new one: its controller continues from its present state.
    scenario : Scenario
        Setpoints, excitation and faults; its period must be the controller's.
    seed : int
        Seed of the measurement noise.
    noise : bool
        False: exact measurements.

    Raises
    ------
    SitlError
        When a fault is not possible on this vehicle or in this flight.
    """
    samples, Ts = len(scenario.setpoint), scenario.Ts
    simulator = Simulator(airframe, Ts, seed, noise, autopilot.altitude)
    injection = FaultInjection(
        scenario.faults, airframe, simulator, Ts, seed, autopilot=autopilot, seconds=samples * Ts
    )
    record, truth, runs = np.zeros(samples, RECORD), np.zeros(samples, TRUTH), np.ones(samples, np.int64)
    record["setpoint"], record["excitation"] = injection.setpoints(scenario.setpoint), scenario.excitation
    if scenario.yaw_rate is not None:
        record["yaw_rate"] = scenario.yaw_rate
    if scenario.rate_mode is not None:
        record["rate_mode"] = scenario.rate_mode
    draws = simulator.noise(samples)
    for piece, ran, delays in injection.segments(0, samples):
        simulator.fly(autopilot, draws[piece], record[piece], truth[piece], ran, delays)
        runs[piece] = 1 if ran is None else ran
    return Flight(scenario, record, truth, runs)
