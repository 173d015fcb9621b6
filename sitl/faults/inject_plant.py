"""Applies faults during a flight: to the plant, to the link, and through `AutopilotFaults` to the controller.

A flight is cut into segments in which nothing changes. Before each segment, the faults of that time are applied to the
healthy vehicle. A flight in process (long segments) and a plant process (one period at a time) use the same code and
the same random numbers.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mimopilot.sitl.autopilot.autopilot import Autopilot
from mimopilot.sitl.errors import SitlError
from mimopilot.sitl.faults.inject_autopilot import AutopilotFaults
from mimopilot.sitl.faults.kinds import Fault, periods
from mimopilot.sitl.physics.airframe import Airframe, PointMass, combine_masses
from mimopilot.sitl.physics.rigid_body import COMMAND_HISTORY
from mimopilot.sitl.physics.simulated_plant import SimulatedPlant

FAULT_STREAM = 0x6661  # arbitrary; separates the random numbers of faults from the noise of the same seed


class FaultInjection:
    """The faults of one flight.

    Parameters
    ----------
    faults : sequence of Fault
        They may overlap.
    airframe : Airframe
        The vehicle.
    plant : SimulatedPlant
        Its plant, sensors and delay, as they are now, are the healthy ones; they are replaced, never written into.
    Ts : float, s
        Control period.
    seed : int or sequence of int
        Of lost and duplicated measurements and of jitter; each fault has its own numbers.
    autopilot : Autopilot, optional
        When the controller is in this process; its gains, as they are now, are the healthy ones.
    seconds : float, optional
        Length of the flight, when it is known.

    Raises
    ------
    SitlError
        When a fault is not possible on this vehicle or in this flight.
    """

    def __init__(
        self,
        faults: Sequence[Fault],
        airframe: Airframe,
        plant: SimulatedPlant,
        Ts: float,
        seed: int | Sequence[int],
        *,
        autopilot: Autopilot | None = None,
        seconds: float | None = None,
    ) -> None:
        for fault in faults:
            check_fault(fault, airframe, Ts, seconds)
        self.faults, self.Ts, self.plant = tuple(faults), Ts, plant
        self.spans = [fault.span(Ts) for fault in faults]
        self.generators = [
            np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(FAULT_STREAM, i))) for i in range(len(faults))
        ]
        self._healthy_plant, self._healthy_sensors, self._healthy_delay = plant.plant, plant.sensors, plant.delay
        self._centre = airframe.geometry()[0][0] - plant.plant.rotors[0]  # of gravity, from the reference point, m
        self.autopilot_faults = AutopilotFaults(faults, Ts, autopilot)
        self._arrivals: dict[int, int] = {}  # period -> the newest command that arrives in it
        self._newest = plant.count - plant.delay  # the newest command that has arrived
        self._changes = self.autopilot_faults.changes.union(*map(self._plant_changes, faults, self.spans))

    def segments(
        self, start: int, stop: int
    ) -> Iterator[tuple[slice, NDArray[np.int64] | None, NDArray[np.int64] | None]]:
        """Cut the periods from `start` to `stop` where a fault changes, and apply the change before each segment.

        Segments must be flown in order, each before the next is requested.

        Yields
        ------
        segment : slice
        runs, delays : (n,) arrays or None
            For `sitl.flight.simulator.Simulator.fly`.
        """
        cuts = [start, *sorted(k for k in self._changes if start < k < stop), stop]
        for a, b in itertools.pairwise(cuts):
            if a in self._changes:
                self._apply(a)
            yield slice(a, b), self._runs(a, b), self._delays(a, b)

    def setpoints(self, setpoint: NDArray[Any]) -> NDArray[Any]:
        """See `AutopilotFaults.setpoints`."""
        return self.autopilot_faults.setpoints(setpoint)

    def clock_back(self, k: int) -> float:
        """Seconds by which the clock has been set back up to period `k`."""
        return sum(
            fault.magnitude
            for fault, (begin, _) in zip(self.faults, self.spans, strict=True)
            if fault.kind == "clock" and begin <= k
        )

    def _active(self, k: int) -> Iterator[tuple[Fault, int]]:
        """Faults of period `k`, each with the period in which it begins."""
        for fault, (begin, end) in zip(self.faults, self.spans, strict=True):
            if begin <= k < end:
                yield fault, begin

    def _plant_changes(self, fault: Fault, span: tuple[int, int]) -> Iterator[int]:
        """Periods before which a fault changes the plant."""
        if fault.place == "plant":
            yield from span
            if fault.kind == "battery" and fault.duration is not None:
                yield from range(span[0], span[0] + periods(fault.duration, self.Ts) + 1)

    def _apply(self, k: int) -> None:
        """Apply the faults of period `k` to the plant and to the controller."""
        sensors = self._healthy_sensors
        bias, stuck, failed = sensors.bias.copy(), sensors.stuck.copy(), sensors.failed.copy()
        rate_deviation = sensors.rate_deviation
        effectiveness = self._healthy_plant.effectiveness.copy()
        loads: list[Fault] = []
        for fault, begin in self._active(k):
            match fault.kind:
                case "motor":
                    effectiveness[fault.motors] *= fault.magnitude
                case "battery":
                    effectiveness *= self._battery(fault, k - begin)
                case "mass":
                    loads.append(fault)
                case "gyro-bias":
                    bias[fault.axes] += fault.magnitude
                case "gyro-noise":
                    rate_deviation = fault.magnitude
                case "gyro-stuck":
                    stuck[fault.axes] = True
                case "gyro-nan":
                    failed[fault.axes] = True
        self.plant.sensors = sensors._replace(rate_deviation=rate_deviation, bias=bias, stuck=stuck, failed=failed)
        self.plant.plant = self.plant.plant._replace(effectiveness=effectiveness)
        if any(fault.kind == "mass" for fault in self.faults):
            self._attach(loads)
        self.autopilot_faults.apply(k)

    def _battery(self, fault: Fault, since: int) -> float:
        """Remaining share of the thrust, `since` periods after the sag began."""
        ramp = 0 if fault.duration is None else periods(fault.duration, self.Ts)
        return 1.0 - (1.0 - fault.magnitude) * (1.0 if since >= ramp else since / ramp)

    def _attach(self, loads: list[Fault]) -> None:
        """Attach the loads to the healthy body. They move with it, so position and velocity of each point stay."""
        simulated, healthy = self.plant, self._healthy_plant
        positions = (np.array(load.position) - self._centre for load in loads)
        attached = tuple(
            PointMass(mass=load.magnitude, position=(x, y, z)) for load, (x, y, z) in zip(loads, positions, strict=True)
        )
        mass, centre, inertia = combine_masses(healthy.mass, healthy.inertia, attached)
        rotors = np.ascontiguousarray(healthy.rotors - centre)
        shift = simulated.plant.rotors[0] - rotors[0]
        simulated.plant = simulated.plant._replace(
            mass=mass, inertia=inertia, inertia_inverse=np.linalg.inv(inertia).astype(np.float64), rotors=rotors
        )
        state = simulated.state
        w, v, rates = state[6], state[7:10], state[10:13]
        # The state is that of the centre of gravity: move it by the shift, rotated into earth axes.
        for vector, target in ((shift, state[0:3]), (np.cross(rates, shift), state[3:6])):
            target += vector + 2 * np.cross(v, np.cross(v, vector) + w * vector)

    def _runs(self, start: int, stop: int) -> NDArray[np.int64] | None:
        """How often the autopilot runs in each period, (n,); None: once in each."""
        # A plant process sets its clock back instead, and the autopilot at the other end of the link finds out.
        kinds = ("loss", "duplicate", "skip", "link", *(() if self.autopilot_faults.autopilot is None else ("clock",)))
        runs = None
        for fault, span, generator in zip(self.faults, self.spans, self.generators, strict=True):
            inside = _overlap(span, start, stop)
            if inside is None or fault.kind not in kinds:
                continue
            runs = np.ones(stop - start, np.int64) if runs is None else runs
            if fault.kind in ("loss", "duplicate"):
                hit = generator.random(inside.stop - inside.start) < fault.magnitude
                runs[inside] *= np.where(hit, 0 if fault.kind == "loss" else 2, 1)
            else:
                runs[inside] = 0
        return runs

    def _delays(self, start: int, stop: int) -> NDArray[np.int64] | None:
        """Age of the command that acts in each period, (n,): the newest of those that have arrived."""
        if not any(fault.kind in ("delay", "jitter") for fault in self.faults):
            return None
        late = np.full(stop - start, self._healthy_delay)
        for fault, span, generator in zip(self.faults, self.spans, self.generators, strict=True):
            inside = _overlap(span, start, stop)
            if inside is None:
                continue
            if fault.kind == "delay":
                late[inside] = periods(fault.magnitude, self.Ts)
            elif fault.kind == "jitter":
                choices = periods(fault.magnitude, self.Ts) + 1
                late[inside] += (choices * generator.random(inside.stop - inside.start)).astype(np.int64)
        ages = np.empty_like(late)
        for i, k in enumerate(range(start, stop)):
            due = k + int(late[i])
            self._arrivals[due] = max(self._arrivals.get(due, k), k)
            self._newest = max(self._newest, self._arrivals.pop(k, self._newest))
            ages[i] = min(k - self._newest, COMMAND_HISTORY - 1)  # older commands are not kept
        return ages


def _overlap(span: tuple[int, int], start: int, stop: int) -> slice | None:
    """The part of a span within a segment, counted from the start of the segment; None: none."""
    begin, end = max(span[0], start), min(span[1], stop)
    return slice(begin - start, end - start) if begin < end else None


def check_fault(fault: Fault, airframe: Airframe, Ts: float, seconds: float | None) -> None:
    """Refuse a fault that this vehicle cannot have, or that begins after the flight.

    Raises
    ------
    SitlError
        With the fault and what was expected.
    """
    where, rotors = f"fault {str(fault)!r}", len(airframe.rotors)
    if fault.motor is not None and fault.motor > rotors:
        raise SitlError(f"{where}: {airframe.name} has motors 1 to {rotors}")
    if seconds is not None and periods(fault.at, Ts) >= periods(seconds, Ts):
        raise SitlError(f"{where}: begins at {fault.at:g} s, but the flight ends at {seconds:g} s")
    if fault.kind in ("delay", "jitter"):
        # Half of the history: a delay and a jitter may add up.
        longest = (COMMAND_HISTORY // 2 - 1 - airframe.computing_delay) * Ts
        if fault.magnitude > longest:
            raise SitlError(f"{where}: size: expected at most {longest:g} s at a period of {Ts:g} s")
