"""A vehicle on a link while somebody watches: progress, Ctrl-C, and which vehicle it is."""

from __future__ import annotations

import signal
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mimopilot.sitl.errors import SitlError
from mimopilot.sitl.mavlink.ground_station.connection import Connection
from mimopilot.sitl.mavlink.ground_station.events import Heartbeat, Steps, T, drive
from mimopilot.sitl.mavlink.ground_station.parameter_protocol import Conversation
from mimopilot.sitl.mavlink.ground_station.upload import NoneHeldError, read
from mimopilot.sitl.mavlink.ground_station.vehicle_contact import TRY_S
from mimopilot.sitl.mavlink.ground_station.vehicle_kinds import STOCK_PARAMETERS, check_kind, without_module
from mimopilot.sitl.mavlink.wire.signing import read_key
from mimopilot.tuning.parameters import PREFIX

from mimopilot.common.console import progress_console


@dataclass(frozen=True)
class Options:
    """The options that the commands share; see their help."""

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


class Session:
    """A vehicle on a link, while somebody watches.

    Parameters
    ----------
    options : Options
        How to reach it.
    integers : collection of str
        Names of parameters that may be whole numbers.
    """

    def __init__(self, options: Options, integers: Collection[str] = ()) -> None:
        self.options = options
        self.link = Connection(options.connect, read_key(options.signing_key) if options.signing_key else None)
        tries = max(1, round(options.timeout / TRY_S))
        self.talk = Conversation(self.link.now(), tries, options.system, options.force_armed, integers)

    def run(self, steps: Steps[T]) -> T:
        """Run a part of the conversation; Ctrl-C and a closed terminal end it in order, not at once."""
        from rich.progress import Progress

        def interrupt(number: int, frame: object) -> None:
            self.talk.interrupted = True

        numbers = [getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)]
        before = {number: signal.signal(number, interrupt) for number in numbers}
        try:
            with Progress(console=progress_console(), transient=True) as bar:
                tasks: dict[str, Any] = {}

                def progress(phase: str, done: int, of: int) -> None:
                    if phase not in tasks:
                        tasks[phase] = bar.add_task(phase)
                    bar.update(tasks[phase], completed=done, total=of)

                self.talk.progress = progress
                return drive(steps, self.link)
        except SitlError as error:
            raise type(error)(f"{error}{self.link.hint}", error.exit_code) from error
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)

    def read(self, names: Sequence[str], profile: str = "") -> dict[str, float]:
        """What the vehicle holds, once it is clear which vehicle that is, and that a profile fits it."""
        check_kind(self.run(self.talk.meet()), profile)
        try:
            return self.run(read(self.talk, names))
        except NoneHeldError as error:
            probe = STOCK_PARAMETERS.get(self.vehicle.autopilot, "")
            if not probe or not all(name.startswith(PREFIX) for name in names):
                raise
            # A vehicle that does not hear us is silent, too: what its own controller has tells the two apart.
            if self.run(self.talk.ask([probe], "reading"))[probe].absent:
                raise
            raise SitlError(f"{without_module(self.vehicle)}; nothing was written") from error

    @property
    def vehicle(self) -> Heartbeat:
        """Its last HEARTBEAT."""
        assert self.talk.vehicle is not None
        return self.talk.vehicle


@contextmanager
def session(options: Options, integers: Collection[str] = ()) -> Iterator[Session]:
    """Open a link and close it again."""
    opened = Session(options, integers)
    try:
        yield opened
    finally:
        opened.link.close()
