"""An autotune in simulated time: link, vehicle and answers are scripted."""

import functools
import hashlib
from contextlib import contextmanager
from dataclasses import dataclass, field

import pytest

import mimopilot.sitl.field.autotune_run as autotune_run
import mimopilot.sitl.field.ground_steps as ground_steps
import mimopilot.sitl.mavlink.ground_station.session as session
from mimopilot.sitl.errors import SitlError
from mimopilot.sitl.field.autotune_run import REPORT, AutotuneOptions
from mimopilot.sitl.field.workflow import autotune
from mimopilot.tuning.design.cascade import tune
from mimopilot.tuning.logs.inspection import inspect_log
from mimopilot.tuning.logs.reader import read_log
from tests.sitl.field.field_vehicle import SECONDS, FieldLink, FieldVehicle

#: SHA-256 of a log -> its gains: the same few logs are flown in many tests.
TUNED = {}


def tune_once(experiments, spec):
    (one,) = experiments
    if one.sha256 not in TUNED:
        TUNED[one.sha256] = tune(experiments, spec)
    return TUNED[one.sha256]


@functools.cache
def read_once(sha256, read, path):
    return read(path)


def once(read):
    """Read a log of some content once, whatever its name."""
    return lambda path: read_once(hashlib.sha256(path.read_bytes()).hexdigest(), read, path)


@dataclass
class Answers:
    """The user: the question's first word -> the answer; by default yes."""

    answers: dict = field(default_factory=dict)
    interactive: bool = True
    told: list = field(default_factory=list)
    asked: list = field(default_factory=list)
    obeys: dict = field(default_factory=dict)

    def tell(self, text):
        self.told.append(text)
        for part, action in self.obeys.items():
            if part in text:
                action()

    def ask(self, question, seconds=None):
        self.asked.append(question)
        return self.answers.get(question.split()[0], True)

    def show_gains(self, gains):
        self.told.append("gains")

    def show_check(self, result):
        self.told.append(result.as_table())


@dataclass
class Field:
    """One vehicle, its link and its user."""

    vehicle: FieldVehicle
    link: FieldLink
    user: Answers
    options: AutotuneOptions
    patch: pytest.MonkeyPatch  # of the fault

    def run(self):
        """Run the autotune; returns why it failed, empty: the gains were kept."""
        self.link.closed = False
        try:
            autotune(self.options, self.user)
        except SitlError as error:
            return str(error)
        return ""


def write_no_page(run, gains, result):
    run.file(REPORT).write_text("")


@contextmanager
def scripted_fields(folder):
    """A function that makes a `Field`; other keywords are attributes of the vehicle."""
    lasting, patch = pytest.MonkeyPatch(), pytest.MonkeyPatch()
    lasting.setattr(ground_steps, "tune", tune_once)
    lasting.setattr(ground_steps, "inspect_log", once(inspect_log))
    lasting.setattr(autotune_run, "read_log", once(read_log))

    write_page = ground_steps.write_autotune_report

    def make(answers=None, loss=0.0, seed=0, pilot=False, yes=False, arm=False, page=False, **changes):
        # The whole page takes as long as the rest of a run.
        lasting.setattr(ground_steps, "write_autotune_report", write_page if page else write_no_page)
        vehicle = FieldVehicle()
        for name, value in changes.items():
            assert hasattr(vehicle, name)
            setattr(vehicle, name, value)
        link = FieldLink(vehicle, loss=loss, seed=seed, latency=0.01)
        lasting.setattr(session, "Connection", link.open)
        options = AutotuneOptions(
            "udpin:127.0.0.1:14550",
            folder / "out",
            take_off=None if pilot else 2.0,
            seconds_per_axis=SECONDS,
            amplitude=0.1,
            yes=yes,
            arm=arm,
        )
        return Field(vehicle, link, Answers(answers or {}), options, patch)

    try:
        yield make
    finally:
        patch.undo()
        lasting.undo()


@pytest.fixture
def scripted(tmp_path):
    """See `scripted_fields`."""
    with scripted_fields(tmp_path) as make:
        yield make
