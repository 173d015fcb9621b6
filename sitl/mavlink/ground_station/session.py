"""A link to a vehicle for an interactive command: progress bars, Ctrl-C, check of the vehicle's type."""

from __future__ import annotations

import signal
import time
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mimopilot.common.console import progress_console
from mimopilot.sitl.errors import SitlError
from mimopilot.sitl.mavlink.ground_station.connection import Connection
from mimopilot.sitl.mavlink.ground_station.crazyflie_link import CrazyflieLink
from mimopilot.sitl.mavlink.ground_station.events import Exchange, Heartbeat, T, run_exchange
from mimopilot.sitl.mavlink.ground_station.parameter_protocol import ParameterClient
from mimopilot.sitl.mavlink.ground_station.upload import NoParametersError, read_values
from mimopilot.sitl.mavlink.ground_station.vehicle_kinds import STOCK_PARAMETERS, check_kind, describe_missing_module
from mimopilot.sitl.mavlink.ground_station.vehicle_link_state import TRY_S, VehicleLinkState
from mimopilot.sitl.mavlink.wire.signing import read_key
from mimopilot.tuning.parameter_row import PREFIX

#: s until a link that a reboot has ended must be back; chosen: a board takes 10 to appear on USB.
REOPEN_S = 30.0


@dataclass(frozen=True)
class LinkOptions:
    """Options of upload, restore, params, experiment and logs; see their help.

    Attributes
    ----------
    timeout : float, s
        Without a message from the vehicle.
    stem : Path
        Start of a snapshot's file name.
    """

    connect: str
    system: int
    timeout: float
    signing_key: Path | None
    force_armed: bool = False
    dry_run: bool = False
    yes: bool = False
    as_json: bool = False
    snapshot: Path | None = None
    stem: Path = Path("vehicle")


def open_link(options: LinkOptions, crazyflie: bool = False) -> Connection | CrazyflieLink:
    """Open the link of the options; `crazyflie`: it may be one of CRTP."""
    if "://" in options.connect:
        if not crazyflie:
            raise SitlError(
                f"--connect {options.connect}: only upload, restore and params speak to a Crazyflie; start its "
                "experiment with mimo.EX_AX and log it on the uSD deck (docs/crazyflie.md)"
            )
        if options.signing_key is not None:
            raise SitlError("--signing-key: a Crazyflie's link cannot be signed; leave it out")
        return CrazyflieLink(options.connect)
    return Connection(options.connect, read_key(options.signing_key) if options.signing_key else None)


class LinkSession:
    """A link to a vehicle, for an interactive command; its subclasses set `client`.

    Parameters
    ----------
    options : LinkOptions
        How to reach the vehicle.
    crazyflie : bool
        It may be a Crazyflie.

    Attributes
    ----------
    heeds_interrupts : bool
        False: Ctrl-C ends nothing.
    """

    client: VehicleLinkState
    heeds_interrupts = True

    def __init__(self, options: LinkOptions, crazyflie: bool = False) -> None:
        self.options = options
        self.link = open_link(options, crazyflie)
        self.tries = max(1, round(options.timeout / TRY_S))

    def run(self, exchange: Exchange[T]) -> T:
        """Run an exchange. Ctrl-C or a closed terminal ends it in order, with the roll-back."""
        from rich.progress import Progress

        def interrupt(number: int, frame: object) -> None:
            self.client.interrupted |= self.heeds_interrupts

        numbers = [getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)]
        before = {number: signal.signal(number, interrupt) for number in numbers}
        try:
            with Progress(console=progress_console(), transient=True) as bar:
                tasks: dict[str, Any] = {}

                def progress(phase: str, done: int, of: int) -> None:
                    if phase not in tasks:
                        tasks[phase] = bar.add_task(phase)
                    bar.update(tasks[phase], completed=done, total=of)

                self.client.progress = progress
                return run_exchange(exchange, self.link)
        except SitlError as error:
            raise type(error)(f"{error}{self.link.hint}", error.exit_code) from error
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)

    @property
    def vehicle(self) -> Heartbeat:
        """Its last HEARTBEAT."""
        assert self.client.vehicle is not None
        return self.client.vehicle


class Session(LinkSession):
    """A link to the parameters of a vehicle.

    Parameters
    ----------
    options : LinkOptions
        How to reach it.
    integers : collection of str
        Names of parameters that may be INT32.
    crazyflie : bool
        It may be a Crazyflie.
    """

    client: ParameterClient

    def __init__(self, options: LinkOptions, integers: Collection[str] = (), crazyflie: bool = False) -> None:
        super().__init__(options, crazyflie)
        self.integers = integers
        self.client = self._new_client()

    def _new_client(self) -> ParameterClient:
        options = self.options
        return ParameterClient(self.link.now(), self.tries, options.system, options.force_armed, self.integers)

    def reconnect(self) -> None:
        """Open the link again after it has ended, as a USB port does when the vehicle reboots; hear the vehicle.

        Raises
        ------
        SitlError
            When that is not possible within `REOPEN_S`, or Ctrl-C.
        """
        self.link.close()
        deadline = time.monotonic() + REOPEN_S
        while True:
            try:
                self.link = open_link(self.options)
                break
            except SitlError:
                if time.monotonic() > deadline or self.client.interrupted:
                    raise
                time.sleep(TRY_S)
        interrupted, self.client = self.client.interrupted, self._new_client()
        self.client.interrupted = interrupted
        self.run(self.client.await_heartbeat())

    def read(self, names: Sequence[str], profile: str = "") -> dict[str, float]:
        """Parameters of the vehicle, after it is identified and found to fit a profile."""
        check_kind(self.run(self.client.await_heartbeat()), profile)
        try:
            return self.run(read_values(self.client, names))
        except NoParametersError as error:
            probe = STOCK_PARAMETERS.get(self.vehicle.autopilot, "")
            if not probe or not all(name.startswith(PREFIX) for name in names):
                raise
            # A vehicle that does not receive us does not answer either: probe a parameter of its stock controller.
            if self.run(self.client.read([probe], "reading"))[probe].absent:
                raise
            raise SitlError(f"{describe_missing_module(self.vehicle)}; nothing was written") from error


@contextmanager
def open_session(options: LinkOptions, integers: Collection[str] = (), crazyflie: bool = False) -> Iterator[Session]:
    """Open a link and close it again; `crazyflie`: the vehicle may be one."""
    opened = Session(options, integers, crazyflie)
    try:
        yield opened
    finally:
        opened.link.close()
