"""Vehicles with logs for the simulated link: our own server, and a scripted one with the habits and faults
of others.
"""

import random
import struct

from mimopilot.sitl.mavlink.ground_station.connection import from_mavlink, to_mavlink
from mimopilot.sitl.mavlink.ground_station.events import (
    EndLogs,
    FileReply,
    FileRequest,
    Heartbeat,
    LogData,
    LogEntry,
    RequestLogData,
    RequestLogs,
    StatusText,
)
from mimopilot.sitl.mavlink.vehicle.flight_recorder import StoredLog
from mimopilot.sitl.mavlink.vehicle.log_server import LogServer
from mimopilot.sitl.mavlink.vehicle.stations import Station
from mimopilot.sitl.mavlink.wire.codec import Codec
from mimopilot.sitl.mavlink.wire.ftp import crc32

GENERIC, ARDUPILOT, PX4 = 0, 3, 12


def content(size, seed=1):
    return random.Random(seed).randbytes(size)


class OwnVehicle:
    """The vehicle's own server, every message packed and parsed as on a wire."""

    def __init__(self, folder, *sizes):
        self.logs = []
        for k, size in enumerate(sizes):
            path = folder / f"flight-{k + 1}.ulg"
            path.parent.mkdir(exist_ok=True)
            path.write_bytes(content(size, k))
            self.logs.append(StoredLog(path, size, crc32(path.read_bytes()), 1_700_000_000 + k))
        self.server = LogServer(self.logs)
        self.station = Station(Codec())
        self.to_vehicle, self.to_ground = Codec(255, 190), Codec()
        self.armed = False

    def heartbeat(self):
        return [Heartbeat(1, 1, GENERIC, self.armed, 0, 2)]

    def answer(self, order):
        (message,) = self.to_ground.parse(self.to_vehicle.pack(to_mavlink(order)))
        handler = self.server.handlers.get(message.get_type())
        if handler is None:
            return []
        self.station.answers.extend(handler(message, self.station))
        sent = b"".join(self.to_ground.pack(m) for m in iter(self.station.take, None))
        return [from_mavlink(m) for m in self.to_vehicle.parse(sent)]


class ScriptedLogs:
    """PX4 or ArduPilot as their sources say: one session (PX4) or numbered ones, who answers what, and when.

    Faults: see the places where `fault` is read. `now` is the link's clock.
    """

    def __init__(self, files, autopilot=PX4, fault="", folder="/fs/microsd/log"):
        self.files = {f"{folder}/{name}": data for name, data in files.items()}
        self.folder, self.autopilot, self.fault = folder, autopilot, fault
        self.armed, self.listed = False, False
        self.open, self.session = None, 0
        self.last = None
        self.asked = 0.0
        self.now = lambda: 0.0
        self.counts = {}
        self.sent = 0

    def heartbeat(self):
        return [] if self.fault == "gone" else [Heartbeat(1, 1, self.autopilot, self.armed, 0, 2)]

    def answer(self, order):
        if self.fault == "gone" or (self.fault == "mute" and not isinstance(order, RequestLogs)):
            return []
        if isinstance(order, FileRequest) and self.fault not in ("no ftp", "neither"):
            return [FileReply(1, 1, reply) for reply in self.ftp(order.packet)]
        if isinstance(order, RequestLogs | RequestLogData | EndLogs) and self.fault != "neither":
            return self.log_protocol(order)
        return []

    # FTP

    def ftp(self, packet):
        self.counts[packet.opcode] = self.counts.get(packet.opcode, 0) + 1
        if self.open is not None and self.now() > self.asked + 10.0:  # PX4 closes a file after 10 s
            self.open = None
        self.asked = self.now()
        if self.fault == "nak":
            return [packet.refuse(7)]
        if self.last is not None and self.last.sequence == (packet.sequence + 1) % 65536:
            return [self.last]
        self.last = None
        if packet.opcode == 15:
            return self.burst(packet)
        reply = self.reply(packet)
        if len(reply.data) <= 4 and reply.data[:1] != b"\x05":  # the short replies that PX4 keeps
            self.last = reply
        return [reply]

    def reply(self, packet):
        path = packet.path
        if packet.opcode in (0, 2):
            if packet.opcode == 2:
                self.open, self.session = None, 0
            return packet.reply()
        if packet.opcode == 1:
            found, self.open = self.open, None
            if found and self.fault == "grows late":
                self.files[found] += b"more"
            return packet.reply() if found else packet.refuse(4)
        if packet.opcode == 3:
            return self.list(packet, path)
        if packet.opcode == 4:
            if self.open is not None:
                return packet.refuse(5)
            if path not in self.files:
                return packet.refuse(10)
            self.open = path
            if self.autopilot == ARDUPILOT:
                self.session += 1
            if self.fault == "grows":
                self.files[path] += b"more"
            return packet.reply(struct.pack("<I", len(self.files[path])))._replace(session=self.session)
        if packet.opcode == 5:
            return self.read(packet, packet.offset, packet.size)
        if packet.opcode == 14:
            if self.fault == "no checksum":
                return packet.refuse(7)
            wrong = 1 if self.fault == "wrong checksum" else 0
            return packet.reply(struct.pack("<I", crc32(self.files[path]) ^ wrong))
        return packet.refuse(7)

    def list(self, packet, path):
        if self.fault == "unreadable card":
            return packet.refuse(2, 5)
        if self.autopilot == ARDUPILOT and packet.session == 0:
            self.session += 1
            if self.session > 3:
                return packet.refuse(5)
            packet = packet._replace(session=self.session)
        names = [name[len(path) + 1 :] for name in self.files if name.startswith(f"{path}/")]
        if not names and path != self.folder:
            return packet.refuse(10)
        folders = sorted({name.split("/")[0] for name in names if "/" in name})
        entries = ["S", "S", *(f"D{name}" for name in folders)]
        entries += [f"F{name}\t{len(self.files[f'{path}/{name}'])}" for name in names if "/" not in name]
        data = b""
        for entry in entries[packet.offset :]:
            if len(data) + len(entry) + 1 > 100:
                break
            data += entry.encode() + b"\0"
        return packet.reply(data)._replace(session=self.session) if data else packet.refuse(6)

    def read(self, packet, offset, size):
        if self.open is None or packet.session != self.session:
            return packet.refuse(4)
        data = self.files[self.open]
        if self.fault == "bad sector" and offset + size > len(data) // 2:
            return packet.refuse(2, 5)
        if offset >= len(data):
            return packet.refuse(6)
        return packet.reply(data[offset : offset + size])

    def burst(self, packet):
        if self.fault == "no bursts":
            return [packet.refuse(7)]
        replies, offset, request = [], packet.offset, packet
        limit = 35_000 if self.autopilot == PX4 else 2000 * 239
        while True:
            reply = self.read(request, offset, 239)._replace(offset=offset, request=15)
            offset += len(reply.data)
            done = reply.opcode == 128 and offset - packet.offset > limit
            replies.append(reply._replace(complete=done))
            if done or reply.opcode == 129:
                return replies
            request = request._replace(sequence=(request.sequence + 1) % 65536)

    # LOG_REQUEST_LIST, LOG_REQUEST_DATA

    def log_protocol(self, order):
        first = 1 if self.autopilot == ARDUPILOT else 0
        numbered = dict(enumerate((self.files[name] for name in self.files if name[-3:] != "TXT"), first))
        if self.armed and self.autopilot == ARDUPILOT:
            return [StatusText(1, 1, "Disarm for log download")]
        if isinstance(order, RequestLogs):
            self.listed = True
            if not numbered and self.autopilot == ARDUPILOT:
                return [LogEntry(1, 1, 0, 0, 0, 0)]
            return [
                LogEntry(1, 1, number, len(numbered), len(data), 1_700_000_000 - number)
                for number, data in numbered.items()
                if order.first <= number <= order.last
            ]
        if isinstance(order, EndLogs) or not self.listed or order.id not in numbered:
            return []
        data = numbered[order.id]
        end = min(order.offset + order.length, len(data))
        if self.fault == "bad sector":
            end = min(end, len(data) // 2 // 90 * 90)
        pieces = [LogData(1, 1, order.id, k, data[k : min(k + 90, end)]) for k in range(order.offset, end, 90)]
        if self.fault == "grows":
            self.files = {name: content + b"more" for name, content in self.files.items()}
        return pieces or [LogData(1, 1, order.id, order.offset, b"")]
