"""A link to the logs of a vehicle: list them, download one; without a terminal."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from mimopilot.sitl.mavlink.ground_station.session import LinkOptions, LinkSession
from mimopilot.sitl.mavlink.log_transfer.transfer_client import TransferClient
from mimopilot.sitl.mavlink.log_transfer.vehicle_logs import Download, VehicleLog, VehicleLogs


class LogSession(LinkSession):
    """A link to the logs of a vehicle.

    Parameters
    ----------
    options : LinkOptions
        How to reach it.
    """

    client: TransferClient

    def __init__(self, options: LinkOptions) -> None:
        super().__init__(options)
        self.client = TransferClient(self.link.now(), self.tries, options.system)
        self.logs = VehicleLogs(self.client)


@contextmanager
def open_logs(options: LinkOptions) -> Iterator[LogSession]:
    """Open a link and close it again."""
    opened = LogSession(options)
    try:
        yield opened
    finally:
        opened.link.close()


def list_logs(options: LinkOptions, protocol: str = "auto") -> list[VehicleLog]:
    """All logs of a vehicle; see `VehicleLogs.find`."""
    with open_logs(options) as session:
        return session.run(session.logs.find(protocol))


def download_log(options: LinkOptions, name: str | None, out: Path, protocol: str = "auto") -> Download:
    """Download a log of a vehicle, by default the last one; see `VehicleLogs.download`."""
    with open_logs(options) as session:
        session.run(session.logs.find(protocol))
        return session.run(session.logs.download(session.run(session.logs.choose(name)), out))
