"""Autotune from the first check to the last question: the list of steps, and how it ends.

However it ends, the vehicle holds one complete set of gains, and the end says which: it is read from the vehicle. A
step that is done is recorded, so that the same command goes on after any interruption. Until the new gains are kept,
each end takes the old ones back.
"""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import NamedTuple

from mimopilot.common.errors import Error
from mimopilot.common.extras import REPORT
from mimopilot.sitl.errors import SitlError
from mimopilot.sitl.field.autotune_run import GAINS, SNAPSHOT, AutotuneDialogue, AutotuneOptions, AutotuneRun, Decided
from mimopilot.sitl.field.decisions import Decisions, load_decisions
from mimopilot.sitl.field.flight_steps import bring_down, excitation_of, fly_check, fly_experiment
from mimopilot.sitl.field.ground_steps import (
    Found,
    check_vehicle,
    fetch_check,
    fetch_flight,
    inspect_flight,
    judge,
    keep,
    snapshot,
    tune_gains,
    upload_gains,
)
from mimopilot.sitl.field.vehicle_set import NEITHER, NEW, OLD, held_set, old_plan, write_set
from mimopilot.sitl.mavlink.ground_station.experiments.experiments_by_name import (
    EXPERIMENTS,
    check_experiment,
    experiment_profile,
)


class AutotuneStep(NamedTuple):
    """One step: its name in the decisions, and what does it and returns what is recorded."""

    name: str
    run: Callable[[AutotuneRun], Found]


STEPS = (
    AutotuneStep("checks", check_vehicle),
    AutotuneStep("snapshot", snapshot),
    AutotuneStep("experiment", fly_experiment),
    AutotuneStep("flight log", fetch_flight),
    AutotuneStep("inspection", inspect_flight),
    AutotuneStep("gains", tune_gains),
    AutotuneStep("upload", upload_gains),
    AutotuneStep("check flight", fly_check),
    AutotuneStep("check log", fetch_check),
    AutotuneStep("judgement", judge),
    AutotuneStep("kept", keep),
)
#: Heights of a take-off, m: from one that clears the ground, chosen, to the ceiling of the EU's open category.
TAKE_OFF_M = 1.0, 120.0
UNKNOWN = "unknown"
#: What the vehicle holds -> its description.
SETS = {
    OLD: f"the vehicle holds the old gains of {SNAPSHOT}, read back",
    NEW: f"the vehicle holds the new gains of {GAINS}, read back",
    NEITHER: f"the vehicle holds neither the gains of {SNAPSHOT} nor those of {GAINS}",
    UNKNOWN: f"it could not be read whether the vehicle holds the gains of {SNAPSHOT} or of {GAINS}",
}


def autotune(options: AutotuneOptions, dialogue: AutotuneDialogue) -> Decisions:
    """Tune a vehicle in the field.

    Parameters
    ----------
    options : AutotuneOptions
    dialogue : AutotuneDialogue

    Returns
    -------
    Decisions
        If the new gains were kept.

    Raises
    ------
    SitlError
        If not: with the reason, and the set that the vehicle holds.
    """
    REPORT.need()
    check_experiment(options.profile)
    pilot = EXPERIMENTS[options.profile].pilot
    if pilot and options.take_off is not None:
        raise SitlError(f"--take-off: not with --profile {options.profile}: {pilot}, and leave --take-off out")
    if options.take_off is not None and not TAKE_OFF_M[0] <= options.take_off <= TAKE_OFF_M[1]:
        raise SitlError(f"--take-off: got {options.take_off:g}, expected {TAKE_OFF_M[0]:g} to {TAKE_OFF_M[1]:g} m")
    experiment_profile(options.profile, excitation_of(options), lambda values: None)  # refuses impossible options
    if not (options.yes or dialogue.interactive):
        raise SitlError("no terminal to ask: give --yes, and with --take-off --arm")
    run = AutotuneRun(options, load_decisions(options.folder, options.profile), dialogue)
    if run.decisions.result == "old":
        raise SitlError(
            f"{options.folder}: ended with the old gains: {run.decisions.reason}; give another --out", exit_code=1
        )
    try:
        _resume(run)
        for step in STEPS:
            if step.name not in run.decisions.steps:
                dialogue.tell(step.name)
                run.decisions.add(step.name, step.run(run))
        run.decisions.end("kept", "")
    except (Decided, Error, OSError, KeyboardInterrupt) as error:
        with _no_interrupts():
            raise _finish(run, error) from error
    dialogue.tell(f"kept: {SETS[NEW]}")
    return run.decisions


def _resume(run: AutotuneRun) -> None:
    """Compare what is recorded with what the vehicle holds, and go back to where both agree."""
    decisions = run.decisions
    if "snapshot" not in decisions.steps:
        return
    run.dialogue.tell(f"going on after: {list(decisions.steps)[-1]}")
    held = held_set(run)
    if decisions.result == "kept":
        if held != NEW:
            raise SitlError("the new gains were kept, but the vehicle does not hold them any more", exit_code=1)
    elif decisions.reason:
        raise Decided(decisions.reason)
    elif held == NEITHER and not decisions.begun:
        raise SitlError("somebody changed the gains on the vehicle; give another --out to begin anew", exit_code=1)
    elif held != NEW or "upload" not in decisions.steps:
        if held != OLD:
            _take_back(run)
        decisions.begun = False
        decisions.forget_from("upload")


def _take_back(run: AutotuneRun) -> None:
    """Write the old gains back, and verify them."""
    run.dialogue.tell("writing the old gains back")
    write_set(run, old_plan(run))


def _finish(run: AutotuneRun, error: BaseException) -> SitlError:
    """End: land what this program has started, take the old gains back, and say what the vehicle holds."""
    decisions = run.decisions
    run.ending = True
    reason = "interrupted" if isinstance(error, KeyboardInterrupt) else _text(error)
    decided = isinstance(error, Decided)
    problems, held = _settle_vehicle(run)
    known = held == OLD or not decisions.begun
    try:
        if known and decided:
            decisions.end("old", reason)
        elif known:
            decisions.begun = False
            decisions.forget_from("upload")
        elif decided:
            decisions.note(reason)
    except OSError as problem:
        problems.append(f"this is not recorded: {_text(problem)}")
    parts = [reason, *dict.fromkeys(problems)]
    if "snapshot" in decisions.steps:
        parts.append(SETS[held])
    if not known:
        restore = f"mimopilot restore {run.file(SNAPSHOT)} --connect {run.options.connect}"
        parts.append(f"land, and give the same command again, or: {restore}")
    elif not decided and decisions.steps:
        parts.append("give the same command again to go on")
    return SitlError("; ".join(parts), exit_code=error.exit_code if isinstance(error, Error) and known else 1)


def _settle_vehicle(run: AutotuneRun) -> tuple[list[str], str]:
    """Land the vehicle, take the old gains back; returns what failed on the way, and which set it holds."""
    problems: list[str] = []

    def tried(what: Callable[[], None]) -> None:
        try:
            what()
        except (Error, OSError) as problem:
            problems.append(_text(problem))

    if run.took_off:
        tried(lambda: bring_down(run))
    held = UNKNOWN

    def read() -> None:
        nonlocal held
        held = held_set(run)

    if "snapshot" in run.decisions.steps:
        tried(read)
        if run.decisions.begun and held in (NEW, NEITHER):
            tried(lambda: _take_back(run))
            held = UNKNOWN
            tried(read)
    return problems, held


def _text(error: BaseException) -> str:
    if isinstance(error, OSError) and not isinstance(error, Error):
        return f"{error.filename}: {error.strerror}" if error.filename else str(error.strerror or error)
    return str(error)


@contextmanager
def _no_interrupts() -> Iterator[None]:
    """Ctrl-C does not end what is done meanwhile: it takes the old gains back."""
    before = signal.signal(signal.SIGINT, lambda number, frame: None)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
