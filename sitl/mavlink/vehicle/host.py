"""The autopilot host: runs the compiled controller against a plant, and serves ground stations as a vehicle."""

from __future__ import annotations

import gc
import select
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mimopilot.sitl.autopilot.autopilot import RECORD, Autopilot, tick
from mimopilot.sitl.autopilot.flight_modes import Commander, Severity
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
from mimopilot.sitl.physics.state_estimate import MEASUREMENT_SIZE, euler_angles

# All chosen:
PLANT_TIMEOUT_S = 0.9  # s without a frame before it is reported: within one second
GROUND_PERIOD_S = 0.002  # s between reads of the ground stations' links, which are polled, not waited for
CHILD_PERIOD_S = 0.2  # s between reads of our own plant process's messages
MAX_SLEEP_S = 0.01  # s, longest wait for a frame
CLOCK_BACK_US = 1_000_000  # us; a plant whose clock goes back by more has restarted
CHECK_PERIODS = 250  # control periods between pre-arm checks of the controller: one second at 250 Hz
PERIOD_TOLERANCE = 0.02  # relative deviation of the plant's period from the gains' that forbids arming
REPEAT_S = 1.0  # s, least interval between two equal texts
MAX_TEXTS = 100  # texts remembered for it

#: Torque (normalised) to inject in a period, (3,); called with the vehicle's clock, s.
TorqueSource = Callable[[float], Sequence[float]]


class Host:
    """One autopilot on one plant link.

    Parameters
    ----------
    autopilot : Autopilot
        The controller with estimator and mixer.
    plant : PlantLink
        Link to the plant.
    log : FlightRecorder or None
        Recorder of the flights.

    Attributes
    ----------
    vehicle : Commander
    state : VehicleState
        What telemetry is made from.
    excitation : callable
        Torque source; may be replaced.
    pilot : ScriptedPilot or None
        Flies in place of a ground station.
    faults : AutopilotFaults or None
        Faults of this autopilot, in seconds from the first frame of a plant.
    response_times : ResponseTimes
        Response times to frames of the plant.
    """

    def __init__(self, autopilot: Autopilot, plant: PlantLink, log: FlightRecorder | None = None) -> None:
        self.autopilot, self.plant, self.log = autopilot, plant, log
        autopilot.controls["armed"] = 0
        self.vehicle = Commander(autopilot.hover)
        self.vehicle.arming_blockers["plant"] = "no plant is connected"
        self.state = VehicleState(self.vehicle)
        self.excitation: TorqueSource = lambda now: (0.0, 0.0, 0.0)
        self.pilot: ScriptedPilot | None = None
        self.faults: AutopilotFaults | None = None
        self.response_times = ResponseTimes()
        self.measurement = np.zeros(MEASUREMENT_SIZE)
        euler_angles(*self.measurement[:4])  # compile now, not in flight
        self.stamp = self._zero = -1
        self.rows: NDArray[Any] = np.zeros(1, RECORD)
        self.fixed = autopilot.loop
        self.heard = self._next_child_read = self._next_ground_read = 0.0
        self._connected = False
        self._periods = self._checked = self._first = 0
        self._sent_texts: dict[str, float] = {}

    def reboot(self) -> None:
        """Reconnect to the plant as a new autopilot: the plant resets the vehicle to its start."""
        self.plant.drop()
        self._plant_lost("the vehicle reboots")

    def run(self, ground: GroundStationLink) -> None:
        """Fly and serve ground stations, for ever or until `pilot` is done.

        The plant is served first. If it disconnects, the host reconnects.
        """
        gc.collect()
        gc.freeze()  # otherwise a collection over all imported modules takes 70 ms of a flight, measured
        while self.pilot is None or not self.pilot.done:
            now = time.monotonic()
            self._connect(now)
            if self._wait():
                self._fly()
            elif self._connected and now > self.heard + PLANT_TIMEOUT_S and "plant" not in self.vehicle.arming_blockers:
                self.vehicle.arming_blockers["plant"] = f"no frame from the plant for {PLANT_TIMEOUT_S:g} s"
                self.vehicle.say(Severity.CRITICAL, self.vehicle.arming_blockers["plant"])
            if now >= self._next_ground_read:
                self._next_ground_read = now + GROUND_PERIOD_S
                ground.receive(now)
            self._forward_child_messages(now)
            self._send_texts(ground, now)
            ground.send(now)

    def _forward_child_messages(self, now: float) -> None:
        """Forward the messages of our own plant process, such as a crash."""
        if self.plant.child is not None and now >= self._next_child_read:
            self._next_child_read = now + CHILD_PERIOD_S
            for text in self.plant.child.take_messages():
                self.vehicle.say(Severity.WARNING, text)

    def _connect(self, now: float) -> None:
        if self._connected:
            return
        try:
            self._connected = self.plant.connect(now)
        except SitlError as error:
            self.vehicle.arming_blockers["plant"] = str(error)
            self.vehicle.say(Severity.CRITICAL, str(error))
        if self._connected:
            self._begin(now)

    def _begin(self, now: float) -> None:
        """Start with a newly connected plant, which may be another one."""
        self.heard = now
        self.stamp = self._zero = -1
        self._periods = self._checked = 0
        self.state.home = self.state.imu = self.state.fix = ()
        self.vehicle.plant_back()

    def _plant_lost(self, why: str) -> None:
        self._connected = False
        self.state.home = ()  # the next plant may start elsewhere
        self.vehicle.plant_lost(why)
        self._follow_arming()

    def _wait(self) -> bool:
        """Wait for the plant; True when it has sent something. Ground stations do not end the wait."""
        plants = [self.plant.socket] if self.plant.socket is not None else []
        if plants and select.select(plants, [], [], 0)[0]:
            return True
        begin = time.monotonic()
        ready = select.select(plants, [], [], MAX_SLEEP_S)[0]
        end = time.monotonic()
        self.response_times.note_idle(end - begin, end)
        return bool(ready)

    def _fly(self) -> None:
        """Read and answer the frames of the plant."""
        try:
            for kind, fields in self.plant.receive():
                if kind is STATE:
                    self._period(PlantState(*fields))
                elif kind is SENSOR:
                    self.state.imu = fields
                elif kind is GPS:
                    self.state.fix = fields
        except ConnectionError as error:
            self._plant_lost(f"the plant disconnected: {error}")

    def _period(self, state: PlantState) -> None:
        """Run one control period; a frame whose time repeats is answered, not flown."""
        self.heard = time.monotonic()
        if state.stamp < self.stamp - CLOCK_BACK_US:
            self.vehicle.plant_lost("the plant has restarted")
            self._begin(self.heard)
        elif "plant" in self.vehicle.arming_blockers:
            del self.vehicle.arming_blockers["plant"]
            self.vehicle.say(Severity.INFO, "the plant sends frames again")
        if state.stamp > self.stamp:
            self.stamp = state.stamp
            self._compute(state)
        self.plant.answer(self.stamp, self.state.record["commands"], self.vehicle.armed)
        self.response_times.note_answer()
        self.state.load = self.response_times.load

    def _inject_faults(self) -> None:
        """Inject the faults of this period into the controller, and cut the setpoints if they are faulty."""
        assert self.faults is not None
        self._zero = self.stamp if self._zero < 0 else self._zero
        k = round(1e-6 * (self.stamp - self._zero) / self.faults.Ts)
        self.faults.apply(k)
        self.vehicle.attitude.cut = self.vehicle.sticks.cut = self.faults.stale(k)

    def _compute(self, state: PlantState) -> None:
        if self.faults is not None:
            self._inject_faults()
        state.measure(self.measurement)
        now = 1e-6 * self.stamp
        autopilot, m = self.autopilot, self.measurement
        roll, pitch, yaw = euler_angles(m[0], m[1], m[2], m[3])
        velocity = (-state.vz / 100, state.vx / 100, state.vy / 100)
        estimate = Estimate(roll, pitch, yaw, (state.p, state.q, state.r), state.alt / 1000, *velocity)
        if self.pilot is not None:
            self.pilot.update(self.vehicle)
        demand = self.vehicle.step(now, estimate)
        self._follow_arming()
        row = self.rows[0] if self.log is None else self.log.next_row(self.vehicle)
        row["setpoint"], row["yaw_rate"] = demand.setpoint[:3], demand.setpoint.yaw_rate
        row["rate_mode"] = demand.setpoint.rate_mode
        row["excitation"] = self.excitation(now)
        autopilot.controls["landed"] = self.vehicle.vertical.landed
        tick(self.fixed, demand.collective, demand.altitude, m, row)
        seen = self.state
        seen.stamp, seen.record, seen.plant = self.stamp, row, state
        seen.home = seen.home or (state.lat, state.lon, state.alt)
        if self._periods % CHECK_PERIODS == 0 or row["fault"]:
            self._check_controller(int(row["fault"]))
        self._periods += 1

    def _follow_arming(self) -> None:
        """Arm or disarm controller and log with the vehicle."""
        armed = self.vehicle.armed
        if armed == bool(self.autopilot.controls["armed"][0]):
            return
        self.autopilot.controls["armed"] = armed
        if self.log is None:
            return
        if armed:
            self.log.begin(self.autopilot.parameters)
            return
        try:
            written = self.log.save()
            self.vehicle.say(Severity.INFO, f"logged: {', '.join(path.name for path in written) or 'nothing'}")
        except OSError as error:
            kept = ", ".join(path.name for path in self.log.unsaved)
            text = f"not logged: {error.filename}: {error.strerror}; kept for the next disarming: {kept}"
            self.vehicle.say(Severity.CRITICAL, text)
        self.response_times.note_idle(0.0, time.monotonic())  # writing is not counted: nothing flies

    def _check_controller(self, fault: int) -> None:
        """Pre-arm checks of the controller: its fault flag, its parameters, the plant's period."""
        found = {}
        if fault:
            found["controller"] = f"the controller rejects its inputs (fault {fault}) and only damps the rates"
        problem = self.autopilot.parameter_problem()
        if problem:
            found["parameters"] = problem
        Ts, passed = self.autopilot.gains.Ts, self._periods - self._checked
        period = (self.stamp - self._first) * 1e-6 / max(passed, 1)
        if passed >= CHECK_PERIODS and abs(period - Ts) > PERIOD_TOLERANCE * Ts and not fault:
            found["rate"] = f"the plant's period is {1e3 * period:.3g} ms, the gains are for {1e3 * Ts:.3g} ms"
        if not fault:
            self._first, self._checked = self.stamp, self._periods
        for subject in ("controller", "parameters", "rate"):
            before = self.vehicle.arming_blockers.pop(subject, None)
            if subject in found:
                self.vehicle.arming_blockers[subject] = found[subject]
                if before is None:
                    self.vehicle.say(Severity.CRITICAL, found[subject])

    def _send_texts(self, ground: GroundStationLink, now: float) -> None:
        """Send the vehicle's texts to the ground stations and the console."""
        for severity, text in self.vehicle.said:
            if now - self._sent_texts.get(text, -REPEAT_S) >= REPEAT_S:
                self._sent_texts[text] = now
                ground.send_text(severity, text)
                print(f"[{max(self.vehicle.now, 0):.2f} s] {text}", flush=True)
        self.vehicle.said.clear()
        if len(self._sent_texts) > MAX_TEXTS:
            self._sent_texts.clear()

    def leave(self) -> list[Path]:
        """End: write the open flight, and return the logs written.

        Raises
        ------
        SitlError
            When a flight cannot be written, and is lost.
        """
        try:
            return [] if self.log is None else self.log.save()
        except OSError as error:
            lost = ", ".join(map(str, self.log.unsaved)) if self.log else ""
            raise SitlError(
                f"{error.filename}: {error.strerror}; flights lost: {lost}; next time give a --log that can be written",
                exit_code=1,
            ) from error
