"""The transaction: all values on the vehicle, verified, or the old ones back, or told exactly what is left.

MAVLink has no transaction for parameters, and a half-applied matrix is a controller that nobody tuned. So the old
values are known before the first write, each write is believed only on an echo with the same bits and on a
reading of its own afterwards, and whatever goes wrong puts the old values back and reads those, too.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from sitl.errors import SitlError
from sitl.mavlink.exchange import Answer, Conversation
from sitl.mavlink.words import Steps, shortest

#: PX4 and ArduPilot do not save a value that differs from the old one by less (the epsilon of single precision).
SMALLEST_CHANGE = 1.2e-7


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
        See `sitl.mavlink.exchange.Conversation.store`; empty when there was nothing to store or no link to do it.
    """

    state: str
    reason: str
    held: Mapping[str, tuple[float, ...]]
    storage: str = ""


def read(talk: Conversation, names: Sequence[str]) -> Steps[dict[str, float]]:
    """Values that the vehicle holds.

    Raises
    ------
    SitlError
        When one is not answered, refused, or no float.
    """
    answers = yield from talk.ask(names, "reading")
    reason = _problem(answers)
    if reason:
        raise SitlError(f"{reason}; nothing was written", exit_code=1)
    return {name: answer.value for name, answer in answers.items() if answer.value is not None}


def apply(talk: Conversation, new: Mapping[str, float], old: Mapping[str, float], store: bool = True) -> Steps[Outcome]:
    """Write what differs, read back everything, store; on any failure put the old values back.

    Parameters
    ----------
    talk : Conversation
        With the vehicle known.
    new : mapping
        Name -> value in single precision; all of them are verified.
    old : mapping
        Name -> what the vehicle holds, at least of the same names.
    store : bool
        False: the values are not meant to outlast the flight.
    """
    talk.possible = {name: {old[name]} for name in new}
    reason = yield from _write_and_verify(talk, new, old)
    if not reason:
        storage = (yield from talk.store()) if store else ""
        return Outcome("verified", "", _held(talk, new), storage)
    if not talk.written:
        return Outcome("untouched", reason, _held(talk, new))
    yield from talk.settle()
    back = {name: old[name] for name in new if name in talk.written or talk.possible[name] != {old[name]}}
    yield from talk.tell(back, "putting back", keep_going=True)
    if talk.gone:
        return Outcome("mixed", reason, _held(talk, new))
    yield from talk.settle()
    answers = yield from talk.ask(list(new), "verifying", keep_going=True)
    storage = (yield from talk.store()) if store else ""
    restored = all(answers[name].value == old[name] for name in new)
    return Outcome("rolled back" if restored else "mixed", reason, _held(talk, new), storage)


def _write_and_verify(talk: Conversation, new: Mapping[str, float], old: Mapping[str, float]) -> Steps[str]:
    """Why the new values are not all on the vehicle; empty when they are."""
    yield from talk.settle()
    changed = {name: value for name, value in new.items() if value != old[name]}
    reason = _problem((yield from talk.tell(changed, "writing")), old, new)
    if reason:
        return reason
    yield from talk.settle()
    answers = yield from talk.ask(list(new), "verifying")
    reason = _problem(answers)
    if reason:
        return reason
    for name, answer in answers.items():
        if answer.value != new[name]:
            held = "nothing" if answer.value is None else shortest(answer.value)
            return f"{name}: reads back as {held}, expected {shortest(new[name])}"
    return ""


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


def _held(talk: Conversation, names: Mapping[str, float]) -> dict[str, tuple[float, ...]]:
    return {name: tuple(sorted(talk.possible[name])) for name in names}
