"""Scripted vehicles with stock firmware: a PX4 with its autotune, an ArduCopter with its mode SystemID."""

import math

import numpy as np

from mimopilot.sitl.autopilot.autotune_module import PROGRESS, AutotuneModule, State
from mimopilot.sitl.autopilot.px4_parameters import OF_THE_AUTOTUNE
from mimopilot.sitl.autopilot.setpoints import Sticks
from mimopilot.sitl.mavlink.ground_station.events import (
    UNKNOWN_INDEX,
    AltitudeReport,
    AttitudeReport,
    CommandAck,
    Heartbeat,
    LandedState,
    ParameterValue,
    PowerReport,
    RequestMessage,
    SendCommand,
    SetMessageInterval,
    StatusText,
    StorageReport,
    run_exchange,
)
from mimopilot.sitl.mavlink.ground_station.parameter_protocol import ParameterClient
from tests.sitl.mavlink.scripted_vehicle import ScriptedVehicle, SimulatedLink

HOLD = 4 << 16 | 3 << 24
ACCEPTED, REJECTED, DENIED, FAILED, IN_PROGRESS = 0, 1, 2, 4, 5
BOOT_S = 4.0


class StockVehicle(ScriptedVehicle):
    """On the ground until `take_off`; `then`: time (s) -> event."""

    whole = frozenset()
    kind = 6

    def __init__(self, autopilot, mode, values, then=None):
        super().__init__(values)
        self.autopilot, self.mode, self.then = autopilot, mode, dict(then or {})
        self.before = dict(self.values)
        self.landed, self.tilt, self.altitude, self.charge, self.free = 1, 0.02, 10.0, 80, 500.0
        self.silent, self.asked, self.said = set(), set(), []
        self.now = self.stepped = self.booted = 0.0
        self.reboots = 0

    def take_off(self):
        self.armed, self.landed = True, 2

    def heartbeat(self):
        hidden = "HEARTBEAT" in self.silent or self.now < self.booted
        return [] if hidden else [Heartbeat(1, 1, self.autopilot, self.armed, self.mode, 2)]

    def value(self, name):
        kind = self.kind if name in self.whole else 9
        return ParameterValue(1, 1, name, self.values[name], kind, self.place(name))

    def place(self, name):
        return list(self.values).index(name)

    def answer(self, order):
        if self.now < self.booted:
            return []
        if isinstance(order, SetMessageInterval):
            self.asked.add(order.message)
            return []
        if isinstance(order, SendCommand):
            return [CommandAck(1, 1, order.command, *self.command(order.command, order.params))]
        if order == RequestMessage(1, 1, 1):
            return [PowerReport(1, 1, self.charge)]
        if order == RequestMessage(1, 1, 261):
            return [StorageReport(1, 1, self.free)]
        return super().answer(order)

    def stream(self, now):
        """Messages that it streams, at 10 Hz."""
        self.now = now
        for at in [at for at in self.then if at <= now]:
            self.then.pop(at)(self)
        if now < self.booted:
            return []
        self.step(now)
        said, self.said = [StatusText(1, 1, text) for text in self.said], []
        streamed = {
            30: AttitudeReport(1, 1, self.tilt, 0.0, now - self.booted),
            245: LandedState(1, 1, self.landed),
            74: AltitudeReport(1, 1, self.altitude),
        }
        return said + [message for number, message in streamed.items() if number in self.asked - self.silent]


class StockPx4(StockVehicle):
    """PX4 v1.16. `starts`: its start script starts the module; `denies`: it cannot restart itself, as in simulation."""

    whole = frozenset({"MC_AT_EN", "MC_AT_APPLY", "MC_AT_START", "SDLOG_PROFILE"})

    def __init__(self, then=None, starts=True, denies=False, **values):
        first = {"MC_AT_EN": 0, "MC_AT_APPLY": 1, "MC_AT_SYSID_AMP": 0.7, "MC_AT_START": 0, "SDLOG_PROFILE": 1}
        super().__init__(12, HOLD, first | values, then)
        self.starts, self.denies, self.module, self.stick = starts, denies, None, 0.0
        self.signal, self.runs = [], 0
        self.boot()

    def boot(self):
        self.values["MC_AT_START"] = 0.0
        self.module = AutotuneModule(self.values) if self.values["MC_AT_EN"] and self.starts else None

    def reboot(self):
        self.booted, self.reboots = self.now + BOOT_S, self.reboots + 1
        self.stepped = self.booted
        self.asked = set()
        self.boot()

    def place(self, name):
        return UNKNOWN_INDEX if self.module is None and name in OF_THE_AUTOTUNE else super().place(name)

    def command(self, number, params):
        if number == 246:
            if self.armed:
                return (REJECTED,)
            if self.denies:
                return (DENIED,)
            self.reboot()
            return (ACCEPTED,)
        assert number == 212
        state = State.IDLE if self.module is None else self.module.state
        if state is State.IDLE:
            self.runs += self.values["MC_AT_START"] == 0
            self.values["MC_AT_START"] = 1.0
        result = {State.COMPLETE: ACCEPTED, State.FAIL: FAILED}.get(state, IN_PROGRESS)
        return result, PROGRESS[state]

    def step(self, now):
        while self.stepped < now:
            self.stepped += 0.004
            moved = (0.0, 0.0, 0.0)
            if self.module is not None:
                moved = self.module.step(self.stepped, self.armed, Sticks(self.stick, 0.0, 0.0, 0.0))
            self.signal.append((self.stepped, *moved))

    def excited(self, begin=-math.inf, end=math.inf):
        """Times (s) between two others at which the rate setpoint is moved by more than the fading rest of a step."""
        signal = np.array(self.signal)
        moved = np.abs(signal[:, 1:]).max(axis=1) > 0.02
        return signal[moved & (signal[:, 0] > begin) & (signal[:, 0] < end), 0]


class StockCopter(StockVehicle):
    """ArduCopter in Stabilize; its chirps are only noted: (SID_AXIS, begin, end)."""

    whole = frozenset({"SID_AXIS", "LOG_BITMASK"})

    def __init__(self, then=None, **values):
        first = {
            **{"SID_AXIS": 0, "SID_MAGNITUDE": 15, "SID_F_START_HZ": 0.5, "SID_F_STOP_HZ": 40, "SID_T_REC": 70},
            **{"SID_T_FADE_IN": 15, "SID_T_FADE_OUT": 2, "LOG_BITMASK": 176126},
        }
        super().__init__(3, 0, first | values, then)
        self.chirps = []

    def answer(self, order):
        hidden = self.values["SID_AXIS"] == 0 and getattr(order, "name", "") in self.values
        return [] if hidden and order.name.startswith("SID_") and order.name != "SID_AXIS" else super().answer(order)

    def command(self, number, params):
        assert (number, params[0]) == (176, 1)
        if params[1] == 25 and self.mode != 25:
            if self.values["SID_AXIS"] == 0:
                self.said.append("No axis selected, SID_AXIS = 0")
                return (FAILED,)
            if self.mode not in (0, 1):
                self.said.append("Axis requires manual throttle")
                return (FAILED,)
            self.chirps.append([int(self.values["SID_AXIS"]), self.now, None])
        self.enter(int(params[1]))
        return (ACCEPTED,)

    def enter(self, mode):
        self.mode = mode
        if mode != 25 and self.chirps and self.chirps[-1][2] is None:
            self.chirps[-1][2] = self.now

    def step(self, now):
        if not self.chirps or self.chirps[-1][2] is not None:
            return
        v = self.values
        whole = 1 + v["SID_T_FADE_IN"] + 2 / v["SID_F_START_HZ"] + v["SID_T_REC"] + v["SID_T_FADE_OUT"]
        if now > self.chirps[-1][1] + whole:
            self.chirps[-1][2] = now
            self.said.append("SystemID Finished")


class SimulatedSession:
    """A session over a link in simulated time."""

    def __init__(self, vehicle, integers, **link):
        self.link = SimulatedLink(vehicle, **link)
        self.integers = integers
        self.client = ParameterClient(self.link.now(), integers=integers, force_armed=True)

    def run(self, exchange):
        return run_exchange(exchange, self.link)

    def reconnect(self):
        self.link.closed = False
        self.client = ParameterClient(self.link.now(), integers=self.integers, force_armed=True)
        self.run(self.client.await_heartbeat())
