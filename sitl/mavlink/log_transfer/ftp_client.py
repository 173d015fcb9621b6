"""MAVLink FTP, the ground station's end: list a folder, read a file by bursts, ask for its checksum.

A vehicle that loses its patience with an open file (PX4 after 10 s without a request), restarts, or runs out of
sessions is met by opening the file again. See `sitl.mavlink.ground_station.events` for how an exchange is run.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

from mimopilot.sitl.errors import SitlError
from mimopilot.sitl.mavlink.ground_station.events import ARDUPILOT, Exchange, FileReply, FileRequest
from mimopilot.sitl.mavlink.log_transfer.part_file import PartFile
from mimopilot.sitl.mavlink.log_transfer.transfer_client import TransferClient
from mimopilot.sitl.mavlink.wire.ftp import DATA_BYTES, SEQUENCES, FtpPacket, Nak, Opcode

# All chosen, unless a source is given:
#: Missing range from which a burst is requested; shorter ones are read piece by piece.
BURST_BYTES = 16 * DATA_BYTES
#: Pieces requested at once, and from ArduPilot, which queues 5 requests (GCS_FTP.h).
WINDOW, ARDUPILOT_WINDOW = 12, 4
#: Pieces read before it is asked again whether a burst is better.
READ_PIECES = 400
#: Silence that ends a burst: this many mean intervals between its pieces, within these limits (s).
QUIET_INTERVALS, QUIET_S = 12, (0.15, 2.0)
#: Bursts without a new byte after which only pieces are read.
EMPTY_BURSTS = 6
#: Interval of a sign of life during a burst, s: PX4 frees its buffers 2 s after the last request, closes 8 s later.
ALIVE_S = 1.5
#: Times that a file is opened again without a new byte in between.
REOPEN = 5
#: Least speed of a vehicle's checksum, bytes/s: PX4 reads 256 bytes at a time, and sends nothing meanwhile.
CHECKSUM_SPEED = 100e3


class FolderEntry(NamedTuple):
    """A file, or a folder (`size` None)."""

    name: str
    size: int | None


@dataclass
class _Burst:
    """A burst under way.

    Attributes
    ----------
    sequence, offset : int
        Of its request.
    heard, interval : float, s
        Time of its last piece; mean interval between two.
    over_at : float, s
        Time at which silence ends it.
    pieces, chunk : int
        Their number, and size.
    """

    sequence: int
    offset: int
    heard: float
    over_at: float
    interval: float
    pieces: int = 0
    chunk: int = DATA_BYTES

    def holds(self, packet: FtpPacket, size: int) -> bool:
        """Whether a piece is of this burst; one of an earlier transfer may arrive late."""
        count = (packet.sequence - self.sequence - 1) % SEQUENCES
        last = packet.offset + len(packet.data) >= size
        chunk = self.chunk if last else len(packet.data)
        return packet.offset == self.offset + count * chunk

    def note(self, packet: FtpPacket, now: float, size: int) -> None:
        """Record a piece."""
        if packet.offset + len(packet.data) < size:
            self.chunk = len(packet.data)
        if self.pieces:
            self.interval += (now - self.heard - self.interval) / 8
        self.pieces += 1
        self.heard = now
        self.over_at = now + min(max(QUIET_INTERVALS * self.interval, QUIET_S[0]), QUIET_S[1])


def grown(name: str, before: int, now: int) -> SitlError:
    """The error that a log has another size than before, bytes."""
    sizes = f"has {now} bytes now, and had {before}"
    advice = "the vehicle is still writing it; disarm it, or stop its logger"
    return SitlError(f"{name}: {sizes}: {advice}", exit_code=1)


class FtpClient:
    """Files of one vehicle.

    Parameters
    ----------
    client : TransferClient
        After `await_heartbeat`.
    """

    def __init__(self, client: TransferClient) -> None:
        self.client = client
        # Not from 0: answers to an earlier run may still arrive.
        self._sequence = round(1000 * client.now) % SEQUENCES
        self._session = 0
        self._interval = QUIET_S[1] / QUIET_INTERVALS
        self._bursts = True
        self._empty_bursts = 0

    def _next(self, opcode: int, session: int = 0, offset: int = 0, data: bytes = b"", size: int = 0) -> FtpPacket:
        self._sequence = (self._sequence + 1) % SEQUENCES
        return FtpPacket(self._sequence, session, opcode, offset=offset, data=data, size=size)

    def _address(self, packet: FtpPacket) -> FileRequest:
        assert self.client.vehicle is not None
        return FileRequest(self.client.vehicle.system, self.client.vehicle.component, packet)

    def _exchange(self, send: Sequence[FtpPacket], wake: float) -> Exchange[list[FtpPacket]]:
        found = yield from self.client.receive([self._address(packet) for packet in send], wake)
        return [message.packet for message in found if isinstance(message, FileReply)]

    def ask(
        self, opcode: int, path: str = "", offset: int = 0, seconds: float | None = None, size: int = 0
    ) -> Exchange[FtpPacket | None]:
        """Reply to one request; None: none within `seconds` (by default the client's timeout).

        If all sessions are taken, by a download that was interrupted, they are closed.
        """
        for _ in range(REOPEN):
            reply = yield from self._request(opcode, path, offset, seconds, size)
            if reply is None or reply.code != Nak.NO_SESSIONS:
                break
            yield from self._request(Opcode.RESET)
        return reply

    def _request(
        self, opcode: int, path: str = "", offset: int = 0, seconds: float | None = None, size: int = 0
    ) -> Exchange[FtpPacket | None]:
        """Reply to a request, which is repeated with its sequence number: the vehicle then repeats its reply."""
        client = self.client
        packet = self._next(opcode, self._session, offset, path.encode(), size)
        begun, tries, due = client.now, 0, client.now
        until = begun + (client.timeout if seconds is None else seconds)
        while client.now < until:
            send = []
            if client.now >= due:
                send = [packet]
                due, tries = client.now + client.round_trip.wait(tries), tries + 1
            for reply in (yield from self._exchange(send, min(due, until))):
                if reply.sequence != (packet.sequence + 1) % SEQUENCES:
                    continue
                if reply.request != opcode:  # the end of a burst, repeated because it had this number
                    packet = self._next(opcode, self._session, offset, path.encode(), size)
                    continue
                if tries == 1:
                    client.round_trip.note(client.now - begun)
                if reply.code not in (Nak.SESSION, Nak.NO_SESSIONS):
                    # ArduPilot opens a session for every request that names none, and soon has none left.
                    self._session = reply.session
                return reply
        return None

    def list_folder(self, path: str, seconds: float | None = None) -> Exchange[list[FolderEntry] | FtpPacket | None]:
        """Entries of a folder; the NAK if it cannot be listed; None if nothing answers within `seconds`."""
        entries: list[FolderEntry] = []
        index = 0
        while True:
            reply = yield from self.ask(Opcode.LIST, path, index, seconds)
            if reply is None and index:
                raise SitlError(f"{path}: the vehicle stopped answering while it listed the folder", exit_code=1)
            if reply is None or reply.code not in (0, Nak.END):
                return reply
            found = [text for text in reply.data.split(b"\0") if text] if not reply.code else []
            if not found:
                return entries
            index += len(found)  # skipped entries count
            for text in found:
                name, _, size = text[1:].decode("utf-8", "replace").partition("\t")
                if text[:1] == b"D" and name not in (".", ".."):
                    entries.append(FolderEntry(name, None))
                elif text[:1] == b"F":
                    entries.append(FolderEntry(name, int(size) if size.isdigit() else 0))

    def read_start(self, path: str) -> Exchange[bytes]:
        """The first bytes of a file; none if it cannot be read."""
        reply = yield from self.ask(Opcode.OPEN, path)
        if reply is None or reply.code:
            return b""
        reply = yield from self.ask(Opcode.READ, offset=0, size=DATA_BYTES)
        yield from self._close()
        return reply.data if reply is not None and not reply.code else b""

    def checksum(self, path: str, size: int) -> Exchange[int | None]:
        """`wire.ftp.crc32` of a file on the vehicle; None: it cannot tell."""
        tries, self.client.tries = self.client.tries, self.client.tries + round(size / CHECKSUM_SPEED / 0.5)
        try:
            reply = yield from self.ask(Opcode.CRC, path)
        finally:
            self.client.tries = tries
        if reply is None or reply.code or len(reply.data) != 4:
            return None
        return int.from_bytes(reply.data, "little")

    def read_file(self, path: str, part: PartFile) -> Exchange[None]:
        """Read what is missing of a file.

        Raises
        ------
        SitlError
            If the vehicle refuses, has another size than the part, or sends nothing.
        """
        self.client.begin()
        left, opened = part.missing.total, 0
        while part.missing:
            session = yield from self._open(path, part.size)
            refusal = yield from self._read(session, part)
            yield from self._close()
            if refusal is None:
                continue
            if refusal.code == Nak.END:
                raise SitlError(f"{path}: ends before its {part.size} bytes: it has become shorter", exit_code=1)
            opened = opened + 1 if part.missing.total == left else 0
            left = part.missing.total
            if opened == REOPEN:
                raise SitlError(f"{path}: the vehicle cannot read it: {refusal.reason}", exit_code=1)

    def _open(self, path: str, size: int) -> Exchange[int]:
        """Open a file; returns the session."""
        reply = yield from self.ask(Opcode.OPEN, path)
        if reply is not None and reply.code == Nak.FAIL:  # ArduPilot: this session has a file open
            yield from self.ask(Opcode.RESET)
            reply = yield from self.ask(Opcode.OPEN, path)
        if reply is None:
            raise SitlError(f"{path}: the vehicle does not answer the request to open it", exit_code=1)
        if reply.code:
            raise SitlError(f"{path}: the vehicle cannot open it: {reply.reason}", exit_code=1)
        held = int.from_bytes(reply.data[:4], "little")
        if held != size:
            raise grown(path, size, held)
        return reply.session

    def _close(self) -> Exchange[None]:
        """Close the file; without an answer it closes itself."""
        yield from self.ask(Opcode.TERMINATE, seconds=4 * self.client.round_trip.timeout)

    def stop(self) -> FileRequest:
        """Request to close all files, for a download that is interrupted."""
        return self._address(self._next(Opcode.RESET))

    def _read(self, session: int, part: PartFile) -> Exchange[FtpPacket | None]:
        """Read until nothing is missing; returns a NAK that prevents it."""
        refusal: FtpPacket | None = None
        while part.missing and refusal is None:
            start, length = part.missing.pieces(part.size, 1)[0]
            if length >= BURST_BYTES and self._bursts:
                refusal = yield from self._read_burst(session, start, part)
            else:
                refusal = yield from self._read_pieces(session, part)
        return refusal

    def _read_burst(self, session: int, start: int, part: PartFile) -> Exchange[FtpPacket | None]:
        """Read by one burst from `start` on; returns a NAK that ended it early."""
        client, left = self.client, part.missing.total
        request = self._next(Opcode.BURST, session, start, size=DATA_BYTES)
        first = client.now + max(client.round_trip.timeout, QUIET_S[0])
        burst = _Burst(request.sequence, start, client.now, first, self._interval)
        send, alive, over = [request], client.now + ALIVE_S, False
        refusal: FtpPacket | None = None
        while not over and client.now < burst.over_at:
            for packet in (yield from self._exchange(send, min(burst.over_at, alive))):
                if packet.request != Opcode.BURST or packet.session != session:
                    continue
                if packet.opcode == Opcode.NAK:
                    ahead = (packet.sequence - request.sequence) % SEQUENCES
                    if 0 < ahead <= SEQUENCES // 2:
                        over, refusal = True, None if packet.code == Nak.END else packet
                elif burst.holds(packet, part.size):
                    client.store(part, packet.offset, packet.data)
                    burst.note(packet, client.now, part.size)
                    if 0 < (packet.sequence - self._sequence) % SEQUENCES <= SEQUENCES // 2:
                        self._sequence = packet.sequence
                    over = over or packet.complete or packet.offset + len(packet.data) >= part.size
            client.check_progress()
            send = []
            if client.now >= alive:
                alive = client.now + ALIVE_S
                send = [self._next(Opcode.NONE, session)]
        self._interval = burst.interval
        self._empty_bursts = self._empty_bursts + 1 if part.missing.total == left else 0
        if self._empty_bursts >= EMPTY_BURSTS or (refusal is not None and refusal.code == Nak.UNKNOWN_COMMAND):
            self._bursts = False
            refusal = None
        return refusal

    def _read_pieces(self, session: int, part: PartFile) -> Exchange[FtpPacket | None]:
        """Read pieces, several at once; returns a NAK that ended it early."""
        client = self.client
        assert client.vehicle is not None
        window = ARDUPILOT_WINDOW if client.vehicle.autopilot == ARDUPILOT else WINDOW
        waiting = part.missing.pieces(DATA_BYTES, READ_PIECES)[::-1]
        pending: dict[tuple[int, int], tuple[float, float, int]] = {}  # piece -> begun, due, tries
        sent: dict[int, tuple[int, int]] = {}  # sequence number of a reply -> piece
        while waiting or pending:
            while waiting and len(pending) < window:
                pending[waiting.pop()] = (client.now, client.now, 0)
            send = []
            for piece, (begun, due, tries) in pending.items():
                if due <= client.now:
                    packet = self._next(Opcode.READ, session, piece[0], size=piece[1])
                    sent[(packet.sequence + 1) % SEQUENCES] = piece
                    pending[piece] = (begun, client.now + client.round_trip.wait(tries), tries + 1)
                    send.append(packet)
            for packet in (yield from self._exchange(send, min(due for _, due, _ in pending.values()))):
                asked = sent.get(packet.sequence)
                if packet.request != Opcode.READ or asked is None:
                    continue
                if packet.opcode == Opcode.NAK:
                    return packet
                if asked not in pending or packet.offset != asked[0]:
                    continue
                begun, _, tries = pending.pop(asked)
                if tries == 1:
                    client.round_trip.note(client.now - begun)
                client.store(part, packet.offset, packet.data[: asked[1]])
            client.check_progress()
        return None
