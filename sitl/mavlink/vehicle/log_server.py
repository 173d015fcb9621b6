"""Serves the vehicle's logs: by FTP, read only, and by LOG_REQUEST_LIST and LOG_REQUEST_DATA.

Only logs that this vehicle has written can be read. A burst, or a range of a log, becomes the station's stream: it is
sent piece by piece whenever nothing else is waiting. One stream a station; a new request replaces it.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, BinaryIO
from weakref import WeakKeyDictionary

from pymavlink.dialects.v20 import common as mavlink

from mimopilot.sitl.mavlink.vehicle.flight_recorder import StoredLog
from mimopilot.sitl.mavlink.vehicle.stations import Station
from mimopilot.sitl.mavlink.wire.ftp import DATA_BYTES, LOG_FOLDER, FtpPacket, Nak, Opcode

#: The folder of logs, beside `LOG_FOLDER`: as in PX4's simulator.
FOLDER = "log"
#: Pieces in one burst: 36 kB, about as much as PX4 sends; a socket's buffer holds them.
BURST_PIECES = 150
LOG_BYTES = 90  # length of LOG_DATA.data

Handler = Callable[[Any, Station], list[Any]]


@dataclass
class _OpenFile:
    """A station's open file; its last reply, and the request that it answered."""

    stream: BinaryIO | None = None
    size: int = 0
    request: FtpPacket | None = None
    reply: FtpPacket | None = None


class LogServer:
    """Answers requests for logs.

    Parameters
    ----------
    logs : sequence of StoredLog
        Those of the recorder; it may grow.

    Attributes
    ----------
    handlers : dict
        Message name -> function that returns the answers to a message of a station.
    """

    def __init__(self, logs: Sequence[StoredLog]) -> None:
        self.logs = logs
        self._files: WeakKeyDictionary[Station, _OpenFile] = WeakKeyDictionary()
        self.handlers: dict[str, Handler] = {
            "FILE_TRANSFER_PROTOCOL": self._answer_ftp,
            "LOG_REQUEST_LIST": self._list,
            "LOG_REQUEST_DATA": self._send_log,
            "LOG_REQUEST_END": self._end,
        }

    def _list(self, message: Any, station: Station) -> list[Any]:
        """LOG_ENTRY of each log asked for; without logs one with the number 0, as ArduPilot's."""
        count = len(self.logs)
        if not count:
            return [mavlink.MAVLink_log_entry_message(0, 0, 0, 0, 0)]
        station.stream = (
            mavlink.MAVLink_log_entry_message(number, count, count - 1, log.time, log.size)
            for number, log in enumerate(self.logs)
            if message.start <= number <= message.end
        )
        return []

    def _send_log(self, message: Any, station: Station) -> list[Any]:
        if message.id < len(self.logs):
            station.stream = _log_data(self.logs[message.id], message.id, message.ofs, message.count)
        return []

    def _end(self, message: Any, station: Station) -> list[Any]:
        station.stream = None
        return []

    def _answer_ftp(self, message: Any, station: Station) -> list[Any]:
        request = FtpPacket.unpack(bytes(message.payload))
        file = self._files.setdefault(station, _OpenFile())
        sender = message.get_srcSystem(), message.get_srcComponent()
        if request.opcode == Opcode.BURST and file.stream is not None:
            station.stream = (_ftp_message(sender, packet) for packet in _burst(file.stream, request))
            return []
        # A request that is repeated gets the same reply; otherwise a file would be opened twice.
        if request != file.request or file.reply is None:
            file.request, file.reply = request, self._reply(request, file, station)
        return [_ftp_message(sender, file.reply)]

    def _reply(self, request: FtpPacket, file: _OpenFile, station: Station) -> FtpPacket:
        if request.opcode == Opcode.NONE:
            return request.reply()
        if request.opcode in (Opcode.TERMINATE, Opcode.RESET):
            if file.stream is not None:
                file.stream.close()
            file.stream = station.stream = None
            return request.reply()
        if request.opcode == Opcode.LIST:
            return self._folder(request)
        if request.opcode in (Opcode.OPEN, Opcode.CRC):
            folder, _, name = request.path.strip("/").rpartition("/")
            found = [log for log in self.logs if log.path.name == name and folder in (FOLDER, LOG_FOLDER)]
            if not found:
                return request.refuse(Nak.NOT_FOUND)
            if request.opcode == Opcode.CRC:
                return request.reply(found[-1].checksum.to_bytes(4, "little"))
            return self._open(request, file, found[-1])
        if request.opcode in (Opcode.READ, Opcode.BURST):
            return request.refuse(Nak.SESSION) if file.stream is None else _piece(file.stream, request)
        return request.refuse(Nak.UNKNOWN_COMMAND)

    def _folder(self, request: FtpPacket) -> FtpPacket:
        """Entries of a folder from an index on, as many as fit."""
        path = request.path.strip("/")
        if path not in ("", FOLDER, LOG_FOLDER):
            return request.refuse(Nak.NOT_FOUND)
        entries = [f"F{log.path.name}\t{log.size}" for log in self.logs] if path else [f"D{FOLDER}"]
        text = b""
        for entry in entries[request.offset :]:
            more = entry.encode() + b"\0"
            if len(text) + len(more) > DATA_BYTES:
                break
            text += more
        return request.reply(text) if text else request.refuse(Nak.END)

    @staticmethod
    def _open(request: FtpPacket, file: _OpenFile, log: StoredLog) -> FtpPacket:
        if file.stream is not None:
            return request.refuse(Nak.NO_SESSIONS)
        try:
            file.stream = log.path.open("rb")
        except FileNotFoundError:
            return request.refuse(Nak.NOT_FOUND)
        except OSError as error:
            return request.refuse(Nak.ERRNO, error.errno or 0)
        return request.reply(log.size.to_bytes(4, "little"))._replace(session=0)


def _ftp_message(to: tuple[int, int], packet: FtpPacket) -> Any:
    return mavlink.MAVLink_file_transfer_protocol_message(0, *to, packet.pack())


def _piece(stream: BinaryIO, request: FtpPacket) -> FtpPacket:
    """Reply to a request to read."""
    try:
        data = os.pread(stream.fileno(), min(request.size, DATA_BYTES), request.offset)
    except OSError as error:
        return request.refuse(Nak.ERRNO, error.errno or 0)
    return request.reply(data) if data else request.refuse(Nak.END)


def _burst(stream: BinaryIO, request: FtpPacket) -> Iterator[FtpPacket]:
    """Pieces from the offset on; the last one, or a NAK, ends it."""
    for k in range(BURST_PIECES):
        if stream.closed:
            return
        reply = _piece(stream, request)
        yield reply._replace(complete=k == BURST_PIECES - 1)
        if reply.opcode == Opcode.NAK:
            return
        request = request._replace(sequence=reply.sequence, offset=request.offset + len(reply.data))


def _log_data(log: StoredLog, number: int, offset: int, count: int) -> Iterator[Any]:
    """LOG_DATA of a range; an empty one if it cannot be read, as ArduPilot's."""
    end = min(offset + count, log.size)
    try:
        with log.path.open("rb") as stream:
            while offset < end:
                data = os.pread(stream.fileno(), min(LOG_BYTES, end - offset), offset)
                yield _data_message(number, offset, data)
                if not data:
                    return
                offset += len(data)
    except OSError:
        yield _data_message(number, offset, b"")


def _data_message(number: int, offset: int, data: bytes) -> Any:
    return mavlink.MAVLink_log_data_message(number, offset, len(data), data.ljust(LOG_BYTES, b"\0"))
