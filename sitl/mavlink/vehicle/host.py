"""The autopilot host: runs the compiled controller against a plant, and is a vehicle for ground stations."""

from __future__ import annotations

import gc
import select
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from mimopilot.sitl.autopilot.autopilot import RECORD, Autopilot, tick
from mimopilot.sitl.autopilot.flight_modes import Severity, Vehicle
from mimopilot.sitl.autopilot.vertical import Estimate
from mimopilot.sitl.errors import SitlError
from mimopilot.sitl.faults.inject_autopilot import AutopilotFaults
from mimopilot.sitl.flight.scripted_pilot import ScriptedPilot
from mimopilot.sitl.mavlink.simulator_api.plant_link import PlantLink, PlantState
from mimopilot.sitl.mavlink.simulator_api.response_times import ResponseTimes
from mimopilot.sitl.mavlink.vehicle.flight_recorder import FlightRecorder
from mimopilot.sitl.mavlink.vehicle.ground_station_link import GroundStationLink
from mimopilot.sitl.mavlink.vehicle.vehicle_state import VehicleState
from mimopilot.sitl.mavlink.wire.fast_codec import GPS, SENSOR, STATE
from mimopilot.sitl.physics.state_estimate import SIZE, euler_angles
from mimopilot.tuning.parameters import PARAMETERS
from numpy.typing import NDArray

SILENT_S = 0.9  # a plant that says nothing for so long is said to be silent
GROUND_S = 0.002  # between looks at what ground stations say; they wake nobody
NEWS_S = 0.2  # between looks at what our own plant tells
TURN_S = 0.01  # longest wait for anything
CLOCK_BACK_US = 1_000_000  # a plant whose time goes back by more has started anew
EXAMINED = 250  # periods between examinations of what forbids arming
REPEATED_S = 1.0  # the same text is told no more often

#: Moment to inject in a period, (3,); called with the vehicle's clock, s.
TorqueSource = Callable[[float], Sequence[float]]


class Host:
    """One autopilot on one plant link.

    Parameters
    ----------
    autopilot : Autopilot
        The controller and what surrounds it.
    plant : PlantLink
        Where the body is.
    log : FlightRecorder or None
        Where flights are recorded.

    Attributes
    ----------
    vehicle : Vehicle
    situation : VehicleState
        What telemetry shows.
    excitation : callable
        May be replaced.
    pilot : ScriptedPilot or None
        Flies in place of a ground station.
    faults : AutopilotFaults or None
        Of this autopilot, in seconds from the first frame of a plant.
    response_times : ResponseTimes
        How long frames of the plant wait.
    """

    def __init__(self, autopilot: Autopilot, plant: PlantLink, log: FlightRecorder | None = None) -> None:
        self.autopilot, self.plant, self.log = autopilot, plant, log
        autopilot.controls["armed"] = 0
        self.vehicle = Vehicle(autopilot.hover)
        self.vehicle.obstacles["plant"] = "no plant is connected"
        self.situation = VehicleState(self.vehicle)
        self.excitation: TorqueSource = lambda now: (0.0, 0.0, 0.0)
        self.pilot: ScriptedPilot | None = None
        self.faults: AutopilotFaults | None = None
        self.response_times = ResponseTimes()
        self.measurement = np.zeros(SIZE)
        euler_angles(*self.measurement[:4])  # compiled now, not in flight
        self.stamp = self._zero = -1
        self.rows: NDArray[Any] = np.zeros(1, RECORD)
        self.fixed = autopilot.arguments()[:5]
        self.heard = self._news = self._turn = 0.0
        self._connected = False
        self._periods = self._examined = self._first = 0
        self._told: dict[str, float] = {}

    def reboot(self) -> None:
        """Leave the plant and come back as another autopilot: it is put back at its start."""
        self.plant.drop()
        self._lose("the vehicle starts again")

    def run(self, ground: GroundStationLink) -> None:
        """Fly and serve ground stations, for ever or until `pilot` is done.

        The plant comes first, and is found again when it goes away.
        """
        gc.collect()
        gc.freeze()  # or looking through all that was imported would take 70 ms of a flight, now and then
        while self.pilot is None or not self.pilot.done:
            now = time.monotonic()
            self._connect(now)
            if self._wait():
                self._fly()
            elif self._connected and now > self.heard + SILENT_S and "plant" not in self.vehicle.obstacles:
                self.vehicle.obstacles["plant"] = f"the plant has been silent for {SILENT_S:g} s"
                self.vehicle.say(Severity.CRITICAL, self.vehicle.obstacles["plant"])
            if now >= self._turn:
                self._turn = now + GROUND_S
                ground.receive(now)
            self._pass_on(now)
            self._tell(ground, now)
            ground.send(now)

    def _pass_on(self, now: float) -> None:
        """What our own plant tells, such as a crash."""
        if self.plant.child is not None and now >= self._news:
            self._news = now + NEWS_S
            for text in self.plant.child.news():
                self.vehicle.say(Severity.WARNING, text)

    def _connect(self, now: float) -> None:
        if self._connected:
            return
        try:
            self._connected = self.plant.connect(now)
        except SitlError as error:
            self.vehicle.obstacles["plant"] = str(error)
            self.vehicle.say(Severity.CRITICAL, str(error))
        if self._connected:
            self._begin(now)

    def _begin(self, now: float) -> None:
        """A plant that may know nothing of what was before."""
        self.heard = now
        self.stamp = self._zero = -1
        self._periods = self._examined = 0
        self.situation.home = self.situation.imu = self.situation.fix = ()
        self.vehicle.plant_back()

    def _lose(self, why: str) -> None:
        self._connected = False
        self.situation.home = ()  # what was known of it holds no more
        self.vehicle.plant_lost(why)
        self._note_arming()

    def _wait(self) -> bool:
        """Wait for the plant; True when it has something to say. Ground stations wake nobody: they have their turn."""
        plants = [self.plant.socket] if self.plant.socket is not None else []
        if plants and select.select(plants, [], [], 0)[0]:
            return True
        begin = time.monotonic()
        ready = select.select(plants, [], [], TURN_S)[0]
        end = time.monotonic()
        self.response_times.nothing_waits(end - begin, end)
        return bool(ready)

    def _fly(self) -> None:
        """Answer what the plant says."""
        try:
            for kind, fields in self.plant.receive():
                if kind is STATE:
                    self._period(PlantState(*fields))
                elif kind is SENSOR:
                    self.situation.imu = fields
                elif kind is GPS:
                    self.situation.fix = fields
        except ConnectionError as error:
            self._lose(f"the plant is gone: {error}")

    def _period(self, state: PlantState) -> None:
        """One control period; a repeated time is answered, not flown."""
        self.heard = time.monotonic()
        if state.stamp < self.stamp - CLOCK_BACK_US:
            self.vehicle.plant_lost("the plant has started anew")
            self._begin(self.heard)
        elif "plant" in self.vehicle.obstacles:
            del self.vehicle.obstacles["plant"]
            self.vehicle.say(Severity.INFO, "the plant is heard again")
        if state.stamp > self.stamp:
            self.stamp = state.stamp
            self._compute(state)
        self.plant.answer(self.stamp, self.situation.row["commands"], self.vehicle.armed)
        self.response_times.answered()
        self.situation.load = self.response_times.load

    def _break(self) -> None:
        """Put the faults of now into the controller, and stop what steers."""
        assert self.faults is not None
        self._zero = self.stamp if self._zero < 0 else self._zero
        k = round(1e-6 * (self.stamp - self._zero) / self.faults.Ts)
        self.faults.apply(k)
        self.vehicle.attitude.cut = self.vehicle.sticks.cut = self.faults.stale(k)

    def _compute(self, state: PlantState) -> None:
        if self.faults is not None:
            self._break()
        state.measure(self.measurement)
        now = 1e-6 * self.stamp
        autopilot, m = self.autopilot, self.measurement
        roll, pitch, yaw = euler_angles(m[0], m[1], m[2], m[3])
        velocity = (-state.vz / 100, state.vx / 100, state.vy / 100)
        estimate = Estimate(roll, pitch, yaw, (state.p, state.q, state.r), state.alt / 1000, *velocity)
        if self.pilot is not None:
            self.pilot.steer(self.vehicle)
        demand = self.vehicle.step(now, estimate)
        self._note_arming()
        row = self.rows[0] if self.log is None else self.log.row(self.vehicle)
        row["setpoint"] = demand[:3]
        row["excitation"] = self.excitation(now)
        autopilot.controls["landed"] = self.vehicle.lift.landed
        tick(*self.fixed, demand.collective, demand.altitude, m, row)
        situation = self.situation
        situation.stamp, situation.row, situation.state = self.stamp, row, state
        situation.home = situation.home or (state.lat, state.lon, state.alt)
        if self._periods % EXAMINED == 0 or row["fault"]:
            self._examine(int(row["fault"]))
        self._periods += 1

    def _note_arming(self) -> None:
        """The controller and the log follow what the vehicle is."""
        armed = self.vehicle.armed
        if armed == bool(self.autopilot.controls["armed"][0]):
            return
        self.autopilot.controls["armed"] = armed
        if self.log is None:
            return
        if armed:
            self.log.begin(self.autopilot.controller.state["gains"][0])
            return
        try:
            written = self.log.save()
            self.vehicle.say(Severity.INFO, f"logged: {', '.join(path.name for path in written) or 'nothing'}")
        except OSError as error:
            kept = ", ".join(path.name for path in self.log.unsaved)
            text = f"not logged: {error.filename}: {error.strerror}; kept for the next disarming: {kept}"
            self.vehicle.say(Severity.CRITICAL, text)
        self.response_times.nothing_waits(0.0, time.monotonic())  # writing is not counted: nothing flies

    def _examine(self, fault: int) -> None:
        """What forbids arming and only we know."""
        found = {}
        if fault:
            found["controller"] = f"the controller refuses its inputs (fault {fault}) and only damps the rates"
        gains = self.autopilot.controller.state["gains"][0]
        for parameter, value in zip(PARAMETERS, gains.tolist(), strict=True):
            if not parameter.minimum <= value <= parameter.maximum:
                found["parameters"] = f"{parameter.name} is {value:g}, not within its range"
        Ts, passed = float(gains[-1]), self._periods - self._examined
        period = (self.stamp - self._first) * 1e-6 / max(passed, 1)
        if passed >= EXAMINED and abs(period - Ts) > 0.02 * Ts and not fault:
            found["rate"] = f"the plant's period is {1e3 * period:.3g} ms, the gains are for {1e3 * Ts:.3g} ms"
        if not fault:
            self._first, self._examined = self.stamp, self._periods
        for subject in ("controller", "parameters", "rate"):
            before = self.vehicle.obstacles.pop(subject, None)
            if subject in found:
                self.vehicle.obstacles[subject] = found[subject]
                if before is None:
                    self.vehicle.say(Severity.CRITICAL, found[subject])

    def _tell(self, ground: GroundStationLink, now: float) -> None:
        """What the vehicle has said, to the ground stations and the console."""
        for severity, text in self.vehicle.said:
            if now - self._told.get(text, -REPEATED_S) >= REPEATED_S:
                self._told[text] = now
                ground.say(severity, text)
                print(f"[{max(self.vehicle.now, 0):.2f} s] {text}", flush=True)
        self.vehicle.said.clear()
        if len(self._told) > 100:
            self._told.clear()

    def leave(self) -> list[Path]:
        """Nobody flies any more: the logs that were written.

        Raises
        ------
        SitlError
            When a flight cannot be written, and is lost.
        """
        try:
            return [] if self.log is None else self.log.save()
        except OSError as error:
            lost = ", ".join(map(str, self.log.unsaved)) if self.log else ""
            raise SitlError(f"{error.filename}: {error.strerror}; lost: {lost}", exit_code=1) from error
