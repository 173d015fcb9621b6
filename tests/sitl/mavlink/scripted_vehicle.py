"""A scripted vehicle with parameters and one fault, and a link in simulated time.

The vehicle receives and sends the messages of `sitl.mavlink.ground_station.events`. `UdpVehicle` connects it to a real
socket with pymavlink's own packing, for tests of the commands.
"""

import contextlib
import heapq
import itertools
import os
import random
import select
import socket
import struct
import threading
import time
import tty

from pymavlink.dialects.v20 import common as mavlink

from mimopilot.sitl.mavlink.ground_station.events import (
    HEARTBEAT,
    SOLE_PEER,
    CommandAck,
    Heartbeat,
    ParameterRefusal,
    ParameterValue,
    ReadParameter,
    Received,
    RequestMessage,
    SetParameter,
    StoreParameters,
)

SYSTEM, COMPONENT = 1, 1
STREAM_S = 0.1
#: Faults after which no upload may be reported as verified, on any link.
FAILING = (
    *("echoes", "echoes one", "ignores", "clamps", "rounds", "out of range", "read only", "denies"),
    *("ignores one", "arms", "disconnects", "loses one", "writes another", "integer"),
)


def float32(value):
    return struct.unpack("<f", struct.pack("<f", value))[0]


class ScriptedVehicle:
    """Parameters and one fault, of the parameter `faulty`, which begins after `after` writes."""

    def __init__(self, values, fault="", faulty="", after=0, storage=0):
        self.values = {name: float32(value) for name, value in values.items()}
        self.fault, self.faulty, self.after, self.storage = fault, faulty, after, storage
        self.armed = self.offline = False
        self.autopilot, self.type = 12, 2  # a quadrotor with PX4
        self.first = self.values.get(faulty, 0.0)
        self.writes = self.reads = self.stored = 0

    def heartbeat(self):
        return [] if self.offline else [Heartbeat(SYSTEM, COMPONENT, self.autopilot, self.armed, 0, self.type)]

    def value(self, name):
        kind = 6 if self.fault == "integer" and name == self.faulty else 9
        return ParameterValue(SYSTEM, COMPONENT, name, self.values[name], kind)

    def answer(self, order):
        if self.offline:
            return []
        if isinstance(order, StoreParameters):
            self.stored += 1
            return [] if self.storage is None else [CommandAck(SYSTEM, COMPONENT, 245, self.storage)]
        if order == RequestMessage(SYSTEM, COMPONENT, HEARTBEAT):
            return self.heartbeat()
        if not isinstance(order, ReadParameter | SetParameter):
            return []
        if (order.system, order.component) != (SYSTEM, COMPONENT) or order.name not in self.values:
            return []  # a missing parameter is not answered, as by PX4 up to 1.17
        if isinstance(order, ReadParameter):
            self.reads += 1
            return [self.value(order.name)]
        return self.write(order.name, float32(order.value))

    def write(self, name, value):
        self.writes += 1
        if self.writes > self.after:
            if self.fault == "disconnects":
                self.offline = True
                return []
            if self.fault == "arms" and not self.armed:
                self.armed = True
                return [*self.heartbeat(), *self.store(name, value)]
        return self.store(name, value)

    def store(self, name, value):
        hit = name == self.faulty
        if self.fault == "echoes" or (self.fault == "echoes one" and hit):
            return [ParameterValue(SYSTEM, COMPONENT, name, value)]
        if self.fault == "ignores" and hit:
            return [self.value(name)]
        reasons = {"out of range": 2, "denies": 3, "read only": 5}
        if self.fault in reasons and hit:
            return [ParameterRefusal(SYSTEM, COMPONENT, name, reasons[self.fault]), self.value(name)]
        if self.fault == "ignores one" and hit:
            return []
        if self.fault == "clamps" and hit:
            value = min(value, float32(1.05 * self.first))
        if self.fault == "rounds" and hit:
            value = float32(self.first + round(8 * (value - self.first)) / 8)
        if self.fault == "epsilon" and abs(value - self.values[name]) < 1.1920929e-07:
            return [self.value(name)]
        self.values[name] = value
        if self.fault == "loses one" and hit:
            answer = [self.value(name)]
            self.values[name] = float32(value / 2)
            return answer
        if self.fault == "writes another" and hit:
            other = next(n for n in self.values if n != name)
            self.values[other] = value
        return [self.value(name)]


class SimulatedLink:
    """A link with loss, duplicates, reordering and latency each way, in simulated time; see events.Link."""

    def __init__(self, vehicle, seed=0, loss=0.0, duplicate=0.0, reorder=0.0, latency=0.05, noise=()):
        self.vehicles, self.closed, self.time = {SOLE_PEER: vehicle}, False, 0.0
        self.random = random.Random(seed)
        self.loss, self.duplicate, self.reorder, self.latency = loss, duplicate, reorder, latency
        self.order = itertools.count()
        self.queue = []
        self.up = True
        self.noise = noise
        self.log = []
        self.schedule(self.random.random(), "beat", SOLE_PEER)
        if hasattr(vehicle, "stream"):
            self.schedule(0.0, "stream", None)

    def join(self, at, origin, vehicle):
        """Add a vehicle at another address from a time (s) on."""
        self.vehicles[origin] = vehicle
        self.schedule(at, "beat", origin)

    def now(self):
        return self.time

    def schedule(self, at, kind, message):
        heapq.heappush(self.queue, (at, next(self.order), kind, message))

    def carry(self, kind, message):
        """Deliver a message once, twice or not at all."""
        chance = self.random.random
        for _ in range(1 + (chance() < self.duplicate)):
            if self.up and chance() >= self.loss:
                late = 4 * self.latency * chance() if chance() < self.reorder else 0.0
                self.schedule(self.time + self.latency + late, kind, message)

    def send(self, messages, to=None):
        for message in messages:
            self.log.append((self.time, message))
            for target in self.vehicles if to is None else [to]:
                self.carry("to vehicle", (target, message))

    def say(self, messages, origin=SOLE_PEER):
        for message in messages:
            self.carry("to ground", Received(origin, message))
            for other in self.noise:
                self.carry("to ground", Received(origin, other(message)))

    def receive(self, until):
        while self.queue and self.queue[0][0] <= until:
            at, _, kind, message = heapq.heappop(self.queue)
            self.time = max(self.time, at)
            if kind == "beat":
                self.say(self.vehicles[message].heartbeat(), message)
                self.schedule(at + 1.0, "beat", message)
            elif kind == "stream":
                self.say(self.vehicles[SOLE_PEER].stream(at))
                self.schedule(at + STREAM_S, "stream", None)
            elif self.up and kind == "to vehicle":
                target, order = message
                self.say(self.vehicles[target].answer(order), target)
            elif self.up:
                return [message]
        self.time = max(self.time, until)
        return []


def encode(message):
    """pymavlink's message of a message of the vehicle."""
    if isinstance(message, Heartbeat):
        mode = 128 if message.armed else 0
        return mavlink.MAVLink_heartbeat_message(message.type, message.autopilot, mode, 0, 4, 3)
    if isinstance(message, ParameterValue):
        # Index 65535: unknown.
        return mavlink.MAVLink_param_value_message(message.name.encode(), message.value, message.kind, 100, 65535)
    if isinstance(message, ParameterRefusal):
        return mavlink.MAVLink_param_error_message(255, 190, message.name.encode(), -1, message.reason)
    return mavlink.MAVLink_command_ack_message(message.command, message.result)


def decode(message):
    """Message to the vehicle, from pymavlink's; None if the vehicle does not know it."""
    kind = message.get_type()
    if kind == "PARAM_REQUEST_READ":
        assert message.param_index == -1
        return ReadParameter(message.target_system, message.target_component, message.param_id)
    if kind == "PARAM_SET":
        assert message.param_type == 9
        return SetParameter(message.target_system, message.target_component, message.param_id, message.param_value)
    if kind == "COMMAND_LONG":
        if message.command == 512:
            return RequestMessage(message.target_system, message.target_component, message.param1)
        assert (message.command, message.param1) == (245, 1.0)
        return StoreParameters(message.target_system, message.target_component)
    return None


class ByteVehicle:
    """A scripted vehicle that runs MAVLink in a thread; subclasses add `receive` and `transmit`."""

    def __init__(self, vehicle, beat=0.1, delay=0.0, key=None, late=0.0):
        self.vehicle, self.beat, self.delay = vehicle, beat, delay
        self.first_beat_at = None
        self.mav = mavlink.MAVLink(None, SYSTEM, COMPONENT)
        self.mav.robust_parsing = True
        self.late = late
        if key is not None:
            self.mav.signing.secret_key, self.mav.signing.sign_outgoing = key, True
            self.set_clock()
        self.stop = threading.Event()
        self.thread = threading.Thread(target=self.run)

    def set_clock(self):
        """Set its signing clock `late` s behind."""
        self.mav.signing.timestamp = int((time.time() - 1420070400 - self.late) * 1e5)

    def __enter__(self):
        self.thread.start()
        return self

    def __exit__(self, *_):
        self.stop.set()
        self.thread.join(timeout=10)
        self.port.close()

    def run(self):
        due, outbox = 0.0, []
        while not self.stop.is_set():
            now = time.monotonic()
            if now >= due:
                due = now + self.beat
                self.first_beat_at = self.first_beat_at or now
                outbox += [(now, m) for m in self.vehicle.heartbeat()]
            while outbox and outbox[0][0] <= now:
                message = outbox.pop(0)[1]
                self.mav.srcSystem, self.mav.srcComponent = message.system, message.component
                if self.late:
                    self.set_clock()  # pymavlink advances it to the time of received messages
                self.transmit(encode(message).pack(self.mav))
                self.mav.seq = (self.mav.seq + 1) % 256
            wake = min([due, *(at for at, _ in outbox[:1])])
            data = self.receive(max(0.0, wake - time.monotonic()))
            for message in self.mav.parse_buffer(data) or [] if data else []:
                order = decode(message)
                if order is not None:
                    # The whole round trip delays the answer: the ground station cannot see the difference.
                    outbox += [(time.monotonic() + self.delay, answer) for answer in self.vehicle.answer(order)]


class UdpVehicle(ByteVehicle):
    """On a UDP socket: it sends to a ground station's port first."""

    def __init__(self, vehicle, **keywords):
        super().__init__(vehicle, **keywords)
        self.port = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.port.bind(("127.0.0.1", 0))
        self.port_number = self.port.getsockname()[1]
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            probe.bind(("127.0.0.1", 0))
            self.ground = probe.getsockname()
        self.url = f"udpin:127.0.0.1:{self.ground[1]}"

    def transmit(self, data):
        self.port.sendto(data, self.ground)

    def receive(self, wait):
        if not select.select([self.port], [], [], wait)[0]:
            return b""
        try:
            return self.port.recv(4096)
        except ConnectionRefusedError:
            return b""


class TcpVehicle(ByteVehicle):
    """On a TCP port: the ground station connects."""

    def __init__(self, vehicle, **keywords):
        super().__init__(vehicle, **keywords)
        self.port = socket.create_server(("127.0.0.1", 0))
        self.url = f"tcp:127.0.0.1:{self.port.getsockname()[1]}"
        self.ground = None

    def transmit(self, data):
        with contextlib.suppress(OSError):
            if self.ground is not None:
                self.ground.sendall(data)

    def hang_up(self):
        self.ground.shutdown(socket.SHUT_RDWR)

    def receive(self, wait):
        if not select.select([self.ground or self.port], [], [], wait)[0]:
            return b""
        if self.ground is None:
            self.ground, _ = self.port.accept()
            return b""
        with contextlib.suppress(OSError):
            return self.ground.recv(4096)
        return b""

    def __exit__(self, *_):
        super().__exit__()
        if self.ground is not None:
            self.ground.close()


class SerialVehicle(ByteVehicle):
    """On a serial port: a pseudo-terminal."""

    def __init__(self, vehicle, **keywords):
        super().__init__(vehicle, **keywords)
        self.near, self.far = os.openpty()
        tty.setraw(self.far)
        self.url = f"{os.ttyname(self.far)},57600"

    def transmit(self, data):
        os.write(self.near, data)

    def receive(self, wait):
        return os.read(self.near, 4096) if select.select([self.near], [], [], wait)[0] else b""

    def __exit__(self, *_):
        self.stop.set()
        self.thread.join(timeout=10)
        os.close(self.near)
        os.close(self.far)
