"""Logs of one vehicle: find them by FTP or by the log protocol, choose one, download and verify it."""

from __future__ import annotations

import re
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path, PurePosixPath

from mimopilot.common.errors import check_choice
from mimopilot.common.files import inside
from mimopilot.sitl.errors import SitlError
from mimopilot.sitl.mavlink.ground_station.events import ARDUPILOT, Exchange
from mimopilot.sitl.mavlink.ground_station.vehicle_kinds import describe
from mimopilot.sitl.mavlink.log_transfer.ftp_client import FtpClient, grown
from mimopilot.sitl.mavlink.log_transfer.log_client import LogClient
from mimopilot.sitl.mavlink.log_transfer.part_file import PartFile, different, file_crc32
from mimopilot.sitl.mavlink.log_transfer.transfer_client import TransferClient
from mimopilot.sitl.mavlink.wire.ftp import LOG_FOLDER, FtpPacket, Nak

#: Folders of logs: the guide's, PX4's on a board and in its simulator, ArduPilot's on a board and in its simulator.
FOLDERS = (LOG_FOLDER, "/fs/microsd/log", "/log", "/APM/LOGS", "/logs")
SUFFIXES = (".ulg", ".bin")
#: ArduPilot's file with the number of its last log; numbers begin again after LOG_MAX_FILES.
LAST_LOG = "LASTLOG.TXT"
#: Time (s) in which a vehicle with FTP answers, even at 30 % loss each way: 8 tries; chosen.
FTP_ANSWER_S = 6.0
#: Pause (s) in which a log that is being written grows; chosen.
GROWTH_S = 0.5
#: Protocols, by their names for the user.
PROTOCOLS = ("auto", "ftp", "log")
#: A folder that PX4 names by the date.
DATED = re.compile(r"\d{4}-\d\d-\d\d/")
AGAIN = "give the same command again to go on"


@dataclass(frozen=True)
class VehicleLog:
    """A log on a vehicle.

    Attributes
    ----------
    name : str
        By FTP its path in the folder of logs, by the log protocol its number.
    size : int, bytes
    time : int or None, s since 1970
        As the vehicle reports it; FTP reports none.
    path : str
        On the vehicle; empty by the log protocol.
    """

    name: str
    size: int
    time: int | None = None
    path: str = ""

    def file_name(self, autopilot: int) -> str:
        """Name of the downloaded file: one that is safe in any folder."""
        if self.path:
            return re.sub(r"[^A-Za-z0-9._-]", "_", self.name.replace("/", "-")).lstrip(".-") or "log"
        when = datetime.fromtimestamp(self.time, UTC).strftime("%Y-%m-%d-%H_%M_%S") if self.time else str(self.size)
        return f"log{self.name.zfill(3)}-{when}{'.bin' if autopilot == ARDUPILOT else '.ulg'}"


@dataclass(frozen=True)
class Download:
    """A log that was downloaded.

    Attributes
    ----------
    log : VehicleLog
    path : Path
        Of the file.
    protocol : str
        ``ftp`` or ``log``.
    verified : str
        ``crc32``: its checksum is the vehicle's; ``size``: its size only is.
    written : bool
        False: the file was there already.
    resumed : int
        Bytes that an earlier download had left.
    """

    log: VehicleLog
    path: Path
    protocol: str
    verified: str
    written: bool = True
    resumed: int = 0


class VehicleLogs:
    """The logs of a vehicle, after `find`.

    Parameters
    ----------
    client : TransferClient
        Before `await_heartbeat`.

    Attributes
    ----------
    protocol : str
        ``ftp`` or ``log``: how they were found.
    logs : list of VehicleLog
        In the order of their names or numbers.
    """

    def __init__(self, client: TransferClient) -> None:
        self.client, self.ftp, self.log_protocol = client, FtpClient(client), LogClient(client)
        self.protocol = ""
        self.logs: list[VehicleLog] = []
        self._last_log = ""  # path of `LAST_LOG`

    def find(self, protocol: str = "auto") -> Exchange[list[VehicleLog]]:
        """Find all logs.

        Parameters
        ----------
        protocol : str
            ``ftp``, ``log``, or ``auto``: FTP, which is faster and has checksums, where the vehicle has it.

        Raises
        ------
        SitlError
            If there is no vehicle, it has neither protocol, or cannot read its card.
        """
        check_choice("--protocol", protocol, PROTOCOLS, SitlError)
        vehicle = yield from self.client.await_heartbeat()
        self.client.progress("listing", 0, 1)
        reason = "FTP was not asked"
        if protocol != "log":
            reason = yield from self._find_by_ftp()
            if not reason:
                return self.logs
        if protocol != "ftp":
            entries = yield from self.log_protocol.list_logs()
            if entries is not None:
                self.protocol = "log"
                self.logs = [VehicleLog(str(entry.id), entry.size, entry.time or None) for entry in entries]
                return self.logs
            reason += "; it does not answer LOG_REQUEST_LIST (no logs, no card, or logging is off)"
            if vehicle.armed:
                reason += "; it is armed: ArduPilot lists its logs only when disarmed"
        raise SitlError(f"no logs from the vehicle, {describe(vehicle)}: {reason}", exit_code=1)

    def _find_by_ftp(self) -> Exchange[str]:
        """Find all logs by FTP; returns why there are none, empty: there is a folder of logs."""
        problem = f"it has no folder of logs ({', '.join(FOLDERS)})"
        for folder in FOLDERS:
            found = yield from self.ftp.list_folder(folder, FTP_ANSWER_S)
            if found is None:
                return "it does not answer FTP"
            if isinstance(found, FtpPacket):
                if found.code == Nak.UNKNOWN_COMMAND:
                    return "it has no FTP"
                if found.code != Nak.NOT_FOUND:
                    problem = f"it cannot read {folder}: {found.reason}"
                continue
            logs: list[VehicleLog] = []
            for entry in found:
                if entry.size is None:
                    logs += yield from self._list_subfolder(folder, entry.name)
                elif entry.name.upper() == LAST_LOG:
                    self._last_log = f"{folder}/{entry.name}"
                elif entry.name.lower().endswith(SUFFIXES):
                    logs.append(VehicleLog(entry.name, entry.size, None, f"{folder}/{entry.name}"))
            self.protocol, self.logs = "ftp", sorted(logs, key=lambda log: _natural(log.name))
            return ""
        return problem

    def _list_subfolder(self, folder: str, name: str) -> Exchange[list[VehicleLog]]:
        path = f"{folder}/{name}"
        found = yield from self.ftp.list_folder(path)
        if found is None or isinstance(found, FtpPacket):
            reason = "it does not answer" if found is None else found.reason
            raise SitlError(f"{path}: the vehicle cannot list it: {reason}", exit_code=1)
        return [
            VehicleLog(f"{name}/{entry.name}", entry.size, None, f"{path}/{entry.name}")
            for entry in found
            if entry.size is not None and entry.name.lower().endswith(SUFFIXES)
        ]

    def choose(self, name: str | None) -> Exchange[VehicleLog]:
        """A log by its name or number, or by the end of its path; None: the last one.

        Raises
        ------
        SitlError
            If there is none, or it is ambiguous which one is meant.
        """
        if not self.logs:
            raise SitlError("the vehicle has no logs", exit_code=1)
        if name is None:
            return (yield from self._last())
        exact = [log for log in self.logs if log.name == name]
        found = exact or [log for log in self.logs if log.path and log.name.endswith(f"/{name}")]
        if len(found) != 1:
            names = ", ".join(log.name for log in found or self.logs[-10:])
            raise SitlError(f"{name}: {'several logs have this name' if found else 'there is no such log'}: {names}")
        return found[0]

    def _last(self) -> Exchange[VehicleLog]:
        if self.protocol == "log":
            if self.client.vehicle is not None and self.client.vehicle.autopilot == ARDUPILOT:
                return max(self.logs, key=lambda log: int(log.name))
            return max(self.logs, key=lambda log: (log.time or 0, int(log.name)))
        if self._last_log:
            text = yield from self.ftp.read_start(self._last_log)
            number = text.decode("ascii", "replace").strip("\0 \r\n")
            same = [log for log in self.logs if number.isdigit() and _number(log.name) == int(number)]
            if len(same) == 1:
                return same[0]
        dated = [bool(DATED.match(log.name)) for log in self.logs]
        if any(dated) and not all(dated):
            without = [log.name for log, has_date in zip(self.logs, dated, strict=True) if not has_date]
            raise SitlError(
                f"it cannot be told which log is the last: {self.logs[dated.index(True)].name} has a date, "
                f"{without[-1]} has none; name the log"
            )
        return self.logs[-1]

    def download(self, log: VehicleLog, folder: Path) -> Exchange[Download]:
        """Download a log, or what an earlier download has left of it, and verify it.

        Raises
        ------
        SitlError
            If it cannot be read or verified, is still being written, or another file has its name.
        """
        vehicle = self.client.vehicle
        assert vehicle is not None
        if vehicle.armed:
            raise SitlError(
                "the vehicle is armed: its last log is being written, and its link is needed for the flight; land and "
                "disarm it first",
                exit_code=1,
            )
        if log.size == 0:
            raise SitlError(f"{log.name}: has 0 bytes; it is being written, or its card was full", exit_code=1)
        name = log.file_name(vehicle.autopilot)
        target = inside(folder, name)
        if target.exists():
            if target.stat().st_size != log.size:
                raise different(target)
            checksum = (yield from self.ftp.checksum(log.path, log.size)) if log.path else None
            if checksum is not None:
                if checksum != file_crc32(target):
                    raise different(target)
                return Download(log, target, self.protocol, "crc32", written=False)
        source = f"system {vehicle.system}, {log.path or f'log {log.name} of {log.time}'}"
        part = PartFile(folder, name, source, log.size, grows=bool(log.path))
        try:
            try:
                if part.missing:  # a log that is being written is found before it is downloaded, too
                    yield from self._pause(GROWTH_S)
                    yield from self._check_unchanged(log)
                if log.path:
                    yield from self.ftp.read_file(log.path, part)
                else:
                    yield from self.log_protocol.read_log(int(log.name), part)
            except SitlError:
                stop = self.ftp.stop() if log.path else self.log_protocol.stop()
                yield from self.client.send_and_wait([stop], self.client.now)
                raise
            yield from self._check_unchanged(log)
            checksum = (yield from self.ftp.checksum(log.path, log.size)) if log.path else None
        except SitlError as error:
            kept = f"; {part.progress}: {AGAIN}" if part.held else ""
            raise SitlError(f"{error}{kept}", exit_code=1) from error
        finally:
            part.close()
            if not part.held:
                part.discard()
        if checksum is not None and checksum != part.checksum():
            part.discard()
            raise SitlError(
                f"{name}: its checksum is not the vehicle's, so it was removed; give the same command again",
                exit_code=1,
            )
        written = part.finish()
        return Download(log, target, self.protocol, "size" if checksum is None else "crc32", written, part.resumed)

    def _pause(self, seconds: float) -> Exchange[None]:
        until = self.client.now + seconds
        while self.client.now < until:
            yield from self.client.receive([], until)

    def _check_unchanged(self, log: VehicleLog) -> Exchange[None]:
        """Check that the log has not grown since it was listed."""
        if log.path:
            found = yield from self.ftp.list_folder(str(PurePosixPath(log.path).parent))
            sizes = {entry.name: entry.size for entry in found} if isinstance(found, list) else {}
            size = sizes.get(PurePosixPath(log.path).name)
        else:
            entries = yield from self.log_protocol.list_logs()
            size = next((entry.size for entry in entries or [] if str(entry.id) == log.name), None)
        if size is None:
            raise SitlError(f"{log.name}: the vehicle no longer lists it", exit_code=1)
        if size != log.size:
            raise grown(log.name, log.size, size)


def _natural(name: str) -> list[tuple[int, str]]:
    """Key that sorts numbers in a name by their value."""
    return [(int(part), "") if part.isdigit() else (-1, part) for part in re.split(r"(\d+)", name)]


def _number(name: str) -> int:
    """Number in the name of an ArduPilot log; -1: none."""
    digits = re.sub(r"\D", "", name)
    return int(digits) if digits else -1
