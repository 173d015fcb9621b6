"""Hostile datagrams against a vehicle in the air: none may change, stop or delay anything.

`python -m tests.sitl.mavlink.hostile 1000000` sends that many and prints the result.
"""

import gc
import math
import random
import re
import socket
import sys
import time
from collections import Counter
from pathlib import Path

from pymavlink.dialects.v20 import common as mavlink

from mimopilot.codegen.native import NativeController, load_native
from mimopilot.common.console import print_table
from mimopilot.sitl.autopilot.autopilot import Autopilot
from mimopilot.sitl.autopilot.excitation_injector import Injector
from mimopilot.sitl.autopilot.flight_modes import Commander, Mode
from mimopilot.sitl.mavlink.vehicle.flight_recorder import StoredLog
from mimopilot.sitl.mavlink.vehicle.ground_station_link import GroundStationLink
from mimopilot.sitl.mavlink.vehicle.log_server import LogServer
from mimopilot.sitl.mavlink.vehicle.parameter_server import ParameterServer
from mimopilot.sitl.mavlink.vehicle.stations import Stations
from mimopilot.sitl.mavlink.vehicle.telemetry import Telemetry
from mimopilot.sitl.mavlink.vehicle.torque_injection import TorqueInjection
from mimopilot.sitl.mavlink.vehicle.vehicle_commands import VehicleCommands
from mimopilot.sitl.mavlink.vehicle.vehicle_state import VehicleState
from mimopilot.sitl.mavlink.wire.codec import KINDS, Codec
from mimopilot.sitl.mavlink.wire.signing import Signer
from mimopilot.sitl.physics.airframe import load_airframe
from mimopilot.sitl.physics.state_estimate import euler_angles
from tests.sitl.mavlink.running import PATIENCE_S

KEY = bytes(range(32))
FLOATS = (math.nan, math.inf, -math.inf, 3.4e38, -3.4e38, 1e-45, -0.0, 0.0, 1.0, -1.0, 123456.0)
INTEGERS = {"b": 8, "B": 8, "h": 16, "H": 16, "i": 32, "I": 32, "q": 64, "Q": 64}
#: Commands that are a valid change with any parameters; they are not sent.
ALWAYS_VALID = {mavlink.MAV_CMD_NAV_LAND}
CHECK_EVERY = 1000  # datagrams between checks that the vehicle still answers


class VehicleUnderAttack:
    """A hovering vehicle without a plant, with an attacker's sockets and an authorised ground station's codec."""

    def __init__(self, key=None):
        body = load_airframe("adam0")
        gains = body.default_gains()
        self.autopilot = Autopilot(body.airframe, gains, NativeController(load_native(gains), gains))
        self.vehicle = Commander(self.autopilot.hover)
        self.vehicle.armed, self.vehicle.mode, self.vehicle.now = True, Mode.HOLD, 100.0
        state = VehicleState(self.vehicle)
        self.injector = Injector(gains.Ts)
        self.excitation = TorqueInjection(self.injector, state)
        self.server = ParameterServer(self.autopilot.controller, gains, self.injector)
        telemetry = Telemetry(state)
        self.commands = VehicleCommands(self.vehicle, telemetry, self.reboot)
        self.signer = Signer(key) if key else None
        self.attacker = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.attacker.bind(("127.0.0.1", 0))
        self.stations = Stations(self.attacker.getsockname()[1], 0, 0, signer=self.signer)
        source = Path(__file__)
        logs = LogServer([StoredLog(source, source.stat().st_size, 0, 0)])
        self.ground = GroundStationLink(self.server, self.commands, telemetry, self.stations, logs)
        self.udp, self.tcp_address = self.stations.udp.getsockname(), self.stations.tcp.getsockname()
        self.tcp = socket.create_connection(self.tcp_address)
        self.friend = Codec(255, 190, Signer(key) if key else None)
        euler_angles(1.0, 0.0, 0.0, 0.0)  # compile now
        self.slowest = 0.0
        self.rebooted = False

    def reboot(self):
        self.rebooted = True

    def close(self):
        self.stations.close()
        self.attacker.close()
        self.tcp.close()

    def snapshot(self):
        """The state that must not change."""
        return (
            dict(self.server.values),
            self.autopilot.controller.state.tobytes(),
            (self.vehicle.armed, self.vehicle.mode, self.vehicle.vertical.landed, self.rebooted),
            self.injector.phase,
        )

    def turn(self):
        """Run the ground station part of the control loop once."""
        now = time.monotonic()
        begin = time.thread_time()
        self.ground.receive(now)
        self.slowest = max(self.slowest, time.thread_time() - begin)
        self.vehicle.said.clear()
        self.ground.send(now)

    def answers(self, message, over_tcp=False, wait=PATIENCE_S):
        """Empty the sockets, send a message, and return the kinds of the answers up to a PARAM_VALUE."""
        link = self.tcp if over_tcp else self.attacker
        drain(link)
        data = self.friend.pack(message)
        if over_tcp:
            link.sendall(data * 30)  # a false frame start may swallow some
        else:
            link.sendto(data, self.udp)
        heard, codec, end = [], Codec(255, 190), time.monotonic() + wait
        while "PARAM_VALUE" not in heard and time.monotonic() < end:
            self.turn()
            heard += [m.get_type() for m in codec.parse(drain(link))]
        return heard


def drain(link):
    """Read all data from a socket."""
    link.setblocking(False)
    data = b""
    try:
        while piece := link.recv(65536):
            data += piece
    except BlockingIOError:
        pass
    finally:
        link.setblocking(True)
    return data


def frame(number, payload, seq, signer=None):
    """An intact frame around any payload."""
    payload = payload.rstrip(b"\0") or b"\0"
    flags = mavlink.MAVLINK_IFLAG_SIGNED if signer else 0
    body = bytes([len(payload), flags, 0, seq, 255, 190]) + number.to_bytes(3, "little") + payload
    crc = mavlink.x25crc(body + bytes([KINDS[number].crc_extra])).crc
    whole = b"\xfd" + body + crc.to_bytes(2, "little")
    return signer.sign(whole) if signer else whole


class Attacks:
    """Seeded datagrams of every sort, by name; none is a valid change for a vehicle in the air."""

    def __init__(self, seed, target, replay=b""):
        self.random, self.signer = random.Random(seed), target.friend.signer
        self.known, self.names = sorted(target.stations.wanted), [name.encode() for name in target.server.index]
        self.commands = sorted(target.commands.handlers)
        self.all = sorted(KINDS)
        self.sorts = {
            "random bytes": self.noise,
            "behind a marker": lambda: self.random.choice([b"\xfd", b"\xfe"]) + self.noise(),
            "flipped bits": self.flipped,
            "truncated": self.truncated,
            "oversized": lambda: self.intact() + self.random.randbytes(self.random.randrange(65000)),
            "wrong checksum": self.wrong_checksum,
            "wrong target": lambda: self.intact(target=False),
            "extreme values": self.intact,
            "several in one": lambda: b"".join(self.intact() for _ in range(self.random.randrange(2, 30))),
            "other messages": lambda: self.intact(self.random.choice(self.all)),
            "bad parameters": self.bad_parameter,
        }
        if self.signer:
            change = mavlink.MAVLink_param_set_message(1, 1, b"MIMO_RP_RR", 0.123, 9)
            self.sorts |= {
                "unsigned change": lambda: Codec(255, 190).pack(change),
                "change with another key": lambda: Codec(255, 190, Signer(KEY[::-1])).pack(change),
                "change replayed": lambda: replay,
            }

    def noise(self):
        return self.random.randbytes(self.random.randrange(300))

    def flipped(self):
        data = bytearray(self.intact())
        for _ in range(self.random.randrange(1, 4)):
            data[self.random.randrange(len(data))] ^= 1 << self.random.randrange(8)
        return bytes(data)

    def truncated(self):
        data = self.intact()
        return data[: self.random.randrange(len(data))]

    def wrong_checksum(self):
        data = bytearray(self.intact())
        data[-1 - self.random.randrange(2)] ^= self.random.randrange(1, 256)
        return bytes(data)

    def intact(self, number=None, target=True):
        """An intact frame with extreme values, to this vehicle or to another."""
        number = self.random.choice(self.known) if number is None else number
        kind = KINDS[number]
        fields = {
            name: [self.value(code, int(count or 1)) for _ in range(1 if code == "s" else int(count or 1))]
            for name, (count, code) in zip(
                kind.ordered_fieldnames, re.findall(r"(\d*)([a-zA-Z])", kind.unpacker.format), strict=True
            )
        }
        for name in {"target_system", "target_component", "target"} & fields.keys():
            fields[name] = [self.random.choice([0, 1]) if target else self.random.randrange(2, 256)]
        if kind.msgname in ("COMMAND_LONG", "COMMAND_INT") and self.random.random() < 0.5:
            fields["command"] = [self.random.choice(self.commands)]
        if fields.get("command", [0])[0] in ALWAYS_VALID:
            fields["command"] = [0]
        if kind.msgname == "PARAM_SET" and fields["param_type"] == [9]:
            fields["param_type"] = [10]
        if kind.msgname == "SET_MODE":
            fields["custom_mode"] = [0xFFFFFFFF]
        values = [value for field in fields.values() for value in field]
        return self.wrap(number, kind.unpacker.pack(*values))

    def wrap(self, number, payload):
        """Build a frame; on a signed link half of them are signed with the key."""
        signer = self.signer if self.signer and self.random.random() < 0.5 else None
        return frame(number, payload, self.random.randrange(256), signer)

    def value(self, code, count):
        if code == "s":
            chosen = self.random.choice([*self.names, self.random.randbytes(count), b""])
            return chosen[:count]
        if code == "c":
            return self.random.randbytes(1)
        if code in "fd":
            return self.random.choice(FLOATS)
        bits, signed = INTEGERS[code], code.islower()
        low, high = (-(2 ** (bits - 1)), 2 ** (bits - 1) - 1) if signed else (0, 2**bits - 1)
        return self.random.choice([low, high, 0, 1, high - 1, low + 1, self.random.randint(low, high)])

    def bad_parameter(self):
        """PARAM_SET that must be refused: not finite, out of range, unknown, read-only or of another type."""
        name, value, kind = self.random.choice(
            [
                (self.random.choice(self.names), self.random.choice(FLOATS[:5]), 9),
                (self.random.choice(self.names), 1.0, self.random.choice([0, 1, 6, 8, 10, 255])),
                (self.random.randbytes(16), 0.1, 9),
                (b"MIMO_TS", 0.002, 9),
                (b"MIMO_EX_AX", 0.5, 9),
            ]
        )
        message = mavlink.MAVLink_param_set_message
        return self.wrap(message.id, message.unpacker.pack(value, 1, 1, name[:16], kind))


def attack(target, count, seed):
    """Send datagrams, a tenth of them into a TCP stream; return the count by sort. Raises when anything changed."""
    replay = target.friend.pack(mavlink.MAVLink_param_set_message(1, 1, b"MIMO_RP_RR", 0.12, 9))
    if target.signer:
        target.attacker.sendto(replay, target.udp)
        target.turn()
        if abs(target.server.values["MIMO_RP_RR"] - 0.12) > 1e-6:
            raise AssertionError("a signed change was not accepted")
        target.server.write("MIMO_RP_RR", 0.14, 9)
    attacks = Attacks(seed, target, replay)
    sent, before = Counter(), target.snapshot()
    question = mavlink.MAVLink_param_request_read_message(1, 1, b"MIMO_RP_RR", -1)
    for number in range(count):
        sort, make = attacks.random.choice(list(attacks.sorts.items()))
        data = make()
        sent[sort] += 1
        if number % 10:
            target.attacker.sendto(data, target.udp)
        else:
            target.tcp.sendall(data[:2000])
        target.turn()
        if target.snapshot() != before:
            raise AssertionError(f"datagram {number} ({sort}) changed the vehicle: {data.hex()}")
        if number % CHECK_EVERY == 0:
            for over_tcp in (False, True):
                if "PARAM_VALUE" not in target.answers(question, over_tcp):
                    raise AssertionError(f"after datagram {number} ({sort}) there is no answer, over TCP: {over_tcp}")
    return sent


def main():
    count = int(sys.argv[1]) if len(sys.argv) > 1 else 1_000_000
    seed = int(sys.argv[2]) if len(sys.argv) > 2 else 0
    for signed in (False, True):
        target = VehicleUnderAttack(KEY if signed else None)
        gc.collect()
        gc.freeze()  # as the host does
        begin = time.perf_counter()
        sent = attack(target, count // 2, seed + signed)
        seconds = time.perf_counter() - begin
        target.close()
        rows = [[sort, str(number)] for sort, number in sent.items()]
        rows.append(["all, and nothing changed", str(sent.total())])
        print_table(f"{'signed' if signed else 'unsigned'} link, seed {seed + signed}", ["datagrams", "number"], rows)
        print(f"{seconds:.0f} s; longest call of receive {1e3 * target.slowest:.2f} ms of processor time")


if __name__ == "__main__":
    main()
