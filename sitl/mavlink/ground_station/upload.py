"""The transaction: all values on the vehicle, verified, or the old ones back, or told exactly what is left.

MAVLink has no transaction for parameters, and a half-applied matrix is a controller that nobody tuned. So the old
values are known before the first write, each write is believed only on an echo with the same bits and on a
reading of its own afterwards, and whatever goes wrong puts the old values back and reads those, too. A vehicle may
still restart as it stores, clamp late, or be written by another station: so all is read once more when that has passed.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from mimopilot.sitl.errors import SitlError
from mimopilot.sitl.mavlink.ground_station.events import Steps
from mimopilot.sitl.mavlink.ground_station.parameter_protocol import Answer, Conversation
from mimopilot.sitl.mavlink.ground_station.vehicle_contact import FRESH_S
from mimopilot.sitl.mavlink.wire.float32 import shortest

#: PX4 and ArduPilot do not save a value that differs from the old one by less (the epsilon of single precision).
SMALLEST_CHANGE = 1.2e-7


class NoneHeldError(SitlError):
    """The vehicle has none of the parameters that it was asked for."""


@dataclass(frozen=True)
class Outcome:
    """How a transaction ended.

    Attributes
    ----------
    state : str
        ``verified``: every new value was read back. ``untouched``: nothing was written. ``rolled back``: every old
        value was read back. ``mixed``: anything else.
    reason : str
        Why it is not verified.
    held : mapping
        Name -> the values that the vehicle may hold now; one when it is known.
    storage : str
        See `parameter_protocol.Conversation.store`; empty when there was nothing to store or no link to do it.
    armed : bool
        The vehicle said after the first write that it is armed.
    """

    state: str
    reason: str
    held: Mapping[str, tuple[float, ...]]
    storage: str = ""
    armed: bool = False


def read(talk: Conversation, names: Sequence[str]) -> Steps[dict[str, float]]:
    """Values that the vehicle holds.

    Raises
    ------
    NoneHeldError
        When the vehicle is there, and answers for none of them.
    SitlError
        When one is not answered, refused, or no float.
    """
    answers = yield from talk.ask(names, "reading")
    reason = _problem(answers)
    if reason:
        none = talk.silence < FRESH_S and all(answer.absent for answer in answers.values())
        raise (NoneHeldError if none else SitlError)(f"{reason}; nothing was written", exit_code=1)
    return {name: answer.value for name, answer in answers.items() if answer.value is not None}


def apply(talk: Conversation, new: Mapping[str, float], old: Mapping[str, float], store: bool = True) -> Steps[Outcome]:
    """Write what differs, read back everything, store, read it once more; on any failure put the old values back.

    Parameters
    ----------
    talk : Conversation
        With the vehicle known.
    new : mapping
        Name -> value in single precision.
    old : mapping
        Name -> what the vehicle holds, at least of the same names; those that are not in `new` must stay as they are.
    store : bool
        False: the values are not meant to outlast the flight, and the first reading is the last.
    """
    expected = {**old, **new}
    talk.possible = {name: {value} for name, value in old.items()}
    talk.watch(True)
    storage = ""
    reason = yield from _write(talk, new, old)
    if not reason:
        reason = yield from _verify(talk, expected)
    if not reason and store:
        storage = yield from talk.store()
        reason = (yield from talk.outlast()) or (yield from _verify(talk, expected))
    state = "verified"
    if reason:
        state, storage = yield from _put_back(talk, new, old, store)
    talk.watch(False)
    held = {name: tuple(sorted(values)) for name, values in talk.possible.items()}
    return Outcome(state, reason, held, storage, talk.was_armed)


def _put_back(
    talk: Conversation, new: Mapping[str, float], old: Mapping[str, float], store: bool
) -> Steps[tuple[str, str]]:
    """Put the old values back; the state of the vehicle and of its storage."""
    if not talk.written:
        return "untouched", ""
    talk.watch(True)
    yield from talk.settle()
    back = {name: old[name] for name in new if name in talk.written or talk.possible[name] != {old[name]}}
    yield from talk.tell(back, "putting back", keep_going=True)
    if talk.gone:
        return "mixed", ""
    yield from talk.settle()
    storage = ""
    if store:
        storage = yield from talk.store()
        yield from talk.outlast(keep_going=True)
    answers = yield from talk.ask(list(old), "verifying", keep_going=True)
    restored = all(answers[name].value == old[name] and talk.possible[name] == {old[name]} for name in old)
    return "rolled back" if restored else "mixed", storage


def _write(talk: Conversation, new: Mapping[str, float], old: Mapping[str, float]) -> Steps[str]:
    """Write what differs; why that failed, empty when it did not."""
    yield from talk.settle()
    changed = {name: value for name, value in new.items() if value != old[name]}
    answers = yield from talk.tell(changed, "writing")
    reason = talk.trouble or _problem(answers, old, new)
    if not reason:
        yield from talk.settle()
    return reason


def _verify(talk: Conversation, expected: Mapping[str, float]) -> Steps[str]:
    """Read everything; what is not as expected, empty when all is."""
    answers = yield from talk.ask(list(expected), "verifying")
    for name, answer in answers.items():
        if answer.value is not None and answer.value != expected[name]:
            return f"{name}: reads back as {shortest(answer.value)}, expected {shortest(expected[name])}"
    return talk.trouble or _problem(answers)


def _problem(
    answers: Mapping[str, Answer], old: Mapping[str, float] | None = None, new: Mapping[str, float] | None = None
) -> str:
    """The first problem, and how many more requests it left unanswered."""
    bad = {name: answer for name, answer in answers.items() if answer.problem}
    if not bad:
        return ""
    name, answer = next(iter(bad.items()))
    more = f" (and {len(bad) - 1} more)" if len(bad) > 1 else ""
    tiny = old and new and answer.value is not None and abs(new[name] - old[name]) < SMALLEST_CHANGE
    why = f": PX4 and ArduPilot do not save a change below {SMALLEST_CHANGE:g}" if tiny else ""
    return f"{name}{more}: {answer.problem}{why}"
