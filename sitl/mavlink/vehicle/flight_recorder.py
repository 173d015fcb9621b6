"""Flight recorder of the SITL vehicle: one log a flight, from arming to disarming, at the control rate."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mimopilot.common.files import write_atomically
from mimopilot.sitl.autopilot.autopilot import RECORD
from mimopilot.sitl.autopilot.flight_modes import Commander
from mimopilot.sitl.errors import SitlError
from mimopilot.sitl.flight.flight_log import vehicle_log
from mimopilot.sitl.mavlink.wire.ftp import crc32
from mimopilot.sitl.physics.airframe import Airframe

BLOCK = 15_000  # rows allocated at once: one minute at 250 Hz


@dataclass(frozen=True)
class _RecordedFlight:
    """A flight that has ended: its file, its records, (N,), whether it was landed, (N,), and its parameters."""

    path: Path
    record: NDArray[Any]
    landed: NDArray[np.bool_]
    parameters: dict[str, float]


@dataclass(frozen=True)
class StoredLog:
    """A log that was written: its file, size (bytes), `wire.ftp.crc32`, and time (s since 1970)."""

    path: Path
    size: int
    checksum: int
    time: int


class FlightRecorder:
    """Writes FILE.ulg for the first flight, FILE-2.ulg for the second, and so on.

    A flight that cannot be written, as on a full disk, keeps its number and is written later.

    Parameters
    ----------
    path : Path
        File of the first flight.
    airframe : Airframe
        The vehicle.
    Ts : float, s
        Control period.
    make_log : callable
        Makes a log, as `sitl.flight.flight_log.vehicle_log` does.

    Attributes
    ----------
    flights : int
        Number of flights that have ended.
    logs : list of StoredLog
        Those of them that were written.

    Raises
    ------
    SitlError
        When no file can be written there.
    """

    def __init__(self, path: Path, airframe: Airframe, Ts: float, make_log: Callable[..., bytes] = vehicle_log) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.is_dir() or not os.access(path.parent, os.W_OK):
            raise SitlError(f"--log {path}: a file cannot be written there; name a file in a folder of yours")
        self.path, self.airframe, self.Ts, self.make_log = path, airframe, Ts, make_log
        self.flights = 0
        self.logs: list[StoredLog] = []
        self._unsaved: list[_RecordedFlight] = []
        self._spare: NDArray[Any] = np.zeros(1, RECORD)
        self._forget()

    def _forget(self) -> None:
        self._blocks: list[NDArray[Any]] = []
        self._landed: list[bool] = []
        self._parameters: dict[str, float] | None = None

    def begin(self, parameters: Mapping[str, float]) -> None:
        """Begin a flight, with these parameters, name -> value."""
        self._forget()
        self._parameters = dict(parameters)

    def next_row(self, vehicle: Commander) -> Any:
        """Append a record, of `sitl.autopilot.autopilot.RECORD`, for the next period; the caller fills it."""
        if self._parameters is None:
            return self._spare[0]
        place = len(self._landed) % BLOCK
        if place == 0:
            self._blocks.append(np.zeros(BLOCK, RECORD))
        self._landed.append(vehicle.vertical.landed)
        return self._blocks[-1][place]

    @property
    def unsaved(self) -> list[Path]:
        """Files of the flights that could not be written yet."""
        return [flight.path for flight in self._unsaved]

    def save(self) -> list[Path]:
        """End the flight; write it and those that could not be written before.

        Returns
        -------
        list of Path
            Files written.

        Raises
        ------
        OSError
            When a file cannot be written; its flight and the later ones are kept for the next call.
        """
        if self._parameters is not None and self._landed:
            self.flights += 1
            name = self.path if self.flights == 1 else self.path.with_stem(f"{self.path.stem}-{self.flights}")
            record = np.concatenate(self._blocks)[: len(self._landed)]
            self._unsaved.append(_RecordedFlight(name, record, np.array(self._landed), self._parameters))
        self._forget()
        written = []
        while self._unsaved:
            flight = self._unsaved[0]
            content = self.make_log(flight.record, flight.landed, self.Ts, self.airframe, flight.parameters)
            write_atomically(flight.path, content)
            # The checksum is computed now: it takes too long in flight.
            self.logs.append(StoredLog(flight.path, len(content), crc32(content), int(time.time())))
            written.append(self._unsaved.pop(0).path)
        return written
