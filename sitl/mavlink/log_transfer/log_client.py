"""MAVLink's log protocol, the ground station's end: LOG_REQUEST_LIST and LOG_REQUEST_DATA.

It has no checksum of a log and no file names, but vehicles without FTP have it. ArduPilot ignores a request while it
answers another one; PX4 answers the last one only. So one range is requested at a time.
"""

from __future__ import annotations

from mimopilot.sitl.errors import SitlError
from mimopilot.sitl.mavlink.ground_station.events import (
    EndLogs,
    Exchange,
    LogData,
    LogEntry,
    RequestLogData,
    RequestLogs,
)
from mimopilot.sitl.mavlink.log_transfer.part_file import PartFile
from mimopilot.sitl.mavlink.log_transfer.transfer_client import TransferClient

#: Length of LOG_DATA.data, bytes.
PIECE_BYTES = 90
#: All numbers, in LOG_REQUEST_LIST.
LAST = 0xFFFF
# All chosen:
#: Bytes requested at once: less than a socket's buffer holds.
RANGE_BYTES = 256 * PIECE_BYTES
#: Received bytes between two missing ranges that are requested again rather than with a request for each range.
MERGE_BYTES = 40 * PIECE_BYTES
#: Silence (s) after which the list is requested again.
LIST_QUIET_S = 1.0
#: Silence that ends a range: this many mean intervals between its pieces, within these limits (s).
QUIET_INTERVALS, QUIET_S = 12, (0.15, 2.0)
#: Empty pieces before the vehicle is taken to be unable to read on.
EMPTY_PIECES = 3


class LogClient:
    """Logs of one vehicle.

    Parameters
    ----------
    client : TransferClient
        After `await_heartbeat`.
    """

    def __init__(self, client: TransferClient) -> None:
        self.client = client

    def _address(self) -> tuple[int, int]:
        assert self.client.vehicle is not None
        return self.client.vehicle.system, self.client.vehicle.component

    def list_logs(self, seconds: float | None = None) -> Exchange[list[LogEntry] | None]:
        """All logs; None: the vehicle answers none of the requests within `seconds` (by default the timeout)."""
        client = self.client
        entries: dict[int, LogEntry] = {}
        total, heard, due = None, client.now, client.now
        while client.now < heard + (client.timeout if seconds is None else seconds):
            send = []
            if client.now >= due:
                send, due = [RequestLogs(*self._address(), 0, LAST)], client.now + LIST_QUIET_S
            for message in (yield from client.receive(send, due)):
                if not isinstance(message, LogEntry):
                    continue
                if message.total != total:  # a first list, or another log has begun
                    entries.clear()
                total, heard, due = message.total, client.now, client.now + LIST_QUIET_S
                if message.total:
                    entries[message.id] = message
                if len(entries) == message.total:
                    return [entries[number] for number in sorted(entries)]
        if entries:
            raise SitlError(f"the vehicle listed {len(entries)} of its {total} logs only", exit_code=1)
        return None

    def read_log(self, number: int, part: PartFile) -> Exchange[None]:
        """Read what is missing of a log.

        Raises
        ------
        SitlError
            If the vehicle sends nothing, or reports an end before the log's size.
        """
        client = self.client
        client.begin()
        empty, before = 0, -1
        interval = QUIET_S[1] / QUIET_INTERVALS
        while part.missing:
            start, end = part.missing.span(MERGE_BYTES, RANGE_BYTES)
            begun, place, heard = client.now, start, 0.0
            send = [RequestLogData(*self._address(), number, start, end - start)]
            until = client.now + max(client.round_trip.timeout, QUIET_S[0])
            while place < end and client.now < until:
                for message in (yield from client.receive(send, until)):
                    if not isinstance(message, LogData) or message.id != number:
                        continue
                    empty = 0 if message.data else empty + 1
                    if empty == EMPTY_PIECES:
                        end_at = f"{message.offset} of {part.size} bytes"
                        raise SitlError(f"log {number}: the vehicle can read only {end_at}", exit_code=1)
                    client.store(part, message.offset, message.data)
                    if heard:
                        interval += (client.now - heard - interval) / 8
                    elif message.offset == start != before:  # an answer to the first request for it
                        client.round_trip.note(client.now - begun)
                    heard = client.now
                    if start <= message.offset < end:
                        place = max(place, message.offset + max(len(message.data), 1))
                    until = client.now + min(max(QUIET_INTERVALS * interval, QUIET_S[0]), QUIET_S[1])
                send = []
                client.check_progress()
            before = start

    def stop(self) -> EndLogs:
        """Request to send no more; ArduPilot then continues its other work."""
        return EndLogs(*self._address())
