"""The excitation experiment on a vehicle in the air: its injector set, started, watched, stopped, and put back.

The vehicle stops by itself when it tilts too far, leaves its mode, or a stick moves; this side watches tilt, mode and
the link, and stops it too. See `sitl.mavlink.ground_station.events` for how a conversation is driven.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

from mimopilot.sitl.autopilot.excitation_injector import AXIS, PAUSE_S
from mimopilot.sitl.errors import SitlError
from mimopilot.sitl.mavlink.ground_station.events import Attitude, Excited, Landed, Request, Sight, Steps, Text
from mimopilot.sitl.mavlink.ground_station.parameter_protocol import Conversation
from mimopilot.sitl.mavlink.ground_station.upload import apply, read
from mimopilot.sitl.mavlink.wire.px4_modes import nav_state
from mimopilot.tuning.parameters import EXCITATION

IN_AIR = 2  # MAV_LANDED_STATE
#: Message -> (number, interval in us): what the vehicle is asked to tell.
TELL = {"ATTITUDE": (30, 50_000), "DEBUG_VECT": (250, 100_000), "EXTENDED_SYS_STATE": (245, 200_000)}
SEEN_S, ASK_AGAIN_S = 5.0, 1.0  # how long these are waited for
TAKEN_UP_S = 1.5  # a PX4 takes up parameters once a second
BEGIN_S = 5.0  # from the write to the first pulse
SILENT_S = 1.0  # without one of these
DEAF_S = 5.0  # without HEARTBEAT, which comes once a second and may be lost
MARGIN_S = 10.0  # beyond the planned end
LEVEL = math.radians(15.0)  # a vehicle that hovers tilts less
ENOUGH = 0.95  # share of the planned time that counts as the whole
#: All names, and those that are whole numbers on a PX4.
NAMES = tuple(setting.name for setting in EXCITATION)
INTEGERS = frozenset(setting.name for setting in EXCITATION if setting.integer)


def check(values: Mapping[str, float]) -> None:
    """Refuse settings that the vehicle's injector would refuse.

    Raises
    ------
    SitlError
        Naming the first.
    """
    for setting in EXCITATION:
        value = values[setting.name]
        if not setting.minimum <= value <= setting.maximum:
            expected = f"{setting.minimum:g} to {setting.maximum:g} {setting.unit}".rstrip()
            raise SitlError(f"{setting.name}: got {value:g}, expected {expected} ({setting.description})")


@dataclass
class Sights:
    """What the vehicle was last seen to do; times by our clock, s."""

    talk: Conversation
    tilt: float = 0.0
    in_air: bool = False
    phase: int = -1
    stamp: int = 0  # us, of the vehicle
    text: str = ""
    seen: dict[str, float] = field(default_factory=dict)

    def __call__(self, sight: Sight) -> None:
        """Take one in."""
        if isinstance(sight, Attitude):
            self.tilt = max(abs(sight.roll), abs(sight.pitch))
            self.seen["ATTITUDE"] = self.talk.now
        elif isinstance(sight, Landed):
            self.in_air = sight.state == IN_AIR
            self.seen["EXTENDED_SYS_STATE"] = self.talk.now
        elif isinstance(sight, Excited):
            self.phase, self.stamp = sight.phase, sight.time
            self.seen["DEBUG_VECT"] = self.talk.now
        elif isinstance(sight, Text):
            self.text = sight.text

    def unseen(self, seconds: float) -> list[str]:
        """What has not been told for so long."""
        return [kind for kind in TELL if self.talk.now - self.seen.get(kind, -math.inf) > seconds]


@dataclass(frozen=True)
class Result:
    """How an experiment ended.

    Attributes
    ----------
    complete : bool
        It went to its planned end.
    reason : str
        Why it did not.
    seconds : float
        Of injection, by the vehicle's clock.
    stopped : bool
        The vehicle was read to hold `AXIS` 0 at the end.
    restored : bool
        All settings were read to be as before.
    """

    complete: bool
    reason: str
    seconds: float
    stopped: bool
    restored: bool


def observe(talk: Conversation, mode: int) -> Steps[Sights]:
    """Have the vehicle tell of its flight, and see that it hovers in a mode (nav_state) under our controller.

    Raises
    ------
    SitlError
        When it does not.
    """
    assert talk.vehicle is not None
    sights = talk.witness = Sights(talk)
    begin, again = talk.now, talk.now
    while sights.unseen(SILENT_S) and talk.now < begin + SEEN_S and not (talk.interrupted or talk.closed):
        requests = []
        if talk.now >= again:
            again = talk.now + ASK_AGAIN_S
            requests = [
                Request(talk.vehicle.system, talk.vehicle.component, *TELL[kind]) for kind in sights.unseen(1.0)
            ]
        yield from talk.turn(requests, talk.now + 0.1)
    missing = sights.unseen(SILENT_S)
    reason = ""
    if talk.interrupted:
        reason = "interrupted"
    elif "DEBUG_VECT" in missing and len(missing) == 1:
        reason = "the vehicle does not tell of its injector (DEBUG_VECT MIMO_EXC): our controller does not fly it"
    elif missing:
        reason = f"the vehicle does not tell {', '.join(missing)}"
    elif not talk.vehicle.armed:
        reason = "the vehicle is not armed: take off and hover first"
    elif not sights.in_air:
        reason = "the vehicle is on the ground: take off and hover first"
    elif nav_state(talk.vehicle.mode) != mode:
        reason = f"the vehicle is in another mode (nav_state {nav_state(talk.vehicle.mode)}, MIMO_EX_MODE is {mode})"
    elif sights.tilt > LEVEL:
        reason = f"the vehicle tilts by {math.degrees(sights.tilt):.0f} degrees: let it hover first"
    if reason:
        raise SitlError(f"{reason}; nothing was written", exit_code=1)
    return sights


def excite(talk: Conversation, sights: Sights, wanted: Mapping[str, float]) -> Steps[Result]:
    """The whole experiment, from the settings to the settings before.

    Parameters
    ----------
    talk : Conversation
        With a vehicle that was observed to hover.
    sights : Sights
        Of it.
    wanted : mapping
        Name -> value in single precision, of all of `NAMES`.

    Raises
    ------
    SitlError
        When the vehicle lacks a parameter, or excites already.
    """
    old = yield from read(talk, NAMES)
    if sights.phase >= 0:
        raise SitlError(f"the vehicle excites already: set {AXIS} to 0 first; nothing was written", exit_code=1)
    if old[AXIS] != 0:  # left from an earlier flight; it must not be put back, which would start another
        yield from talk.tell({AXIS: 0.0}, "reading")
        seen = talk.now + TAKEN_UP_S
        while talk.now < seen:
            yield from talk.turn([], seen)
        old = yield from read(talk, NAMES)
        if old[AXIS] != 0:
            raise SitlError(f"{AXIS} cannot be set to 0; nothing else was written", exit_code=1)
    new = {**wanted, AXIS: old[AXIS]}
    outcome = yield from apply(talk, new, old, store=False)
    if outcome.state != "verified":
        return Result(False, outcome.reason, 0.0, True, outcome.state in ("untouched", "rolled back"))
    seconds = 0.0
    reason = (yield from talk.tell({AXIS: wanted[AXIS]}, "starting"))[AXIS].problem
    if not reason:
        reason, seconds = yield from _watch(talk, sights, wanted)
    # Whatever has happened: first it is stopped.
    yield from talk.tell({AXIS: 0.0}, "stopping", keep_going=True)
    yield from talk.settle()
    answers = yield from talk.ask([AXIS], "stopping", keep_going=True)
    stopped = answers[AXIS].value == 0.0
    back = {name: value for name, value in old.items() if value != new[name]}
    yield from talk.tell(back, "putting back", keep_going=True)
    yield from talk.settle()
    answers = yield from talk.ask(NAMES, "putting back", keep_going=True)
    restored = all(answers[name].value == value for name, value in old.items())
    return Result(not reason, reason, seconds, stopped, restored)


def _watch(talk: Conversation, sights: Sights, wanted: Mapping[str, float]) -> Steps[tuple[str, float]]:
    """Wait for the end; why it was no good one (empty: it was), and how long was injected (s)."""
    assert talk.vehicle is not None
    both = wanted[AXIS] == 3
    planned = (2 * wanted["MIMO_EX_DUR"] + PAUSE_S) if both else wanted["MIMO_EX_DUR"]
    mode, begin, seconds = talk.vehicle.mode, talk.now, 0.0
    first: int | None = None
    while True:
        yield from talk.turn([], talk.now + 0.1)
        reason = _danger(talk, sights, mode, wanted["MIMO_EX_TILT"])
        if reason:
            return reason, seconds
        if sights.phase >= 0:
            first = sights.stamp if first is None else first
            seconds = 1e-6 * (sights.stamp - first)
            talk.progress("exciting", round(seconds), round(planned))
        elif first is not None:
            enough = seconds >= ENOUGH * planned - 0.5
            return "" if enough else f"the vehicle stopped after {seconds:.1f} s: {sights.text}", seconds
        elif talk.now > begin + BEGIN_S:
            return f"the vehicle did not begin within {BEGIN_S:g} s: {sights.text}", 0.0
        if talk.now > begin + planned + MARGIN_S:
            return f"no end after {planned + MARGIN_S:.0f} s", seconds


def _danger(talk: Conversation, sights: Sights, mode: int, tilt: float) -> str:
    """Why it must be stopped now; empty: it need not."""
    assert talk.vehicle is not None
    if talk.interrupted:
        return "interrupted"
    if talk.closed:
        return "the link was lost"
    if talk.trouble:
        return talk.trouble
    if talk.silence > DEAF_S:
        return f"no HEARTBEAT for {DEAF_S:g} s"
    if not talk.vehicle.armed:
        return "the vehicle was disarmed"
    if talk.vehicle.mode != mode:
        return "the vehicle left its mode"
    if not sights.tilt <= tilt:
        return f"the vehicle tilts by {math.degrees(sights.tilt):.0f} degrees"
    if not sights.in_air:
        return "the vehicle is on the ground"
    missing = sights.unseen(SILENT_S)
    return f"the vehicle does not tell {', '.join(missing)} any more" if missing else ""
