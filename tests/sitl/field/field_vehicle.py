"""A scripted vehicle for an autotune in simulated time: it arms, takes off, is excited, follows setpoints, lands, logs.

Its attitude is scripted, but its logs are those of the simulation in process, with the gains that it holds.
"""

import functools

import numpy as np

from mimopilot.codegen.layout import to_array
from mimopilot.sitl.autopilot.autopilot import Autopilot
from mimopilot.sitl.field.doublet_flight import DoubletPlan
from mimopilot.sitl.flight.excitation_flight import ExperimentPlan
from mimopilot.sitl.flight.flight_log import vehicle_log
from mimopilot.sitl.flight.scenario import Scenario
from mimopilot.sitl.flight.simulator import fly
from mimopilot.sitl.mavlink.ground_station.events import (
    AltitudeReport,
    AttitudeReport,
    AttitudeTarget,
    CommandAck,
    EndLogs,
    FileRequest,
    Heartbeat,
    PowerReport,
    RequestLogData,
    RequestLogs,
    RequestMessage,
    SendCommand,
    StatusText,
    StorageReport,
    ThrustReport,
)
from mimopilot.sitl.mavlink.ground_station.profiles import make_plan
from mimopilot.sitl.physics.airframe import load_airframe
from mimopilot.tuning.parameters import FIRMWARE_NUMBER, PARAMETERS, SET_NUMBER
from tests.sitl.mavlink.flying_vehicle import FlyingVehicle
from tests.sitl.mavlink.log_transfer.logging_vehicle import ScriptedLogs
from tests.sitl.mavlink.scripted_vehicle import SYSTEM, SimulatedLink

SEA_M = 100.0  # altitude of the ground
SECONDS = 6.0  # of the excitation of an axis
HOLD, LANDING, TAKEOFF, OFFBOARD = 4 << 16 | 3 << 24, 4 << 16 | 6 << 24, 4 << 16 | 2 << 24, 6 << 16
AIRFRAME = load_airframe("adam0")


def first_gains():
    return AIRFRAME.default_gains()


@functools.cache
def flight_bytes(kind, values, detuned):
    """A log, as the simulation flies it in process; `values`: the elements of the gains."""
    gains = first_gains().with_elements(dict(values))
    body = AIRFRAME.airframe
    if kind == "experiment":
        flight = ExperimentPlan(body, gains, SECONDS, 0.1, 50.0, 1, axes="both").fly(1)
    else:
        Ts = gains.Ts
        plan = DoubletPlan(np.radians(8.0))
        times = np.arange(round(plan.seconds / Ts)) * Ts
        setpoint = np.zeros((len(times), 3))
        setpoint[:] = [plan.setpoint(time) for time in times]
        level = np.zeros_like(setpoint)
        flown = gains.with_elements({"RD_RR": detuned, "RD_PP": detuned}) if detuned else gains
        scenario = Scenario("doublet", Ts, setpoint, level, 0, (0, len(times)))
        flight = fly(body, Autopilot(body, flown), scenario, 2)
    landed = np.zeros(len(flight.record), bool)
    parameters = {p.name: value for p, value in zip(PARAMETERS, to_array(gains), strict=True)}
    return vehicle_log(flight.record, landed, gains.Ts, body, parameters)


class FieldVehicle(FlyingVehicle):
    """Stands on the ground at first. `then`: time (s) -> event, as for `FlyingVehicle`.

    Attributes
    ----------
    logging : bool
        It writes a log of each flight.
    detuned : float
        Rate D with which a check flight really flies; 0: that of the set.
    gust : float, rad
        Amplitude of its wobble in hover.
    """

    def __init__(self, **keywords):
        gains = first_gains()
        fixed = {p.name: gains.elements()[p.code] for p in PARAMETERS if not p.writable}
        published = {**gains.identity(), FIRMWARE_NUMBER.name: 123456.0}
        values = {**make_plan(gains).values, SET_NUMBER.name: 0.0, **fixed, **published}
        super().__init__(**values, **keywords)
        self.autopilot, self.free, self.own = 0, None, self.set
        self.stored_values = dict(self.values)
        self.logs = ScriptedLogs({})
        self.logs.now = lambda: self.clock
        self.armed, self.landed, self.height = False, 1, 0.0
        self.charge, self.logging, self.detuned, self.gust, self.simulated = 80, True, 0.0, 0.0, True
        self.target = 0.0
        self.angles, self.setpoint = [0.0, 0.0], None
        self.excited = self.content = ""
        self.rotation = 0.0
        self.stuck = None
        self.cut = None
        self.lost_excitation = False
        self.handed_over = []
        self.mute_until = 0.0
        self.clock = 0.0
        self.text = []

    @property
    def set(self):
        """The parameters of a set of gains."""
        return {p.name: self.values[p.name] for p in PARAMETERS if p.writable}

    def heartbeat(self):
        if self.clock < self.mute_until or "HEARTBEAT" in self.silent:
            return []
        return [Heartbeat(SYSTEM, 1, self.autopilot, self.armed, self.mode, self.type, self.simulated)]

    def answer(self, order):
        if self.clock < self.mute_until:
            return []
        if isinstance(order, FileRequest | RequestLogs | RequestLogData | EndLogs):
            return self.logs.answer(order)
        if order == RequestMessage(SYSTEM, 1, 1):
            return [PowerReport(SYSTEM, 1, self.charge)]
        if order == RequestMessage(SYSTEM, 1, 261) and self.free is not None:
            return [StorageReport(SYSTEM, 1, self.free)]
        if isinstance(order, SendCommand):
            return self.execute(order.command, order.params)
        if isinstance(order, AttitudeTarget):
            self.setpoint = (order.roll, order.pitch, self.clock)
            return []
        answers = super().answer(order)
        if self.stored:
            self.stored, self.stored_values = 0, dict(self.values)
        return answers

    def execute(self, command, params):
        result = 0
        bound = self.set == self.own or self.values[SET_NUMBER.name] == self.values[FIRMWARE_NUMBER.name]
        if command == 400 and params[0] == 1 and not bound:
            result = 1  # as PX4 with our module: the stored gains are for another firmware
        elif command == 400 and params[0] == 1:
            self.armed, self.content = True, ""
        elif command == 22 and self.armed:
            above_sea = self.autopilot == 12  # as PX4 takes it
            self.mode, self.target, self.landed = TAKEOFF, params[6] - (SEA_M if above_sea else 0.0), 3
        elif command == 21 and self.armed:
            self.mode = LANDING
        elif command == 176:
            self.mode = OFFBOARD if params[1] == 6 else HOLD
            if self.mode == OFFBOARD:
                self.content = "check"
        else:
            result = 2
        return [CommandAck(SYSTEM, 1, command, result)]

    def disarm(self):
        """Rotors off; the flight's log is written."""
        self.armed, self.landed, self.mode, self.height = False, 1, HOLD, 0.0
        self.injector.configure({n: v for n, v in self.values.items() if n.startswith("MIMO_EX")} | {"MIMO_EX_AX": 0.0})
        if not (self.logging and self.content):
            return
        if self.lost_excitation and self.content == "experiment":
            self.content = "check"
        values = tuple((p.code, self.values[p.name]) for p in PARAMETERS if p.writable)
        content = flight_bytes(self.content, values, self.detuned if self.content == "check" else 0.0)
        number = len(self.logs.files) + 1
        self.logs.files[f"{self.logs.folder}/2026-11-29/{number:02d}.ulg"] = content[: self.cut]

    def reboot(self):
        """It falls silent, loses what it has not stored, and stands on the ground."""
        self.mute_until = self.clock + 4.0
        self.values.update(self.stored_values)
        self.content = ""
        self.disarm()

    def stream(self, now):
        if now < self.mute_until:
            self.clock = now
            return []
        dt, self.clock = now - self.clock, now
        messages = [m for m in super().stream(now) if not isinstance(m, AttitudeReport)]
        if self.injector.running:
            self.content = "experiment"
        climb = self.fly(dt)
        at = SYSTEM, 1
        wobble = self.gust * np.sin(7.0 * now)
        streamed = {
            30: AttitudeReport(*at, self.angles[0] + wobble, self.angles[1], now, (self.rotation, 0.0, 0.0), 0.3),
            74: AltitudeReport(*at, SEA_M + self.height, climb),
            83: ThrustReport(*at, 0.49),
        }
        wanted = self.asked - self.silent
        said, self.text = [StatusText(*at, text) for text in self.text], []
        return [*messages, *said, *(message for number, message in streamed.items() if number in wanted)]

    def fly(self, dt):
        """Move for a period; returns the climb, m/s."""
        climb = 0.0
        if self.values.get("MIMO_EN") == 0.0:
            self.handed_over.append(self.armed)
        if self.armed and self.mode == TAKEOFF:
            climb = min(1.0, (self.target - self.height) / max(dt, 1e-3))
            if self.target - self.height < 0.05:
                self.mode, self.landed, climb = HOLD, 2, 0.0
        elif self.armed and self.mode == LANDING:
            climb = -1.0
            self.landed = 4
        self.height += climb * dt
        if self.armed and self.mode == LANDING and self.height <= 0.0:
            self.height = 0.0
            self.disarm()
        stale = self.setpoint is None or self.clock - self.setpoint[2] > 0.5
        if self.mode == OFFBOARD and stale and self.setpoint is not None and self.clock - self.setpoint[2] > 2.5:
            self.mode = LANDING
        wanted = (0.0, 0.0) if self.mode != OFFBOARD or stale else self.setpoint[:2]
        self.angles = [self.stuck] * 2 if self.stuck is not None and self.mode == OFFBOARD else list(wanted)
        return climb


class FieldLink(SimulatedLink):
    """A link that can be opened again and again."""

    hint = ""

    def __init__(self, vehicle, **keywords):
        super().__init__(vehicle, **keywords)
        self.events = []

    def plan(self, moment, event):
        """Call a function of the link at a moment, s."""
        self.events.append((moment, event))

    def open(self, *_):
        self.closed = False
        return self

    def close(self):
        pass

    def discard(self):
        self.queue = [entry for entry in self.queue if entry[2] != "to ground"]
        self.queue.sort()

    def receive(self, until):
        due = [one for one in self.events if one[0] <= until]
        self.events = [one for one in self.events if one[0] > until]
        for _, event in due:
            event(self)
        return super().receive(until)
