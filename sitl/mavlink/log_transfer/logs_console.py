"""The command `logs`: a table of a vehicle's logs, or the download of one."""

from __future__ import annotations

from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path

from mimopilot.common.console import print_json, print_table
from mimopilot.sitl.mavlink.ground_station.session import LinkOptions
from mimopilot.sitl.mavlink.log_transfer.log_session import download_log, open_logs

VERIFIED = {
    "crc32": "its size and its CRC-32 are the vehicle's",
    "size": "its size is the vehicle's, which has no checksum of it",
}

#: Protocol -> its name.
PROTOCOL_NAMES = {"ftp": "FTP", "log": "LOG_REQUEST_LIST"}


def show_logs(options: LinkOptions, protocol: str) -> None:
    """Print all logs of a vehicle."""
    with open_logs(options) as session:
        logs = session.run(session.logs.find(protocol))
    if options.as_json:
        found = [{"name": log.name, "size": log.size, "time": log.time} for log in logs]
        print_json({"system": session.vehicle.system, "protocol": session.logs.protocol, "logs": found})
        return
    rows = [[log.name, f"{log.size}", _utc(log.time)] for log in logs]
    title = f"vehicle {session.vehicle.system}: {len(logs)} logs, by {PROTOCOL_NAMES[session.logs.protocol]}"
    print_table(title, ["log", "bytes", "UTC"], rows)
    if logs:
        print("download one with: mimopilot logs LOG --connect ..., or the last with --last")


def show_download(options: LinkOptions, name: str | None, out: Path, protocol: str) -> None:
    """Download a log, and print where it is."""
    done = download_log(options, name, out, protocol)
    if options.as_json:
        print_json({**asdict(done), "path": str(done.path)})
        return
    if not done.written:
        print(f"{done.path}: is there already: {VERIFIED[done.verified]}")
        return
    rest = f", {done.resumed} of them from an earlier download" if done.resumed else ""
    print(f"{done.path}: {done.log.size} bytes{rest}; {VERIFIED[done.verified]}")


def _utc(time: int | None) -> str:
    return datetime.fromtimestamp(time, UTC).strftime("%Y-%m-%d %H:%M:%S") if time else ""
