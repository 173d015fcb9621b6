"""The log of a vehicle that is flown by others: each flight, from arming to disarming, at full rate."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from mimopilot.sitl.autopilot.autopilot import RECORD
from mimopilot.sitl.autopilot.flight_modes import Vehicle
from mimopilot.sitl.errors import SitlError
from mimopilot.sitl.flight.flight_log import vehicle_log
from mimopilot.sitl.physics.airframe import Airframe
from numpy.typing import NDArray

from mimopilot.common.files import write_atomically

BLOCK = 15_000  # rows, a minute


@dataclass(frozen=True)
class _Flight:
    """A flight that has ended: its file, its records, (N,), whether it stood on the ground, and its gains, (36,)."""

    path: Path
    record: NDArray[Any]
    landed: NDArray[np.bool_]
    gains: NDArray[np.float32]


class FlightRecorder:
    """Writes FILE.ulg for the first flight, FILE-2.ulg for the second, and so on.

    A flight that cannot be written (a full disk) keeps its number and is kept until it can.

    Parameters
    ----------
    path : Path
        Of the first.
    airframe : Airframe
        The vehicle.
    Ts : float, s
        Control period.

    Attributes
    ----------
    flights : int
        How many have ended.

    Raises
    ------
    SitlError
        When nothing can be written there.
    """

    def __init__(self, path: Path, airframe: Airframe, Ts: float) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.is_dir() or not os.access(path.parent, os.W_OK):
            raise SitlError(f"--log {path}: a file cannot be written there")
        self.path, self.airframe, self.Ts = path, airframe, Ts
        self.flights = 0
        self._waiting: list[_Flight] = []
        self._spare: NDArray[Any] = np.zeros(1, RECORD)
        self._forget()

    def _forget(self) -> None:
        self._blocks: list[NDArray[Any]] = []
        self._landed: list[bool] = []
        self._gains: NDArray[np.float32] | None = None

    def begin(self, gains: NDArray[np.float32]) -> None:
        """A flight begins, under these gains, (36,)."""
        self._forget()
        self._gains = gains.copy()

    def row(self, vehicle: Vehicle) -> Any:
        """The record of the next period, of `sitl.autopilot.autopilot.RECORD`, to be filled."""
        if self._gains is None:
            return self._spare[0]
        place = len(self._landed) % BLOCK
        if place == 0:
            self._blocks.append(np.zeros(BLOCK, RECORD))
        self._landed.append(vehicle.lift.landed)
        return self._blocks[-1][place]

    @property
    def unsaved(self) -> list[Path]:
        """Files of the flights that could not be written yet."""
        return [flight.path for flight in self._waiting]

    def save(self) -> list[Path]:
        """The flight ends: write it, and those that could not be written before.

        Returns
        -------
        list of Path
            What was written.

        Raises
        ------
        OSError
            When a file cannot be written; its flight and the later ones are kept for the next time.
        """
        if self._gains is not None and self._landed:
            self.flights += 1
            name = self.path if self.flights == 1 else self.path.with_stem(f"{self.path.stem}-{self.flights}")
            record = np.concatenate(self._blocks)[: len(self._landed)]
            self._waiting.append(_Flight(name, record, np.array(self._landed), self._gains))
        self._forget()
        written = []
        while self._waiting:
            flight = self._waiting[0]
            content = vehicle_log(flight.record, flight.landed, self.Ts, self.airframe, flight.gains)
            write_atomically(flight.path, content)
            written.append(self._waiting.pop(0).path)
        return written
