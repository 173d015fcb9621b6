"""A scripted Crazyflie on the level of packets, as a link driver of cflib; with one fault.

It answers as crazyflie-firmware's param_logic.c and crtp_supervisor.c do, and takes a set as `tuning.crazyflie_names`
says: a write is echoed before it has any effect, a write to a read-only parameter is not answered.
"""

import queue
import random
import struct

import cflib.crtp
from cflib.crtp.crtpdriver import CRTPDriver
from cflib.crtp.crtpstack import CRTPPacket
from cflib.crtp.exceptions import WrongUriType

from mimopilot.tuning.crazyflie_names import STATE, ControllerState, crazyflie_name, crazyflie_parameters
from tests.sitl.mavlink.scripted_vehicle import float32

URI = "radio://0/80/2M"
FLOAT, BYTE, READ_ONLY, EXTENDED = 0x06, 0x08, 0x40, 0x10
ENOENT = 2
CAN_FLY, FLYING, ARMED, AUTO = 0x08, 0x10, 0x02, 0x04
FIXED = ("mimo.TS", "mimo.SCALE_R", "mimo.SCALE_P", "mimo.SCALE_Y", "mimo.FW_ID")


class ScriptedCrazyflie:
    """Parameters, a table of contents, and one fault of the parameter `faulty` that begins after `after` writes."""

    def __init__(self, values, fault="", faulty="", after=0, enabled=1.0, loss=0.0, seed=0):
        names = {p.name: crazyflie_name(p.name) for p in crazyflie_parameters()}
        self.values = {names[name]: 0.0 for name in names}
        self.values |= {crazyflie_name(name): float32(value) for name, value in values.items()}
        self.values |= {"mimo.EN": enabled, STATE: 0.0, "stabilizer.controller": 6.0, "pid_rate.roll_kp": 250.0}
        if fault == "stock firmware":
            self.values = {name: value for name, value in self.values.items() if not name.startswith("mimo.")}
        self.fault, self.faulty, self.after = fault, crazyflie_name(faulty), after
        self.names = list(self.values)
        self.state_bits = CAN_FLY | ARMED | AUTO
        self.protocol = 12
        self.writes, self.stored, self.connections = 0, {}, 0
        self.lossy = random.Random(seed)
        self.loss = loss
        self.taken = self.gains() if enabled else None
        self.update()

    def gains(self):
        return {name: value for name, value in self.values.items() if name not in ("mimo.EN", STATE)}

    def update(self, edge=False):
        """The controller's task: what flies, and the state."""
        if STATE not in self.values:
            return
        on = self.values["mimo.EN"] == 1.0
        if edge and on and self.fault != "refuses the set":
            self.taken = self.gains()
        self.values[STATE] = float(
            ControllerState.STOCK
            if not on
            else ControllerState.OTHER_FIRMWARE
            if self.values["mimo.SET_ID"] != self.values["mimo.FW_ID"]
            else ControllerState.REFUSED
            if edge and self.fault == "refuses the set"
            else ControllerState.FLIES
            if self.taken == self.gains()
            else ControllerState.CHANGED
        )

    def kind(self, name):
        if name in (STATE, "stabilizer.controller"):
            return BYTE | (READ_ONLY if name == STATE else 0)
        return FLOAT | (READ_ONLY if name in FIXED else EXTENDED)

    def packed(self, name):
        return struct.pack("<B", int(self.values[name])) if self.kind(name) & 0xF == BYTE else self.single(name)

    def single(self, name):
        return struct.pack("<f", self.values[name])

    def answer(self, port, channel, data):
        """Packets (port, channel, data) that answer one."""
        if port == 0x0D and channel == 1 and data[0] == 0:
            return [(port, channel, bytes([0, self.protocol]))]
        if port == 0x09 and channel == 0 and data[0] == 0x0C:
            return [(port, channel, struct.pack("<BH", 0x8C, self.state_bits))]
        if port != 0x02:
            return []
        if channel == 0:
            return [(port, channel, self.contents(data))]
        number = struct.unpack_from("<H", data, 1 if channel == 3 else 0)[0]
        name = self.names[number] if number < len(self.names) else None
        if channel == 1:
            head = struct.pack("<HB", number, 0 if name else ENOENT)
            return [(port, channel, head + (self.packed(name) if name else b""))]
        if channel == 2:
            return self.write(number, name, data)
        if data[0] == 3:
            return [(port, channel, data[:3] + bytes([self.store(name)]))]
        return []

    def contents(self, data):
        if data[0] == 3:
            return struct.pack("<BHI", 3, len(self.names), 0x12345678)
        number = struct.unpack_from("<H", data, 1)[0]
        if number >= len(self.names):
            return bytes([2])
        group, _, name = self.names[number].partition(".")
        return struct.pack("<BHB", 2, number, self.kind(self.names[number])) + f"{group}\0{name}\0".encode()

    def write(self, number, name, data):
        if name is None:
            return [(2, 2, data[:2] + bytes([ENOENT]))]
        if self.kind(name) & READ_ONLY:
            return []
        self.writes += 1
        value = struct.unpack_from("<f", data, 2)[0]
        hit = self.writes > self.after and (name == self.faulty or not self.faulty or self.faulty == "mimo.")
        more = []
        if self.fault == "clamps" and hit:
            value = float32(value / 2)
            more = [(2, 3, struct.pack("<BHf", 1, number, value))] if self.lossy.random() < 0.5 else []
        if self.fault == "ignores" and hit:
            value = self.values[name]
        if self.fault == "takes off" and hit:
            self.state_bits |= FLYING
        edge = name == "mimo.EN" and self.values[name] == 0.0 and value == 1.0
        self.values[name] = value
        self.update(edge)
        return [(2, 2, data), *more]

    def store(self, name):
        if self.fault == "does not store" and name != "mimo.EN":
            return ENOENT
        self.stored[name] = self.values[name]
        return 0


def driver_of(vehicle):
    """A class of link drivers that reach this vehicle at `URI`."""

    class ScriptedDriver(CRTPDriver):
        def connect(self, uri, statistics, lost):
            if uri != URI:
                raise WrongUriType("not this one")
            self.lost, self.packets = lost, queue.Queue()
            vehicle.connections += 1

        def send_packet(self, pk):
            if vehicle.fault == "dies" and vehicle.writes >= vehicle.after:
                self.lost("Too many packets lost")
                return
            if vehicle.fault == "silent" or vehicle.lossy.random() < vehicle.loss:
                return
            for port, channel, data in vehicle.answer(pk.port, pk.channel, bytes(pk.data)):
                if vehicle.lossy.random() >= vehicle.loss:
                    made = CRTPPacket()
                    made.set_header(port, channel)
                    made.data = data
                    self.packets.put(made)

        def receive_packet(self, wait=0):
            try:
                return self.packets.get(timeout=wait) if wait > 0 else self.packets.get_nowait()
            except queue.Empty:
                return None

        def close(self):
            vehicle.connections -= 1

    return ScriptedDriver


def connect(monkeypatch, vehicle):
    """Let cflib reach this vehicle only."""
    monkeypatch.setattr(cflib.crtp, "CLASSES", [driver_of(vehicle)])
    return vehicle
