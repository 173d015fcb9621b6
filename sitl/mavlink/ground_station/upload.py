"""Parameter upload as a transaction: all new values verified, or rolled back, or the remaining values reported.

MAVLink has no transaction for parameters, and a partly written matrix is an untuned controller. So the old values are
read before the first write. A write counts only after an echo with the same bits and a separate reading. After any
failure the old values are written back and verified, too. A vehicle may still restart while it stores, clamp late, or
be written by another ground station. So all values are read once more after its storage time.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from mimopilot.sitl.errors import SitlError
from mimopilot.sitl.mavlink.ground_station.events import Exchange
from mimopilot.sitl.mavlink.ground_station.parameter_protocol import Answer, ParameterClient
from mimopilot.sitl.mavlink.ground_station.set_switch import SetSwitch, state_after
from mimopilot.sitl.mavlink.ground_station.vehicle_link_state import FRESH_S
from mimopilot.sitl.mavlink.wire.float32 import shortest

#: PX4 and ArduPilot do not save a smaller change of a value (the epsilon of single precision, rounded up).
SMALLEST_CHANGE = 1.2e-7


class NoParametersError(SitlError):
    """The vehicle has none of the requested parameters."""


@dataclass(frozen=True)
class UploadOutcome:
    """Result of an upload.

    Attributes
    ----------
    state : str
        ``verified``: every new value was read back. ``untouched``: nothing was written. ``rolled back``: every old
        value was read back. ``mixed``: anything else.
    reason : str
        Why it is not verified; empty if it is.
    held : mapping
        Name -> the values that the vehicle may hold now; a single one if it is known.
    storage : str
        See `parameter_protocol.ParameterClient.store`; empty if nothing was stored or the link was lost.
    armed : bool
        The vehicle reported armed after the first write.
    """

    state: str
    reason: str
    held: Mapping[str, tuple[float, ...]]
    storage: str = ""
    armed: bool = False


def read_values(client: ParameterClient, names: Sequence[str]) -> Exchange[dict[str, float]]:
    """Values that the vehicle holds.

    Raises
    ------
    NoParametersError
        If the vehicle is present, but answers for none of them.
    SitlError
        If one is not answered, refused, or not a float.
    """
    answers = yield from client.read(names, "reading")
    reason = _problem(answers)
    if reason:
        none = client.heartbeat_age < FRESH_S and all(answer.absent for answer in answers.values())
        raise (NoParametersError if none else SitlError)(f"{reason}; nothing was written", exit_code=1)
    return {name: answer.value for name, answer in answers.items() if answer.value is not None}


def write_and_verify(
    client: ParameterClient,
    new: Mapping[str, float],
    old: Mapping[str, float],
    store: bool = True,
    switch: SetSwitch | None = None,
    lock: str = "",
) -> Exchange[UploadOutcome]:
    """Write the differences, verify all, store, verify all again; on any failure roll back.

    Parameters
    ----------
    client : ParameterClient
        After `await_heartbeat`.
    new : mapping
        Name -> value in single precision.
    old : mapping
        Name -> value on the vehicle, for at least the same names; names that are not in `new` must not change.
    store : bool
        False: the values are for this flight only; do not store, verify once.
    switch : SetSwitch, optional
        Of a vehicle that takes a set as a whole; `old` has its value. It is switched off and back also if no value
        differs: what it holds need not be what it flies.
    lock : str
        Name of the parameter without which the vehicle takes none of the others, see `UploadPlan.lock`: 0 while they
        are written, so no part of a set flies, whatever happens. Empty: there is none.
    """
    expected = {**old, **new}
    client.possible = {name: {value} for name, value in old.items()}
    client.check_contradictions(True)
    storage = ""
    reason = "" if switch is None else (yield from _switch_off(client, switch, lock, store))
    if not reason:
        locked = {lock: 0.0} if lock and switch is not None else {}
        reason = yield from _write_locked(client, new, {**old, **locked}, lock)
    if not reason:
        reason = yield from _verify(client, expected if switch is None else expected | {switch.enable: 0.0})
    if not reason and switch is not None:
        reason = yield from _switch_back(client, switch, old[switch.enable])
    if not reason and store:
        # All of them: the vehicle may hold values that it has not saved, and would start with a mixture.
        storage = yield from client.store(new)
        reason = (yield from client.wait_for_autosave()) or (yield from _verify(client, expected))
    state = "verified"
    if reason:
        state, storage = yield from _roll_back(client, new, old, store, switch, lock)
    client.check_contradictions(False)
    held = {name: tuple(sorted(values)) for name, values in client.possible.items()}
    return UploadOutcome(state, reason, held, storage, client.was_armed)


def _switch_off(client: ParameterClient, switch: SetSwitch, lock: str, store: bool) -> Exchange[str]:
    """Switch the set off, stored, and the lock, too: a vehicle that restarts then flies no part of a set.

    Not even if somebody switches it on again. Returns why that failed.
    """
    off = dict.fromkeys([name for name in (switch.enable, lock) if name], 0.0)
    reason = yield from _write(client, off, dict.fromkeys(off, 1.0))
    if not reason:
        reason = yield from _verify(client, off)
    if not reason and store and (yield from client.store()) != "acknowledged":
        reason = f"{switch.enable}: 0 was not stored"
    return reason


def _switch_back(client: ParameterClient, switch: SetSwitch, value: float, old: bool = False) -> Exchange[str]:
    """Switch as before, and see that the vehicle takes the set, or again does what it did with the `old` one.

    Returns why it does not.
    """
    answers = yield from client.write({switch.enable: value}, "switching", keep_going=old)
    yield from client.wait_until_quiet()
    return _problem(answers) or (yield from state_after(client, switch, value, old))


def _roll_back(
    client: ParameterClient,
    new: Mapping[str, float],
    old: Mapping[str, float],
    store: bool,
    switch: SetSwitch | None,
    lock: str,
) -> Exchange[tuple[str, str]]:
    """Write the old values back; returns the state of the upload and of the storage."""
    if not client.written:
        return "untouched", ""
    client.check_contradictions(True)
    yield from client.wait_until_quiet()
    back = {name: old[name] for name in new if name in client.written or client.possible[name] != {old[name]}}
    if switch is not None:
        yield from client.write({switch.enable: 0.0}, "switching", keep_going=True)
    last = {name: back.pop(name) for name in (lock,) if name in back}
    if last and back:
        yield from client.write(dict.fromkeys(last, 0.0), "rolling back", keep_going=True)
    yield from client.write(back, "rolling back", keep_going=True)
    yield from client.write(last, "rolling back", keep_going=True)
    if client.lost:
        return "mixed", ""
    refused = ""
    if switch is not None:
        refused = yield from _switch_back(client, switch, old[switch.enable], old=True)
    yield from client.wait_until_quiet()
    storage = ""
    if store:
        storage = yield from client.store(new)
        yield from client.wait_for_autosave(keep_going=True)
    answers = yield from client.read(list(old), "verifying", keep_going=True)
    restored = all(answers[name].value == old[name] and client.possible[name] == {old[name]} for name in old)
    return "rolled back" if restored and not refused else "mixed", storage


def _write_locked(
    client: ParameterClient, new: Mapping[str, float], old: Mapping[str, float], lock: str
) -> Exchange[str]:
    """Write the differences, with the lock as 0 until all others are written; returns why that failed."""
    others = {name: value for name, value in new.items() if name != lock}
    locked = {name: old[name] for name in new if name == lock}
    reason = ""
    if locked and any(value != old[name] for name, value in others.items()):
        reason = yield from _write(client, dict.fromkeys(locked, 0.0), locked)
        locked = dict.fromkeys(locked, 0.0)
    if not reason:
        reason = yield from _write(client, others, old)
    if not reason and locked:
        reason = yield from _write(client, {lock: new[lock]}, locked)
    return reason


def _write(client: ParameterClient, new: Mapping[str, float], old: Mapping[str, float]) -> Exchange[str]:
    """Write the differences; returns why that failed, empty: it did not."""
    yield from client.wait_until_quiet()
    changed = {name: value for name, value in new.items() if value != old[name]}
    answers = yield from client.write(changed, "writing")
    reason = client.failure or _problem(answers, old, new)
    if not reason:
        yield from client.wait_until_quiet()
    return reason


def _verify(client: ParameterClient, expected: Mapping[str, float]) -> Exchange[str]:
    """Read all; returns the first difference from what is expected, empty: none."""
    answers = yield from client.read(list(expected), "verifying")
    for name, answer in answers.items():
        if answer.value is not None and answer.value != expected[name]:
            return f"{name}: reads back as {shortest(answer.value)}, expected {shortest(expected[name])}"
    return client.failure or _problem(answers)


def _problem(
    answers: Mapping[str, Answer], old: Mapping[str, float] | None = None, new: Mapping[str, float] | None = None
) -> str:
    """The first problem and the number of further ones; empty: none."""
    bad = {name: answer for name, answer in answers.items() if answer.problem}
    if not bad:
        return ""
    name, answer = next(iter(bad.items()))
    more = f" (and {len(bad) - 1} more)" if len(bad) > 1 else ""
    tiny = old and new and answer.value is not None and abs(new[name] - old[name]) < SMALLEST_CHANGE
    why = f": PX4 and ArduPilot do not save a change below {SMALLEST_CHANGE:g}" if tiny else ""
    return f"{name}{more}: {answer.problem}{why}"
