"""What all steps of an autotune share: options, files, decisions, the user, and the link to the vehicle."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

from mimopilot.common.files import inside
from mimopilot.sitl.errors import SitlError
from mimopilot.sitl.field.check_flight import CheckResult
from mimopilot.sitl.field.decisions import Decisions
from mimopilot.sitl.mavlink.ground_station.events import Heartbeat
from mimopilot.sitl.mavlink.ground_station.session import LinkOptions, LinkSession, Session, open_session
from mimopilot.sitl.mavlink.log_transfer.log_session import LogSession, open_logs
from mimopilot.tuning.experiment import Experiment
from mimopilot.tuning.gains import Gains
from mimopilot.tuning.logs.reader import read_log

#: Files in the folder; the logs have the suffix of the vehicle's.
SNAPSHOT, GAINS, REPORT = "before.params", "new.gains.toml", "report.html"
FLIGHT, CHECK = "flight", "check"
#: Time (s) in which the question whether to keep the gains must be answered; chosen.
ANSWER_S = 120.0


@dataclass(frozen=True)
class AutotuneOptions:
    """Options of an autotune; see the help of its command.

    Attributes
    ----------
    take_off : float or None, m
        Height; None: a pilot takes off and lands.
    """

    connect: str
    folder: Path
    profile: str = "mimo"
    take_off: float | None = None
    yes: bool = False
    arm: bool = False
    seconds_per_axis: float = 20.0
    amplitude: float | None = None
    system: int = 0
    timeout: float = 12.0
    signing_key: Path | None = None


class AutotuneDialogue(Protocol):
    """What a user is told and asked.

    Attributes
    ----------
    interactive : bool
        There is somebody to ask.
    """

    interactive: bool

    def tell(self, text: str) -> None:
        """One line."""

    def ask(self, question: str, seconds: float | None = None) -> bool | None:
        """Ask; None: no answer in time (s)."""

    def show_gains(self, gains: Gains) -> None:
        """The gains, and what they and the flown ones are predicted to do."""

    def show_check(self, result: CheckResult) -> None:
        """The check flight beside its prediction."""


class Decided(Exception):  # noqa: N818 - a result, not an error
    """The autotune has ended with the old gains, for a reason that repeating it would not change."""


@dataclass
class AutotuneRun:
    """One autotune.

    Attributes
    ----------
    options : AutotuneOptions
    decisions : Decisions
    dialogue : AutotuneDialogue
    took_off : bool
        The vehicle flies because of this program: it lands it.
    ending : bool
        What is done now must be done: Ctrl-C ends nothing.
    """

    options: AutotuneOptions
    decisions: Decisions
    dialogue: AutotuneDialogue
    took_off: bool = False
    ending: bool = False
    _read: dict[str, Experiment] = field(default_factory=dict)

    def file(self, name: str) -> Path:
        """A file in the folder."""
        return inside(self.options.folder, name)

    def log(self, name: str) -> Path:
        """A downloaded log, `FLIGHT` or `CHECK`."""
        step = self.decisions.steps[f"{name} log"]
        return self.file(str(step["file"]))

    def experiment(self, name: str) -> Experiment:
        """A downloaded log, read once."""
        if name not in self._read:
            self._read[name] = read_log(self.log(name))
        return self._read[name]

    @contextmanager
    def vehicle(self, armed: bool = True, integers: Collection[str] = ()) -> Iterator[Session]:
        """A link to the vehicle's parameters; `armed`: also while it flies. After Ctrl-C the autotune ends."""
        with open_session(self.link(armed), integers) as session:
            session.heeds_interrupts = not self.ending
            yield session
            self._check_interrupt(session)

    @contextmanager
    def vehicle_logs(self) -> Iterator[LogSession]:
        """A link to the vehicle's logs, likewise."""
        with open_logs(self.link(False)) as session:
            yield session
            self._check_interrupt(session)

    def link(self, armed: bool = True) -> LinkOptions:
        """How to reach the vehicle; `armed`: also while it flies."""
        given = self.options
        return LinkOptions(given.connect, given.system, given.timeout, given.signing_key, force_armed=armed)

    @staticmethod
    def _check_interrupt(session: LinkSession) -> None:
        """An exchange that must not be interrupted has come to its end."""
        if session.client.interrupted:
            raise KeyboardInterrupt

    def confirm(self, question: str, seconds: float | None = None) -> bool | None:
        """Ask, unless ``--yes`` answers."""
        return True if self.options.yes else self.dialogue.ask(question, seconds)

    def may_arm(self, vehicle: Heartbeat) -> bool:
        """Whether the options allow to arm a vehicle without a question."""
        return self.options.arm or (self.options.yes and vehicle.simulated)

    def confirm_arming(self, vehicle: Heartbeat, height: float) -> None:
        """Ask whether the vehicle may be armed, unless ``--arm`` answers, or ``--yes`` for a simulated one.

        Raises
        ------
        SitlError
            If it may not.
        """
        if self.may_arm(vehicle):
            return
        question = f"Arm vehicle {vehicle.system} and take off to {height:g} m? Its rotors turn"
        if not self.dialogue.ask(question):
            raise SitlError("the vehicle may not be armed: give --arm, or answer yes", exit_code=1)
