"""One interface to the experiments on vehicles: prepare on the ground, check in the air, excite, restore.

A profile is for one flight of one vehicle. Its functions run over a session (`VehicleSession`), in this order;
`prepare` is left out when the vehicle is in the air already. `restore` belongs after each of them that failed, too.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import ClassVar, Protocol

from mimopilot.sitl.mavlink.ground_station.events import Exchange, T
from mimopilot.sitl.mavlink.ground_station.flight_monitor import FlightMonitor
from mimopilot.sitl.mavlink.ground_station.parameter_protocol import ParameterClient

#: Saves the values that the vehicle has, name -> value, before the first of them is changed.
SaveValues = Callable[[Mapping[str, float]], None]


class VehicleSession(Protocol):
    """A link to one vehicle; `sitl.mavlink.ground_station.session.Session` is one."""

    client: ParameterClient

    def run(self, exchange: Exchange[T]) -> T:
        """Run an exchange; Ctrl-C sets `client.interrupted`."""

    def reconnect(self) -> None:
        """Open the link again after a reboot, with a new `client` that has heard the vehicle."""


@dataclass(frozen=True)
class ExcitationOptions:
    """What to excite, and when to stop; None: the profile's own.

    Attributes
    ----------
    axis : str or None
        As in `experiment --axis`.
    seconds_per_axis : float, s
    amplitude : float or None
        Of the torque (normalised); for a stock PX4 of the rate setpoint, rad/s.
    bandwidth : float, rad/s
    seed : int
    mode : str
        Flight mode.
    tilt_deg : float, degrees
        Roll or pitch beyond which the experiment is stopped.
    runs : int or None
        How often PX4's autotune is run.
    yaw_amplitude : float or None
        Of the torque on yaw (normalised); our injector's.
    """

    axis: str | None
    seconds_per_axis: float
    amplitude: float | None
    bandwidth: float
    seed: int
    mode: str
    tilt_deg: float
    runs: int | None = None
    yaw_amplitude: float | None = None


@dataclass(frozen=True)
class Preparation:
    """What `ExperimentProfile.prepare` did.

    Attributes
    ----------
    changed : mapping
        Parameter -> value that was written.
    rebooted : bool
    notes : tuple of str
        For the user.
    """

    changed: Mapping[str, float] = field(default_factory=dict)
    rebooted: bool = False
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class ExperimentResult:
    """Result of an experiment.

    Attributes
    ----------
    complete : bool
        It ran to its planned end.
    reason : str
        Why it did not; empty if it did.
    seconds : float
        Duration of the injection, by the vehicle's clock.
    stopped : bool
        It is known that nothing is injected any more.
    restored : bool
        All settings of the flight were read back as before.
    notes : tuple of str
        For the user.
    """

    complete: bool
    reason: str
    seconds: float
    stopped: bool
    restored: bool
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class Restoration:
    """What `ExperimentProfile.restore` achieved.

    Attributes
    ----------
    left : mapping
        Parameter -> value that it should hold again, of those not read back.
    notes : tuple of str
        For the user.
    """

    left: Mapping[str, float] = field(default_factory=dict)
    notes: tuple[str, ...] = ()

    @property
    def complete(self) -> bool:
        """Whether every parameter was read back as before."""
        return not self.left


class ExperimentProfile(ABC):
    """An experiment on one kind of vehicle.

    Parameters
    ----------
    options : ExcitationOptions
    save : callable
        See `SaveValues`.

    Attributes
    ----------
    name : str
        As of the profiles of an upload.
    integers : frozenset of str
        Parameters that may be whole numbers on the vehicle; a session needs them.
    pilot : str
        Why a pilot must fly the vehicle, and what to do; empty: none need.
    old : dict
        Parameter -> value before it was changed; what `restore` writes.

    Raises
    ------
    SitlError
        If an option does not fit.
    """

    name: ClassVar[str]
    integers: ClassVar[frozenset[str]]
    pilot: ClassVar[str] = ""

    def __init__(self, options: ExcitationOptions, save: SaveValues) -> None:
        self.options, self.save = options, save
        self.old: dict[str, float] = {}

    def remember(self, values: Mapping[str, float]) -> None:
        """Save values that are about to be changed, once."""
        new = {name: value for name, value in values.items() if name not in self.old}
        if new:
            self.old |= new
            self.save(self.old)

    @abstractmethod
    def prepare(self, session: VehicleSession) -> Preparation:
        """Set what the excitation and its log need, on a disarmed vehicle on the ground; reboot it if that is needed.

        Raises
        ------
        SitlError
            If it is armed or in the air, is another vehicle, cannot excite or log, or something was not read back.
        """

    @abstractmethod
    def check(self, session: VehicleSession) -> FlightMonitor:
        """Check that the vehicle hovers, is prepared, and may be excited; nothing is written.

        Raises
        ------
        SitlError
            Naming what is missing.
        """

    @property
    @abstractmethod
    def settings(self) -> dict[str, float]:
        """Parameter -> value that `excite` sets; after `check`."""

    @abstractmethod
    def describe(self) -> list[list[str]]:
        """What `excite` will do: rows of parameter, value, unit and description; after `check`."""

    @abstractmethod
    def excite(self, session: VehicleSession, monitor: FlightMonitor) -> ExperimentResult:
        """Excite the vehicle, after `check`; on anything unusual, or Ctrl-C, the excitation is stopped first."""

    @abstractmethod
    def restore(self, session: VehicleSession) -> Restoration:
        """Write the old values back and read them, in the air or on the ground, also after Ctrl-C."""
