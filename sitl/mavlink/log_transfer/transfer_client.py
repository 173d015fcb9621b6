"""One vehicle on a link, for transfers: its file and log messages, round trips, and when to give up."""

from __future__ import annotations

from collections.abc import Sequence

from mimopilot.sitl.errors import SitlError
from mimopilot.sitl.mavlink.ground_station.events import Exchange, FlightReport, Outgoing, StatusText, TransferReport
from mimopilot.sitl.mavlink.ground_station.vehicle_link_state import TRIES, TRY_S, VehicleLinkState
from mimopilot.sitl.mavlink.log_transfer.part_file import PartFile

#: Interval between two updates of the progress, s; chosen.
PROGRESS_S = 0.1
#: Shortest and longest wait for an answer, s: the MAVLink guide recommends 0.05 s, a radio may hold 2 s of data.
SHORTEST_S, LONGEST_S = 0.05, 3.0

#: Waits for an answer without a new byte, from a vehicle that is heard, after which a transfer ends; chosen: at 30 %
#: loss each way a piece is lost so often once in 10^9.
PATIENCE = 30


class RoundTrip:
    """How long to wait for an answer, as TCP does it: RFC 6298, section 2.

    Attributes
    ----------
    timeout : float, s
    """

    def __init__(self) -> None:
        self.timeout = TRY_S
        self._mean: float | None = None
        self._spread = 0.0

    def note(self, seconds: float) -> None:
        """An answer to a request that was sent once took so long (s)."""
        if self._mean is None:
            self._mean, self._spread = seconds, seconds / 2
        else:
            self._spread += (abs(self._mean - seconds) - self._spread) / 4
            self._mean += (seconds - self._mean) / 8
        self.timeout = min(max(self._mean + 4 * self._spread, SHORTEST_S), LONGEST_S)

    def wait(self, tries: int) -> float:
        """Wait (s) after a number of tries without an answer: longer each time, in case the link has become slow."""
        return float(min(self.timeout * 1.25**tries, LONGEST_S))


class TransferClient(VehicleLinkState):
    """State of the contact with a vehicle during transfers.

    Parameters
    ----------
    now, tries, system
        See `sitl.mavlink.ground_station.vehicle_link_state.VehicleLinkState`.

    Attributes
    ----------
    round_trip : RoundTrip
    said : str
        Last text of the vehicle.
    """

    def __init__(self, now: float, tries: int = TRIES, system: int = 0) -> None:
        super().__init__(now, tries, system)
        self.round_trip = RoundTrip()
        self.said = ""
        self.on_report = self._keep
        self._inbox: list[TransferReport] = []
        self._progress_at = self._shown_at = now

    def _keep(self, report: FlightReport | TransferReport) -> None:
        if isinstance(report, StatusText):
            self.said = report.behind(self.said)
        elif isinstance(report, TransferReport):
            self._inbox.append(report)

    def receive(self, send: Sequence[Outgoing], wake: float) -> Exchange[list[TransferReport]]:
        """Send, and wait for file and log messages until a time (s).

        Raises
        ------
        SitlError
            If the link is lost, a second vehicle has this one's number, or the user interrupts.
        """
        yield from self.send_and_wait(send, wake)
        reason = self.failure
        if self.interrupted:
            reason = "interrupted"
        elif self.closed:
            reason = "the link was lost"
        elif self.lost:
            reason = f"no message from the vehicle for {self.timeout:g} s"
        if reason:
            raise SitlError(reason, exit_code=1)
        found, self._inbox = self._inbox, []
        return found

    def begin(self) -> None:
        """Begin to transfer a log: its first piece is due within `timeout`."""
        self._progress_at = self.now

    def store(self, part: PartFile, offset: int, data: bytes) -> None:
        """Write a piece, and show the progress."""
        if part.write(offset, data):
            self._progress_at = self.now
        if self.now >= self._shown_at + PROGRESS_S or not part.missing:
            self._shown_at = self.now
            self.progress("downloading", part.held, part.size)

    def check_progress(self) -> None:
        """Check that the transfer goes on, on a vehicle that is not armed.

        Raises
        ------
        SitlError
            If it does not.
        """
        assert self.vehicle is not None
        if self.vehicle.armed:
            raise SitlError("the vehicle was armed: its link is needed for the flight", exit_code=1)
        patience = max(self.timeout, PATIENCE * self.round_trip.timeout)
        if self.now - self._progress_at >= patience:
            said = f"; its last text: {self.said}" if self.said else ""
            raise SitlError(f"the vehicle is heard, but sent no data for {patience:.0f} s{said}", exit_code=1)
