"""Applying faults to a flight while it goes on: to the plant, to the link, to the controller.

A flight is cut into stretches over which nothing changes; before each, what the faults of that time make of the sound
vehicle is put into the simulator and the controller. The same serves a flight in process, in long stretches, and a
plant process, one period at a time, with the same random numbers.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from mimopilot.sitl.errors import SitlError
from mimopilot.sitl.faults.inject_autopilot import AutopilotFaults
from mimopilot.sitl.faults.kinds import Fault, periods
from mimopilot.sitl.physics.airframe import Airframe, PointMass, combine_masses
from mimopilot.sitl.physics.rigid_body import HISTORY
from numpy.typing import NDArray

if TYPE_CHECKING:
    from mimopilot.sitl.autopilot.autopilot import Autopilot
    from mimopilot.sitl.flight.simulator import Simulator

DRAWS = 0x6661  # keeps the random numbers of faults apart from the noise of the same seed


class Injection:
    """The faults of one flight.

    Parameters
    ----------
    faults : sequence of Fault
        They may overlap.
    airframe : Airframe
        The vehicle.
    simulator : Simulator
        Its plant, sensors and delay, as they are now, are the sound ones; they are replaced, never written into.
    Ts : float, s
        Control period.
    seed : int or sequence of int
        Of lost and duplicated ticks and of jitter; each fault has its own numbers.
    autopilot : Autopilot, optional
        Whose controller it is, when it is in this process; its gains, as they are now, are the sound ones.
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
        simulator: Simulator,
        Ts: float,
        seed: int | Sequence[int],
        autopilot: Autopilot | None = None,
        seconds: float | None = None,
    ) -> None:
        for fault in faults:
            check_fault(fault, airframe, Ts, seconds)
        self.faults, self.Ts, self.simulator = tuple(faults), Ts, simulator
        self.spans = [fault.span(Ts) for fault in faults]
        self.generators = [
            np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(DRAWS, i))) for i in range(len(faults))
        ]
        self.sound, self.sensors, self.delay = simulator.plant, simulator.sensors, simulator.delay
        self.centre = airframe.geometry()[0][0] - self.sound.rotors[0]
        self.inside = AutopilotFaults(faults, Ts, autopilot)
        self.arrivals: dict[int, int] = {}  # period -> the newest command that arrives in it
        self.newest = simulator.count - self.delay
        self.changes = self.inside.changes.union(*map(self._changes, faults, self.spans))

    def stretches(
        self, start: int, stop: int
    ) -> Iterator[tuple[slice, NDArray[np.int64] | None, NDArray[np.int64] | None]]:
        """Cut the periods from `start` to `stop` where something changes, and change it before each piece.

        Pieces must be flown in order, each before the next is asked for.

        Yields
        ------
        piece : slice
        runs, delays : (n,) arrays or None
            For `sitl.flight.simulator.Simulator.fly`.
        """
        cuts = [start, *sorted(k for k in self.changes if start < k < stop), stop]
        for a, b in itertools.pairwise(cuts):
            if a in self.changes:
                self._apply(a)
            yield slice(a, b), self._runs(a, b), self._delays(a, b)

    def setpoints(self, setpoint: NDArray[Any]) -> NDArray[Any]:
        """See `AutopilotFaults.setpoints`."""
        return self.inside.setpoints(setpoint)

    def clock_back(self, k: int) -> float:
        """By how many seconds the clock has gone back up to period `k`."""
        return sum(
            fault.magnitude
            for fault, (begin, _) in zip(self.faults, self.spans, strict=True)
            if fault.kind == "clock" and begin <= k
        )

    def _active(self, k: int) -> Iterator[tuple[Fault, int]]:
        """Faults of period `k`, each with the period of its begin."""
        for fault, (begin, end) in zip(self.faults, self.spans, strict=True):
            if begin <= k < end:
                yield fault, begin

    def _changes(self, fault: Fault, span: tuple[int, int]) -> Iterator[int]:
        """Periods before which something has to be changed in the plant."""
        if fault.place == "plant":
            yield from span
            if fault.kind == "battery" and fault.duration is not None:
                yield from range(span[0], span[0] + periods(fault.duration, self.Ts) + 1)

    def _apply(self, k: int) -> None:
        bias, stuck, failed = self.sensors.bias.copy(), self.sensors.stuck.copy(), self.sensors.failed.copy()
        rate_deviation = self.sensors.rate_deviation
        effectiveness = self.sound.effectiveness.copy()
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
        self.simulator.sensors = self.sensors._replace(
            rate_deviation=rate_deviation, bias=bias, stuck=stuck, failed=failed
        )
        self.simulator.plant = self.simulator.plant._replace(effectiveness=effectiveness)
        if any(fault.kind == "mass" for fault in self.faults):
            self._load(loads)
        self.inside.apply(k)

    def _battery(self, fault: Fault, since: int) -> float:
        """Share of the thrust, so many periods after the sag began."""
        ramp = 0 if fault.duration is None else periods(fault.duration, self.Ts)
        return 1.0 - (1.0 - fault.magnitude) * (1.0 if since >= ramp else since / ramp)

    def _load(self, loads: list[Fault]) -> None:
        """Put the loads on the sound body; what is attached moves with it, so no point of it is jerked."""
        simulator, sound = self.simulator, self.sound
        places = (np.array(load.position) - self.centre for load in loads)
        placed = tuple(
            PointMass(mass=load.magnitude, position=(x, y, z)) for load, (x, y, z) in zip(loads, places, strict=True)
        )
        mass, centre, inertia = combine_masses(sound.mass, sound.inertia, placed)
        rotors = np.ascontiguousarray(sound.rotors - centre)
        shift = simulator.plant.rotors[0] - rotors[0]
        simulator.plant = simulator.plant._replace(
            mass=mass, inertia=inertia, inertia_inverse=np.linalg.inv(inertia).astype(np.float64), rotors=rotors
        )
        state = simulator.state
        w, v, rates = state[6], state[7:10], state[10:13]
        for vector, place in ((shift, state[0:3]), (np.cross(rates, shift), state[3:6])):
            place += vector + 2 * np.cross(v, np.cross(v, vector) + w * vector)

    def _runs(self, start: int, stop: int) -> NDArray[np.int64] | None:
        """How often the autopilot runs in each period."""
        # A process that only has the plant sets its clock back, and the autopilot on the other end finds out.
        kinds = ("loss", "duplicate", "skip", "link", *(() if self.inside.autopilot is None else ("clock",)))
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
        """Age of the command that acts in each period: of those that have arrived, the newest."""
        if not any(fault.kind in ("delay", "jitter") for fault in self.faults):
            return None
        late = np.full(stop - start, self.delay)
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
            self.arrivals[due] = max(self.arrivals.get(due, k), k)
            self.newest = max(self.newest, self.arrivals.pop(k, self.newest))
            ages[i] = min(k - self.newest, HISTORY - 1)  # farther back nothing is kept
        return ages


def _overlap(span: tuple[int, int], start: int, stop: int) -> slice | None:
    """The part of a span within a stretch, counted from its start."""
    begin, end = max(span[0], start), min(span[1], stop)
    return slice(begin - start, end - start) if begin < end else None


def check_fault(fault: Fault, airframe: Airframe, Ts: float, seconds: float | None) -> None:
    """Refuse a fault that this vehicle cannot have, or that comes after the flight; see `Injection`."""
    where, rotors = f"fault {str(fault)!r}", len(airframe.rotors)
    if fault.motor is not None and fault.motor > rotors:
        raise SitlError(f"{where}: {airframe.name} has motors 1 to {rotors}")
    if seconds is not None and periods(fault.at, Ts) >= periods(seconds, Ts):
        raise SitlError(f"{where}: begins at {fault.at:g} s, the flight ends at {seconds:g} s")
    if fault.kind in ("delay", "jitter"):
        longest = (HISTORY // 2 - 1 - airframe.computing_delay) * Ts
        if fault.magnitude > longest:
            raise SitlError(f"{where}: size: expected at most {longest:g} s at a period of {Ts:g} s")
